"""A batch whose samples have arc lengths of their own: each has the answer that it has alone, and what is kept does not grow."""

import pytest
import torch

from tests.problems import posed, unknowns_of
from tests.robots import T, steel_rod
from torchrod import Markers, PointForces, Problem, analyze, contact_hypotheses, solve_shape
from torchrod.analysis.patterns import patterns


def own_places(count: int, P: int = 8) -> tuple[torch.Tensor, torch.Tensor]:
    """s of all markers of all samples, and positions (count, P count, 3) with noise; two markers of sample 1 are exchanged."""
    g = torch.Generator().manual_seed(2)
    s = (torch.rand(count, P, generator=g) * 0.36 + 0.04).sort(-1).values
    every, order = s.flatten().sort()
    positions = torch.full((count, P * count, 3), torch.nan)
    for b in range(count):
        load = PointForces(T([[[0.6, 0.3, 0.0]]]) * (1 + 0.3 * b), T([[0.25 + 0.01 * b]]))
        p = solve_shape(steel_rod(), (load,), None, s[b], 1).p[0] + 5e-4 * torch.randn(P, 3, generator=g)
        if b == 1:
            p[[2, 5]] = p[[5, 2]]
        positions[b, (order // P == b).nonzero().squeeze(-1)] = p
    return every, positions


@pytest.mark.parametrize("contacts", [1, "auto"])
def test_each_sample_has_its_own_answer(contacts):
    s, positions = own_places(12)
    problem = Problem(steel_rod(), unknowns_of(steel_rod()), [Markers(s, positions, 5e-4)])
    assert len(patterns(problem)) == 12
    found = analyze(problem, contact_hypotheses(problem, contacts))
    assert sorted(torch.cat([index for _, index in found.parts]).tolist()) == list(range(12))
    assert found.estimate.centre_line.shape == (12, 96, 3)
    for b in (0, 1, 7):
        seen = torch.isfinite(positions[b, :, 0])
        alone = posed(s[seen], positions[b : b + 1, seen], 5e-4)
        other = analyze(alone, contact_hypotheses(alone, contacts))
        K = other.estimate.force.shape[1]
        for name in ("force", "location", "load_covariance"):
            assert torch.allclose(getattr(found.estimate, name)[b, :K], getattr(other.estimate, name)[0], rtol=1e-6, equal_nan=True)
        assert torch.allclose(found.estimate.residual[b, seen], other.estimate.residual[0], atol=1e-9)
        assert torch.isnan(found.estimate.residual[b, ~seen]).all()
        assert found.estimate.chi2[b] == pytest.approx(float(other.estimate.chi2[0]))
        places = [m["s_m"] for m in found.diagnosis.suspects(b)]
        assert places == [m["s_m"] for m in other.diagnosis.suspects(0)]
        assert (b == 1 and contacts == 1) <= bool(places)
    assert found.profile is not None and found.places.position.shape == (*found.estimate.force.shape[:2], 3)


def test_a_batch_with_gaps_is_not_split():
    s = torch.linspace(0.02, 0.4, 80)
    positions = torch.zeros(5, 80, 3)
    positions[torch.rand(5, 80, generator=torch.Generator().manual_seed(0)) < 0.3] = torch.nan
    assert not patterns(posed(s, positions))
