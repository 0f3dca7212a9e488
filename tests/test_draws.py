"""Draws of the posterior: weights against another program, the chart against differences, intervals against known truths."""

import math

import pytest
import torch

import torchrod as tr
from tests.problems import posed, unknowns_of
from tests.robots import T, busy_robot, steel_rod
from torchrod.estimation.chart import Chart
from torchrod.estimation.draws import Method
from torchrod.estimation.intervals import of_sizes, quantiles
from torchrod.estimation.pareto import effective_size, smoothed
from torchrod.model.problem import TIP_ROWS

CASES = 64


def weak_pushes(seed: int = 3) -> tuple[tr.Problem, torch.Tensor, torch.Tensor]:
    """Point forces of 0.1 to 0.4 force scales on the inner third of the rod, on four times the steps of the fit; F (B,), s (B,)."""
    random, robot = torch.Generator().manual_seed(seed), steel_rod()
    rod = robot.rod
    size = rod.force_scale * (0.1 + 0.3 * torch.rand(CASES, 1, generator=random))
    at = rod.length * (0.05 + 0.25 * torch.rand(CASES, 1, generator=random))
    turn = 2 * math.pi * torch.rand(CASES, 1, generator=random)
    F = torch.stack([size * turn.cos(), size * turn.sin(), 0 * size], -1)
    s = torch.linspace(rod.length / 20, rod.length, 20)
    p = tr.solve_shape(robot, (tr.PointForces(F, at),), None, s, CASES, 160).p
    return posed(s, p + 1e-3 * torch.randn(p.shape, generator=random)), size, at


@pytest.mark.parametrize(
    ("k", "k_hat", "largest", "size"),
    [
        (0.2, 0.2757741926452836, -4.323915623105266, 188.09944945803838),
        (1.0, 0.8608407853355382, -1.548949739120884, 16.216424255003744),
    ],
)
def test_weights_are_smoothed_as_arviz_stats_does(k: float, k_hat: float, largest: float, size: float):
    """arviz-stats 0.8.0, array_stats.psislw, of 200 evenly spaced quantiles of Pareto distributions of shape k."""
    u = ((torch.arange(200) * 77) % 200 + 0.5) / 200
    found, shape = smoothed((-k * torch.log(1 - u)).unsqueeze(0))
    assert math.isclose(float(shape), k_hat, rel_tol=1e-9)
    assert math.isclose(float(found.max()), largest, rel_tol=1e-9)
    assert math.isclose(float(effective_size(found)), size, rel_tol=1e-9)


def test_the_volume_of_the_chart_is_that_of_its_map():
    problem, _, _ = weak_pushes()
    problem = problem.of(unknowns_of(problem.robot, 2)).take(torch.arange(3))
    x = tr.estimate(problem).x
    chart = Chart.at(problem, x)
    v = chart.to(x[:, None, : chart.size]) + 0.3
    y, log_volume = chart.back(v)
    assert torch.allclose(chart.to(y), v, rtol=1e-8, atol=1e-8)
    step = 1e-6 * torch.eye(chart.size)
    J = (chart.back(v + step)[0] - chart.back(v - step)[0]) / 2e-6
    assert torch.allclose(torch.linalg.det(J).abs().log(), log_volume.squeeze(-1), atol=1e-4)


def test_weak_pushes_are_inside_their_intervals_and_on_the_rod():
    problem, size, at = weak_pushes()
    fit = tr.estimate(problem)
    found = tr.sampled_intervals(problem, fit)

    def held(value: torch.Tensor, interval: torch.Tensor) -> float:
        return float(((value >= interval[..., 0]) & (value <= interval[..., 1])).double().mean())

    assert held(size, found.magnitude) > 0.9
    assert held(at, found.location) > 0.9
    assert held(size, fit.magnitude_interval) < 0.85  # of the normal distribution
    assert bool(((found.location >= 0) & (found.location <= problem.robot.rod.length)).all())
    width = (found.location[..., 1] - found.location[..., 0]) / problem.robot.rod.length
    assert float(width.median()) < 0.95  # all of the rod would hold every place


@pytest.mark.parametrize("tendons", [False, True])
def test_draws_are_in_equilibrium_and_of_their_sample_alone(tendons: bool):
    robot = busy_robot() if tendons else steel_rod()
    s = torch.linspace(0.04, 0.4, 10)
    tension = T([[2.0, 1.0], [1.0, 3.0]]) if tendons else None
    F = T([[[0.3, 0.1, 0.0]], [[-0.2, 0.4, 0.0]]])
    p = tr.solve_shape(robot, (tr.PointForces(F, T([[0.25], [0.33]])),), tension, s, 2, 80).p
    problem = posed(s, p + 4e-4 * torch.randn(p.shape, generator=torch.Generator().manual_seed(1)), 4e-4, robot, tension=tension)
    fit = tr.estimate(problem)
    draws = tr.posterior_draws(problem, fit, 128)
    assert set(draws.method.tolist()) <= {int(Method.IMPORTANCE), int(Method.MATCHED)}
    assert bool((draws.k_hat < 1).all())
    spread = problem.take(torch.arange(2).repeat_interleave(128))
    c = spread.h(draws.x.flatten(0, 1), differentiable=False)[:, -TIP_ROWS:]
    heavy = draws.weight.flatten() > 1e-4
    off = (c.square() * problem.tip_weights).sum(-1).sqrt()[heavy]
    assert float(off.max()) < 0.3  # standard deviations of the fit's slack; a draw of alpha by itself is off by hundreds
    index = torch.tensor([1])
    alone = tr.posterior_draws(problem.take(index), fit.of(index, problem.size), 128)
    assert torch.allclose(alone.x[0], draws.x[1], rtol=1e-6, atol=1e-8)


def test_evidence_and_intervals_where_the_number_of_pushes_is_chosen():
    """No push, one and two, each by all three numbers: the true one has the most evidence, and all have intervals."""
    robot, s = steel_rod(), torch.linspace(0.02, 0.4, 20)
    F = T([[[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]], [[0.7, 0.2, 0.0], [0.0, 0.0, 0.0]], [[0.9, 0.1, 0.0], [0.2, -0.8, 0.0]]])
    p = tr.solve_shape(robot, (tr.PointForces(F, T([[0.15, 0.32]]).expand(3, -1)),), None, s, 3, 80).p
    problem = posed(s, p + 4e-4 * torch.randn(p.shape, generator=torch.Generator().manual_seed(5)), 4e-4)
    evidence = []
    for count in range(3):
        own = problem.of(unknowns_of(robot, count))
        evidence.append(tr.posterior_draws(own, tr.estimate(own), 128, prior="normalized").log_evidence.nan_to_num(-1e9))
    assert torch.stack(evidence).argmax(0).tolist() == [0, 1, 2]
    found = tr.analyze(problem, tr.contact_hypotheses(problem), sampled=True)
    assert found.intervals is not None
    assert torch.isfinite(found.intervals.magnitude[..., 0]).sum(-1).tolist() == [0, 1, 2]
    assert bool(torch.isfinite(found.intervals.resultant).all())
    assert float(found.intervals.resultant[0].abs().max()) < 1e-2


def test_the_size_of_a_load_that_may_be_nothing_may_be_nothing():
    """Where the bands of f_x and f_y hold zero, that of |f| does, whose draws are never zero."""
    robot, s = steel_rod(), torch.linspace(0.02, 0.4, 20)
    push = tr.PointForces(T([[[0.7, 0.7, 0.0]], [[0.1, 0.0, 0.0]]]) * robot.rod.force_scale, T([[0.3], [0.1]]))
    any_form = tr.SmoothCoordinates(0.4, robot.rod.force_scale, 1.0, 0.2)
    problem = posed(s, tr.solve_shape(robot, (push,), None, s, 2).p, loads=any_form)
    band = tr.sampled_intervals(problem, tr.estimate(problem)).band
    assert band is not None
    nothing = ((band[:, :, :2, 0] <= 0) & (band[:, :, :2, 1] >= 0)).all(-1)
    assert bool(nothing.any(-1).all()) and not bool(nothing[0].all())
    assert bool((band[:, :, 2, 0][nothing] == 0).all()) and bool((band[:, :, 2, 0][~nothing] > 0).all())


def test_the_size_of_what_may_be_nothing_may_be_nothing():
    """Of draws about a vector that is measured: held in 95 % for zero, too, whose size quantiles of |v| never hold; and no wider
    where the vector is told from zero.
    """
    random, sigma = torch.Generator().manual_seed(5), torch.tensor([0.3, 0.2, 0.02])
    weight = torch.full((200, 512), 1 / 512)
    for truth in ([0.0, 0.0, 0.0], [0.0, 0.0, 0.1], [0.5, 0.1, 0.0], [2.0, 1.0, 0.3]):
        v = torch.tensor(truth)
        seen = v + sigma * torch.randn(200, 1, 3, generator=random)
        draws = (seen + sigma * torch.randn(200, 512, 3, generator=random)).unsqueeze(2)
        interval, plain = of_sizes(draws, weight)[:, 0], quantiles(draws.norm(dim=-1), weight)[:, 0]
        held = ((interval[:, 0] <= v.norm()) & (v.norm() <= interval[:, 1])).double().mean()
        assert held > 0.9, truth
        if truth[0] == 0:
            assert ((plain[:, 0] <= v.norm()) & (v.norm() <= plain[:, 1])).double().mean() < 0.8
        if truth[0] > 1:
            assert torch.equal(interval, plain)


def test_of_many_more_loads_than_there_are_nothing_is_said():
    """Of ten loads hardly a draw has them in their order: no draws, then, and no crash, which once was a RuntimeError."""
    problem, _, _ = weak_pushes()
    many = problem.take(torch.arange(8)).of(unknowns_of(problem.robot, 10))
    fit = tr.estimate(many)
    found = tr.posterior_draws(many, fit)
    lost = (fit.status == int(tr.Status.CONVERGED)) & ~torch.isfinite(found.weight).any(-1)
    assert bool(lost.any()) and torch.isinf(found.k_hat[lost]).all()
    assert torch.isnan(tr.sampled_intervals(many, fit).magnitude[lost]).all()


def test_too_few_draws_are_refused():
    problem, _, _ = weak_pushes()
    fit = tr.estimate(problem)
    with pytest.raises(ValueError, match="draws is 8; the tail of their weights needs at least 32"):
        tr.posterior_draws(problem, fit, 8)


@pytest.mark.study
def test_pushes_that_nearly_cancel_are_inside_their_intervals():
    """5 to 10 % of the length apart, opposed: what is known is their couple. 60 % of forces, 62 % of places once."""
    random, robot, B = torch.Generator().manual_seed(11), steel_rod(), 60
    rod = robot.rod
    at = rod.length * (0.3 + 0.6 * torch.rand(B, 1, generator=random))
    at = torch.cat([at, at + rod.length * (0.05 + 0.05 * torch.rand(B, 1, generator=random))], -1)
    turn = 2 * math.pi * torch.rand(B, 1, generator=random) + T([[0.0, math.pi]])
    size = rod.force_scale * (0.5 + 1.5 * torch.rand(B, 2, generator=random))
    F = torch.stack([size * turn.cos(), size * turn.sin(), 0 * size], -1)
    s = torch.linspace(rod.length / 20, rod.length, 20)
    p = tr.solve_shape(robot, (tr.PointForces(F, at),), None, s, B, 160).p
    problem = posed(
        s, p + 4e-4 * torch.randn(p.shape, generator=random), 4e-4, loads=tr.GaussianCoordinates(2, 0.4, rod.force_scale)
    )
    fit = tr.estimate(problem)
    found, order = tr.sampled_intervals(problem, fit), fit.location.argsort(-1)

    def held(value: torch.Tensor, interval: torch.Tensor) -> float:
        own = interval.gather(1, order.unsqueeze(-1).expand_as(interval))
        return float(((value >= own[..., 0]) & (value <= own[..., 1])).double().mean())

    assert held(size, found.magnitude) > 0.9
    assert held(at, found.location) > 0.75
    assert held(size, fit.magnitude_interval) < 0.85
