"""The result: memory of its own, and a verdict also where little is left to judge by."""

import pytest
import torch

from tests.problems import posed
from tests.robots import T
from torchrod import GaussianCoordinates, Registration, estimate
from torchrod.estimation.evaluator import evaluator
from torchrod.estimation.result import limit, verdict
from torchrod.kernel import Sums

S = T([0.08, 0.16, 0.24, 0.32, 0.4], dtype=torch.float64)
POSITIONS = torch.stack([0.02 * S, 0 * S, S], -1).repeat(3, 1, 1)


def test_whoever_changes_one_number_of_a_result_changes_no_other():
    loads = GaussianCoordinates(1, 0.4, 1.0, locations=(0.3,))
    fit = estimate(posed(S, POSITIONS, loads=loads, registration=Registration()))
    assert (fit.status == 0).all()
    parts = [x for x in vars(fit).values() if isinstance(x, torch.Tensor)]
    assert all(x.is_contiguous() for x in parts)
    assert len({x.untyped_storage().data_ptr() for x in parts}) == len(parts)


def test_fewer_than_no_degrees_of_freedom_are_judged_as_one():
    """Five markers, two of them outliers, for 20 unknowns: 9 + 6 + 2 - 20."""
    problem = posed(S, POSITIONS, loads=GaussianCoordinates(2, 0.4, 1.0), registration=Registration())
    sums = Sums.room(3, problem.size, 21, 5)
    sums.r.zero_()
    sums.r[:, [0, 3]] = 0.1
    sums.cost.zero_()
    cost = T([0.9, 1.1, 2.0]) * limit(1)
    outlier, chi2, dof, explained = verdict(evaluator(problem, nu=4.0), sums, cost)
    assert outlier.tolist() == [[True, True, False, False, False]] * 3
    assert dof.tolist() == [-3] * 3
    assert chi2.tolist() == pytest.approx(cost.tolist())
    assert explained.tolist() == [True, False, False]
