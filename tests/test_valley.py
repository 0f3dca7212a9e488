"""Where the readings leave a curved valley open: along it there are fits, and draws go all along it."""

import math
from dataclasses import replace

import pytest
import torch

import torchrod as tr
from tests.robots import T, steel_rod
from tests.test_edges import L as STRIP
from tests.test_edges import strip
from tests.test_tip import compressed
from torchrod.estimation.chart import BUCKLES, FAINT, GIVES_WAY, TWISTS, Chart, _log_size, _Sized
from torchrod.estimation.draws import _Target
from torchrod.estimation.elsewhere import cheapest, fits_elsewhere, marks
from torchrod.estimation.evaluator import evaluator
from torchrod.estimation.proposal import Mixture, OnGrid, Proposal, Student
from torchrod.estimation.solve import Settings, solver_of
from torchrod.estimation.valley import _Search, line_of, valley

PLAIN = solver_of(Settings(restarts=(), basins=0))


def across(B: int, noise: float = 1e-4, seed: int = 3) -> tuple[tr.Problem, torch.Tensor]:
    """Pushes across a strip, hardly along its soft side; the force across (B,) N."""
    robot, g = strip(1e6), torch.Generator().manual_seed(seed)
    scale = robot.rod.force_scale
    F = torch.stack([3e-3 * scale * (1 + torch.rand(B, generator=g)), scale * (2 * torch.rand(B, generator=g) - 1)], -1)
    s, at = torch.linspace(STRIP / 20, STRIP, 20), STRIP * (0.3 + 0.5 * torch.rand(B, 1, generator=g))
    p = tr.solve_shape(robot, (tr.PointForces(torch.nn.functional.pad(F, (0, 1)).unsqueeze(1), at),), None, s, B, 160).p
    p = p + noise * STRIP * torch.randn(p.shape, generator=g)
    unknowns = tr.Unknowns(tr.GaussianCoordinates(1, STRIP, scale))
    return tr.Problem(robot, unknowns, [tr.Markers(s, p, noise * STRIP)]), F[:, 1]


def wrenched(B: int, seed: int = 6) -> tuple[tr.Problem, torch.Tensor]:
    """Nothing but a force and a moment at the tip, in any direction; both (B, 6), N, N m."""
    robot, g = steel_rod(), torch.Generator().manual_seed(seed)
    way = torch.nn.functional.normalize(torch.randn(B, 2, 3, generator=g), dim=-1)
    size = 0.1 + 0.4 * torch.rand(B, 1, 1, generator=g)
    wrench = size * way * T([robot.rod.force_scale, robot.rod.moment_scale])[:, None]
    s = torch.linspace(0.02, 0.4, 20)
    load = tr.PointWrenches(wrench[:, :1], wrench[:, 1:], T([0.4]))
    p = tr.solve_shape(robot, (load,), None, s, B, 160).p
    p = p + 4e-4 * torch.randn(p.shape, generator=g)
    unknowns = tr.Unknowns(tr.GaussianCoordinates(0, 0.4, robot.rod.force_scale), "wrench")
    return tr.Problem(robot, unknowns, [tr.Markers(s, p, 4e-4)]), wrench.flatten(1)


def of_kind(kind: str, B: int) -> tr.Problem:
    if kind == "wrench":
        return wrenched(B)[0]
    return compressed(B, 0.1, 0.55, 5)[0] if kind == "tip" else across(B)[0]


@pytest.mark.parametrize("kind", ["tip", "strip", "wrench"])
def test_fits_along_a_valley_are_held_at_its_knots_and_explain_the_readings(kind):
    problem = of_kind(kind, 4)
    line, fit = line_of(problem), tr.estimate(problem)
    assert line is not None
    found = valley(problem, fit.x, fit.covariance, PLAIN)
    assert torch.equal(found.x[:, 0], fit.x) and bool(found.sound[:, 0].all())
    assert int(found.sound.sum(-1).min()) > 4
    chi2 = problem.take(torch.arange(4).repeat_interleave(found.sound.shape[1]))
    off = chi2.reading - chi2.h(found.x.flatten(0, 1), differentiable=False)
    least = (chi2.weights * off.nan_to_num(0.0) ** 2)[:, :-6].sum(-1).unflatten(0, found.sound.shape)
    assert bool((least < least[:, :1] + 60.0)[found.sound].all())
    at = found.x[..., line.entry]
    near = (at.unsqueeze(-1) - line.knots).abs().amin(-1)
    assert float((near < 5e-3)[found.sound].double().mean()) > 0.8  # all but the fit and those from elsewhere


@pytest.mark.parametrize("kind", ["tip", "strip", "wrench"])
def test_the_cost_of_a_held_fit_is_that_of_the_problem_there(kind):
    """Not of what holds it: priors at the knot, of a push and of its place."""
    problem = of_kind(kind, 4)
    line, fit = line_of(problem), tr.estimate(problem)
    assert line is not None
    search = _Search(problem, line, PLAIN)
    search.along(torch.arange(4), fit.x, search.nearest(fit.x))
    assert len(search.of) > 20
    plain = evaluator(problem.take(search.of), math.inf).cost(search.x)
    assert float((search.cost - plain).abs().median()) < 0.02


@pytest.mark.parametrize("kind", ["tip", "strip"])
def test_draws_along_a_valley_are_of_their_sample_alone(kind):
    problem = compressed(3, 0.1, 1.2, 2)[0] if kind == "tip" else across(3)[0]
    fit, index = tr.estimate(problem), torch.tensor([1])
    draws = tr.posterior_draws(problem, fit, 128, prior="normalized")
    alone = tr.posterior_draws(problem.take(index), fit.of(index, problem.size), 128, prior="normalized")
    counts = alone.weight[0] > 1e-6  # where Newton's steps go astray, it is a matter of round-off where to
    assert torch.allclose(alone.x[0][counts], draws.x[1][counts], rtol=1e-5, atol=1e-5)
    assert torch.allclose(alone.weight[0], draws.weight[1], atol=1e-5)
    assert torch.allclose(alone.log_evidence[0], draws.log_evidence[1], atol=1e-5)


@pytest.mark.study
@pytest.mark.parametrize("kind", ["tip", "strip"])
def test_a_few_draws_find_what_many_find(kind):
    """The evidence of 512 and of 2048: one fit's neighbourhood once had a third of what there is, or none of the truth's."""
    problem = compressed(10, 0.1, 0.55, 5)[0] if kind == "tip" else across(12)[0]
    fit = tr.estimate(problem)
    few, many = (tr.posterior_draws(problem, fit, n, prior="normalized") for n in (512, 2048))
    off = (few.log_evidence - many.log_evidence).abs()
    assert float(off.median()) < 0.25 and float(off.quantile(0.8)) < 0.8
    assert float((few.k_hat > 0.7).double().mean()) < 0.15


def test_no_valley_where_there_is_none():
    robot, s = steel_rod(), torch.linspace(0.02, 0.4, 20)
    markers = [tr.Markers(s, torch.zeros(1, 20, 3), 1e-3)]

    def known(count: int, tip: str = "none", at: tuple[float, ...] | None = None, robot: tr.Robot = robot) -> bool:
        loads = tr.GaussianCoordinates(count, robot.rod.length, robot.rod.force_scale, locations=at)
        return line_of(tr.Problem(robot, tr.Unknowns(loads, tip), markers)) is not None

    assert known(1, "force") and known(2, "force") and known(0, "wrench")
    assert not known(0, "force") and not known(1) and not known(1, "wrench") and not known(1, "force", (0.2,))
    flat = strip(1e6)
    c, n = math.cos(0.3), math.sin(0.3)
    Q = T([[c, -n, 0.0], [n, c, 0.0], [0.0, 0.0, 1.0]])
    turned = replace(flat, rod=replace(flat.rod, K_bt=Q @ flat.rod.K_bt @ Q.mT))
    assert known(1, robot=flat) and not known(2, robot=flat) and not known(1, robot=turned) and not known(1, robot=strip(50.0))


@pytest.mark.many_fits
def test_intervals_of_a_wrench_at_the_tip_hold_as_often_as_they_say():
    """Force and moment bend the rod alike, and under a torque both turn: about one fit, draws held 84 % of 500."""
    problem, wrench = wrenched(150, 7)
    found = tr.sampled_intervals(problem, tr.estimate(problem)).tip
    assert found is not None
    held = (found[..., 0] <= wrench) & (wrench <= found[..., 1])
    assert float(held.double().mean()) > 0.91  # 0.90 about one fit, 0.88 by a prior that takes one of the two to be nothing


def test_fits_of_a_wrench_are_told_apart_by_its_moment_too():
    problem = wrenched(2)[0]
    x = torch.zeros(2, problem.size)
    x[1, problem.state.tip.at.stop - 1] = 0.5
    assert float((marks(problem, x)[1] - marks(problem, x)[0]).norm()) > 0.4


def test_the_spread_of_a_push_across_a_strip_is_of_both_signs():
    """Of all fits about the reported one, by their evidence; z of the force across was 2.4."""
    problem, force = across(60)
    fit = tr.estimate(problem)
    z = (fit.force[:, 0, 1] - force) / fit.load_covariance[:, 0, 1, 1].sqrt()
    assert float(z.square().mean().sqrt()) < 1.35
    one = PLAIN(problem, tr.Start.at(fit.x, tr.Origin.OTHER_FIT))
    others = fits_elsewhere(problem, one.x, PLAIN)
    assert others is not None
    other, of = others
    b = int(of[0])
    mine = (of == b).nonzero().squeeze(-1)
    both = cheapest(problem, one, PLAIN)
    m = problem.state.base.at.start
    x, C, cost = (torch.cat([getattr(one, name)[b : b + 1], getattr(other, name)[mine]]) for name in ("x", "covariance", "cost"))
    w = torch.softmax(0.5 * (torch.logdet(C[:, :m, :m]) - cost), 0)
    off = x - both.x[b]
    expected = (w[:, None, None] * (C + off.unsqueeze(-1) * off.unsqueeze(-2))).sum(0)
    assert torch.allclose(both.covariance[b], expected, rtol=1e-6, atol=1e-12 * float(expected.abs().max()))
    assert torch.allclose(both.load_covariance[b, 0, 1, 1], expected[1, 1] * problem.robot.rod.force_scale**2, rtol=1e-6)


def proposals() -> list[Proposal]:
    """Of two samples, in four coordinates, the third of which is a place."""
    g = torch.Generator().manual_seed(0)

    def student(m: int) -> Student:
        A = torch.randn(2, m, m, generator=g, dtype=torch.float64)
        return Student.of(0.3 * torch.randn(2, m, generator=g, dtype=torch.float64), A @ A.mT / m + 0.3 * torch.eye(m))

    share = torch.rand(2, 3, generator=g, dtype=torch.float64)
    cells = torch.rand(2, 8, generator=g, dtype=torch.float64)
    grid = OnGrid(student(3), torch.tensor([[2], [2]]), torch.tensor([0, 1, 3]), 8, cells / cells.sum(-1, keepdim=True))
    return [student(4), grid, Mixture([student(4) for _ in range(3)], share / share.sum(-1, keepdim=True))]


@pytest.mark.parametrize("which", [0, 1, 2])
def test_the_density_of_a_proposal_is_that_of_its_draws(which):
    """The mean of p / q over draws of q is one, q wider than p; and the draws' mean of a function is its integral by others."""
    p = proposals()[which]
    wide = Student.of(torch.zeros(2, 4), 6.0 * torch.eye(4).expand(2, 4, 4))
    v = wide.draw(2**15, 3)
    weight = (p.log_density(v) - wide.log_density(v)).exp()
    assert torch.allclose(weight.mean(-1), torch.ones(2), atol=0.05)
    u, w = torch.sigmoid(p.draw(2**13, 5)), torch.sigmoid(v)  # moments of pairs, too: the first two were once one number
    assert torch.allclose(u.mean(1), (weight.unsqueeze(-1) * w).mean(1), atol=0.02)
    assert torch.allclose(u.mT @ u / 2**13, (weight.unsqueeze(-1) * w).mT @ w / 2**15, atol=0.015)
    assert torch.equal(p.take(torch.tensor([1])).draw(64, 7)[0], p.draw(64, 7)[1])


def test_fits_along_a_valley_have_their_loads_in_the_order_of_the_reported_ones():
    """Draws in another order are none: they are the same explanation twice."""
    problem = compressed(3, 0.1, 0.55, 5)[0]
    loads = tr.GaussianCoordinates(2, 0.4, problem.robot.rod.force_scale, "point")
    problem = problem.of(tr.Unknowns(loads, "force"))
    fit = tr.estimate(problem)
    found = valley(problem, fit.x, fit.covariance, PLAIN)
    first, second = found.x[..., 2], found.x[..., 2 + loads.per_load]
    assert bool((((second - first) * (fit.x[:, 2 + loads.per_load] - fit.x[:, 2]).unsqueeze(-1)) >= 0)[found.sound].all())
    assert torch.allclose(found.C, found.C.mT, atol=1e-9 * float(found.C.abs().max()))


def test_the_units_of_the_unknowns_do_not_move_the_valley():
    """Of a rod a thousand times as soft: once F was held to 1e-3 N, which is a force scale there."""
    stiff = compressed(4, 0.1, 0.55, 5)[0]
    rod = stiff.robot.rod
    soft = replace(stiff.robot, rod=replace(rod, K_bt=1e-3 * rod.K_bt, K_se=1e-3 * rod.K_se))
    unknowns = tr.Unknowns(tr.GaussianCoordinates(1, rod.length, soft.rod.force_scale, "point"), "force")
    widths = []
    for scaled in (True, False):
        own = tr.Problem(soft, replace(unknowns, scaled=scaled), stiff.sensors)
        fit, line = tr.estimate(own), line_of(own)
        assert line is not None and math.isclose(line.unit, 1.0 if scaled else soft.rod.force_scale)
        found = valley(own, fit.x, fit.covariance, PLAIN)
        off = (found.x[..., line.entry, None] - line.knots).abs().amin(-1) / line.unit
        assert float((off < 5e-3)[found.sound].double().mean()) > 0.8
        drawn = tr.sampled_intervals(own, fit).tip
        assert drawn is not None
        widths.append(drawn[:, :3, 1] - drawn[:, :3, 0])
    assert float((widths[1] / widths[0]).log().abs().median()) < 0.3


@pytest.mark.parametrize("faint", [1e-5, 0.01, BUCKLES, GIVES_WAY, TWISTS])
def test_the_prior_of_a_size_is_a_density(faint):
    F = torch.cat([-torch.logspace(2, -9, 4000), torch.logspace(-9, 2, 4000)])
    p = _log_size(F.unsqueeze(-1), 10.0, faint).exp()
    assert abs(float(torch.trapezoid(p, F)) - 1) < 1e-3


def test_the_prior_of_a_push_across_a_strip_does_not_know_the_soft_side():
    """It is even up to what makes the strip give way; one size for both sides took what is across to be as little as the other."""
    problem, _ = across(1)
    fit = tr.estimate(problem)
    chart = Chart.at(problem, fit.x)
    y = fit.x[:, None, : chart.size].expand(1, 4, -1).clone()
    y[0, :, :2] = T([[1e-3, 0.1], [1e-3, 0.5], [1e-2, 0.1], [1e-2, 0.5]])
    p = chart.log_prior(y)[0]
    assert abs(float(p[1] - p[0])) < 0.15
    assert abs(float((p[3] - p[2]) - (p[1] - p[0]))) < 1e-9


@pytest.mark.parametrize("unit", [1.0, 0.05, 30.0])
def test_a_prior_of_sizes_is_a_density_of_the_entries_in_whatever_unit(unit):
    """Its integral over one entry, or two, is one."""
    one = torch.cat([-(t := torch.logspace(-7, 3, 4001, dtype=torch.float64)).flip(0), t]) / unit
    density = _Sized([0], 10.0, FAINT, unit=unit).log_prior(one.unsqueeze(-1)).exp()
    assert math.isclose(float(torch.trapezoid(density, one)), 1.0, rel_tol=1e-3)
    ring = torch.nn.functional.pad(t.unsqueeze(-1) / unit, (0, 1))  # of two, by the distance from zero
    density = _Sized([0, 1], 10.0, FAINT, unit=unit).log_prior(ring).exp()
    assert math.isclose(float(torch.trapezoid(2 * math.pi * ring[:, 0] * density, ring[:, 0])), 1.0, rel_tol=1e-3)


@pytest.mark.parametrize("kind", ["tip", "strip", "wrench"])
def test_draws_start_from_the_nearest_fit_along_the_valley(kind):
    problem = of_kind(kind, 4)
    fit = tr.estimate(problem)
    target = _Target(problem, fit.x, fit.covariance, math.inf, True)
    own, (B, S) = target.valley, target.valley.sound.shape
    rows = torch.arange(B).repeat_interleave(S)
    found = target._nearest(own.x.flatten(0, 1)[:, : target.chart.size], rows).unflatten(0, (B, S))
    away = (marks(problem, own.x.gather(1, found.unsqueeze(-1).expand_as(own.x))) - marks(problem, own.x)).norm(dim=-1)
    assert bool((away < 1e-9)[own.sound].all()) and bool(own.sound.gather(1, found).all())
    assert len(found[own.sound].unique()) > 6
