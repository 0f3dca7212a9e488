"""Where the estimator meets its limits: fine noise, flat backbones, strong pushes, steps too long for a load, unstable equilibria.

Kinds, not cases: random members of each, made by a finer march than the one that fits.
"""

import json
import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.conftest import SHARED
from tests.robots import T, steel_rod
from torchrod import (
    BaseWrench,
    GaussianCoordinates,
    GaussianLoads,
    Markers,
    PointForces,
    PointWrenches,
    Problem,
    Robot,
    Rod,
    Settings,
    Tendon,
    Tendons,
    Unknowns,
    analyze,
    estimate,
    sampled_intervals,
    solve_shape,
)
from torchrod.analysis.alternatives import read_at_few_places
from torchrod.cli import main
from torchrod.estimation import checks
from torchrod.mechanics.loads import on_rod_fraction

L = 0.25


def strip(ratio: float) -> Robot:
    """A backbone that bends `ratio` times as easily along x as along y."""
    K_bt = 0.01 * torch.diag(T([ratio**0.5, ratio**-0.5, 0.5]))
    return Robot(Rod(L, torch.diag(T([2e5, 2e5, 6e5])), K_bt, T(0.0), torch.zeros(1, 4)), Tendons(()), torch.zeros(3))


def pushed_along_x(robot: Robot, B: int, generator: torch.Generator) -> tuple[Tensor, Tensor, tuple[GaussianLoads]]:
    """Forces of 0.3 to 2.3 soft force scales, within 9 degrees of x, as narrow Gaussians: their size, place and load."""
    soft = 4 * float(robot.rod.K_bt[1, 1]) / L**2
    size, place = soft * (0.3 + 2 * torch.rand(B, 1, generator=generator)), L * (0.3 + 0.5 * torch.rand(B, 1, generator=generator))
    turn = 0.3 * (torch.rand(B, 1, generator=generator) - 0.5)
    force = torch.stack([size * turn.cos(), size * turn.sin()], -1)
    c = 0.5 / (L / 40) ** 2 * torch.randn(B, 1, generator=generator).exp()
    spread = (math.pi / c).sqrt() * on_rod_fraction(place, c, L)
    return force, place, (GaussianLoads(force / spread.unsqueeze(-1), place, c),)


@pytest.mark.parametrize("noise", [1e-6, 1e-4])
@pytest.mark.parametrize("ratio", [1.0, 1e3, 1e6])
def test_no_slack_at_the_tip_takes_up_a_load(ratio, noise):
    """z scores of one, whatever the noise (of L) and the ratio of the stiffnesses. The slack once had 2 to 4 at fine noise."""
    robot, generator, B = strip(ratio), torch.Generator().manual_seed(1), 60
    force, place, load = pushed_along_x(robot, B, generator)
    s = torch.linspace(L / 20, L, 20)
    p = solve_shape(robot, load, None, s, B, steps=160).p
    p = p + noise * L * torch.randn(p.shape, generator=generator)
    fit = estimate(Problem(robot, Unknowns(GaussianCoordinates(1, L, robot.rod.force_scale)), [Markers(s, p, noise * L)]))
    assert fit.accepted.all()
    along_x = (fit.force - force)[..., 0] / fit.load_covariance[..., 0, 0].sqrt()
    for z in (along_x, (fit.location - place) / fit.location_std):
        assert 0.75 < float(z.square().mean().sqrt()) < 1.25


def test_pushes_along_the_soft_side_of_a_flat_backbone_are_found():
    """A thousandth of the rod's force scale, which is that of both sides together: 31 of 40 once."""
    robot, generator, B = strip(1e6), torch.Generator().manual_seed(11), 40
    _, _, load = pushed_along_x(robot, B, generator)
    s = torch.linspace(L / 20, L, 20)
    p = solve_shape(robot, load, None, s, B, steps=160).p
    markers = Markers(s, p + 1e-2 * L * torch.randn(p.shape, generator=generator), 1e-2 * L)
    fit = estimate(Problem(robot, Unknowns(GaussianCoordinates(1, L, robot.rod.force_scale)), [markers]))
    assert fit.accepted.sum() >= 36


@pytest.mark.parametrize("noise", [1e-4, 1e-6, 1e-9, 1e-12])
@pytest.mark.parametrize("kind", ["round", "curved", "tendons"])
def test_exact_markers_are_explained_whatever_noise_is_stated(kind, noise):
    """Neither round-off nor the steps nor a prior on the width, which is far off for point forces, decides the verdict."""
    generator, B = torch.Generator().manual_seed(7), 6
    rod = Rod.circular(0.6, 0.002, 207e9, 79e9, 0.2, T([[0.0, 1.5, 0.5, 0.0], [0.6, 0.0, 1.5, 0.0]]) if kind == "curved" else None)
    robot, tension = Robot(rod), None
    if kind == "tendons":
        sides = (Tendon.straight(0.015, 0.0, 0.6), Tendon.straight(0.0, 0.015, 0.35), Tendon.straight(-0.015, 0.0, 0.6))
        robot = Robot(rod, Tendons(sides), T([0.0, 6.9, 6.9]))
        tension = 20 * torch.rand(B, 3, generator=generator)
    s, size = torch.linspace(0.03, 0.6, 20), rod.force_scale * (0.3 + 2 * torch.rand(B, 1, generator=generator))
    turn, place = 2 * math.pi * torch.rand(B, 1, generator=generator), 0.6 * (0.3 + 0.65 * torch.rand(B, 1, generator=generator))
    force = torch.stack([size * turn.cos(), size * turn.sin(), 0 * size], -1)
    p = solve_shape(robot, (PointForces(force, place),), tension, s, B, steps=1280).p
    unknowns = Unknowns(GaussianCoordinates(1, 0.6, rod.force_scale))
    fit = estimate(Problem(robot, unknowns, [Markers(s, p, noise)], tension))
    assert fit.accepted.all()
    assert ((fit.location - place).abs() < (5e-3 if noise > 1e-5 else 5e-4)).all()


def test_the_tip_is_in_balance_at_the_answer():
    """c of the answer in force and moment scales, where one in a thousand was allowed."""
    robot, generator = strip(1e4), torch.Generator().manual_seed(2)
    _, _, load = pushed_along_x(robot, 20, generator)
    s = torch.linspace(L / 20, L, 20)
    problem = Problem(
        robot,
        Unknowns(GaussianCoordinates(1, L, robot.rod.force_scale)),
        [Markers(s, solve_shape(robot, load, None, s, 20).p, 5e-4)],
    )
    c = problem.h(estimate(problem).x)[:, -6:] / problem.state.base.unit
    assert float(c.abs().max()) < 1e-6


def curved_rod() -> Robot:
    """Bends ever more towards its tip, in a plane that turns."""
    s = torch.linspace(0, 0.4, 41)
    rows = torch.stack([s, 20 * s, torch.full_like(s, -3.0), torch.full_like(s, 2.0)], -1)
    return Robot(replace(steel_rod().rod, mass_per_length=T(0.0122), reference_curvature=rows), Tendons(()), T([0.0, -9.81, 0.0]))


def test_strong_pushes_on_a_pre_curved_rod_are_found():
    """Up to five force scales: a rod that a push has wrapped around has several shapes with like residuals on the way."""
    robot, s, B, generator = curved_rod(), torch.linspace(0.02, 0.4, 20), 48, torch.Generator().manual_seed(3)
    size = robot.rod.force_scale * (0.5 + 4.5 * torch.rand(B, 1, generator=generator))
    turn, place = 2 * math.pi * torch.rand(B, 1, generator=generator), 0.4 * (0.2 + 0.78 * torch.rand(B, 1, generator=generator))
    force = torch.stack([size * turn.cos(), size * turn.sin(), torch.zeros_like(size)], -1)
    p = solve_shape(robot, (PointForces(force, place),), None, s, B).p
    p = p + 4e-4 * torch.randn(p.shape, generator=generator)
    problem = Problem(robot, Unknowns(GaussianCoordinates(1, 0.4, robot.rod.force_scale)), [Markers(s, p, 4e-4)])
    fit, once = estimate(problem), estimate(problem, Settings(basins=0))
    assert int(fit.accepted.sum()) >= B - 1 > int(once.accepted.sum())
    found = fit.accepted
    assert float(((fit.location - place) / fit.location_std)[found].abs().max()) < 4


@pytest.mark.parametrize("noise", [1e-3, 1e-4, 1e-5])
def test_exact_markers_converge_whatever_noise_is_stated(noise):
    """Point forces of up to three force scales, read without error."""
    robot, s, B, generator = steel_rod(), torch.linspace(0.02, 0.4, 20), 60, torch.Generator().manual_seed(4)
    size = robot.rod.force_scale * torch.logspace(-1.3, 0.5, B).unsqueeze(-1)
    force = torch.stack([size, torch.zeros_like(size), torch.zeros_like(size)], -1)
    place = 0.4 * (0.25 + 0.72 * torch.rand(B, 1, generator=generator))
    p = solve_shape(robot, (PointForces(force, place),), None, s, B, 160).p
    fit = estimate(Problem(robot, Unknowns(GaussianCoordinates(1, 0.4, robot.rod.force_scale)), [Markers(s, p, noise)]))
    assert fit.accepted.all()


def test_steps_follow_the_load_and_the_noise():
    """Four force scales, fine noise: 40 steps are not enough, and the fit takes more."""
    robot, s = steel_rod(), torch.linspace(0.02, 0.4, 20)
    force, place = T([[[4.0, 1.0, 0.0]]]), T([[0.3]])
    p = solve_shape(robot, (PointForces(force, place),), None, s, 1, 640).p
    sensors = [Markers(s, p + 1e-6 * torch.randn(p.shape, generator=torch.Generator().manual_seed(5)), 1e-6)]
    problem = Problem(robot, Unknowns(GaussianCoordinates(1, 0.4, robot.rod.force_scale, "point")), sensors, steps=40)
    fit = estimate(problem)
    assert fit.accepted.all()
    assert not checks.follows(problem, fit.x).any()
    assert checks.follows(problem.with_steps(320), fit.x).all()


def test_a_load_that_no_steps_follow_is_refused(monkeypatch):
    robot, s = steel_rod(), torch.linspace(0.02, 0.4, 20)
    p = solve_shape(robot, (PointForces(T([[[4.0, 1.0, 0.0]]]), T([[0.3]])),), None, s, 1, 640).p
    monkeypatch.setattr(checks, "MOST_STEPS", 40)
    fit = estimate(Problem(robot, Unknowns(GaussianCoordinates(1, 0.4, robot.rod.force_scale, "point")), [Markers(s, p, 1e-6)]))
    assert fit.coarse.all() and not fit.accepted.any()
    assert "too sharply" in fit.message(0)


def test_an_unstable_equilibrium_is_said():
    """A column under 1.5 and 0.5 times Euler's load, straight: in equilibrium both, at rest only one."""
    robot, s = steel_rod(), torch.linspace(0.02, 0.4, 20)
    euler = math.pi**2 / 4 * robot.rod.bending_stiffness / 0.4**2
    straight = torch.stack([torch.zeros(20), torch.zeros(20), s], -1).expand(2, -1, -1)
    for times, holds in ((1.5, False), (0.5, True)):
        problem = Problem(robot, Unknowns(GaussianCoordinates(0, 0.4, 1.0), tip="force"), [Markers(s, straight, 1e-3)])
        x = problem.state.join(torch.zeros(2, 0), torch.zeros(2, 6))
        wrench = T([0.0, 0.0, -times * euler])
        x[:, problem.state.tip.at] = wrench / problem.state.tip.unit
        x[:, problem.state.base.at.start : problem.state.base.at.start + 3] = wrench / problem.state.base.unit[:3]
        assert (checks.stable(problem, x) == holds).all()
        lateral = (PointWrenches(wrench.view(1, 1, 3), torch.zeros(1, 1, 3), T([0.4])),)
        if holds:
            assert solve_shape(robot, lateral, None, s, 1).stable.all()


def test_the_other_solutions_of_a_tip_pose():
    """A rod whose tip is held nearer to its base, upright, bends to either side: the mirror image is told with its wrench."""
    rod = Rod.circular(0.5, 0.002, 200e9, 80e9)
    robot, offsets = Robot(rod), 0.02 * torch.cat([torch.zeros(1, 3), torch.eye(3)])
    tip = T([0.0, -0.05, 0.4]) + offsets
    sensors = [Markers(torch.full((4,), 0.5), tip.unsqueeze(0), 1e-4, offsets)]
    problem = Problem(robot, Unknowns(GaussianCoordinates(0, 0.5, rod.force_scale), tip="wrench"), sensors)
    assert "explained as well by a force" in analyze(problem).message(0)
    found = analyze(problem, settings=Settings(sized=False))  # of the sizes of the wrench the one in the plane may be the best
    assert found.estimate.accepted.all() and found.estimate.tip is not None
    mirrored = found.estimate.tip[0] * T([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0])
    (others,) = found.diagnosis.others
    wrenches = torch.stack([other.tip for other in others if other.tip is not None])
    nearest = int((wrenches - mirrored).norm(dim=-1).argmin())
    assert torch.allclose(wrenches[nearest], mirrored, atol=1e-2 * float(mirrored.abs().max()))
    assert abs(others[nearest].chi2 - float(found.estimate.chi2)) < 0.1
    assert "explained as well by a force" in found.message(0)
    spread = replace(sensors[0], s=T([0.2, 0.3, 0.4, 0.5]))
    assert not read_at_few_places(replace(problem, sensors=[spread])).any()


@pytest.mark.parametrize("options", [(), ("--contacts", "auto")])
def test_the_flat_strip_of_the_handed_case(options, tmp_path, capsys):
    """0.02 N at 200 mm bends the tip by 35 mm; "no load" once."""
    case = SHARED.parent / "faults" / "07_flat_strip_no_load"
    if not case.is_dir():
        pytest.skip("../shared is not there")
    out = tmp_path / "r.json"
    assert (
        main(["estimate", str(case / "robot.toml"), str(case / "shape.csv"), "--noise", "5e-4", *options, "--out", str(out)]) == 0
    )
    (load,) = json.loads(out.read_text())["results"][0]["loads"]
    capsys.readouterr()
    assert abs(load["force_local_N"][0] - 0.02) < 0.001
    assert abs(load["location_m"] - 0.2) < 2 * load["std"]["location_m"]


@pytest.mark.study
def test_draws_of_a_flat_backbone_hold_the_force_along_its_soft_side():
    """The other component hardly shows, and is next to nothing: 24 to 39 % of |F| once."""
    robot, generator, B = strip(1e6), torch.Generator().manual_seed(11), 96
    force, place, load = pushed_along_x(robot, B, generator)
    s = torch.linspace(L / 20, L, 20)
    p = solve_shape(robot, load, None, s, B, steps=160).p
    p = p + 1e-3 * L * torch.randn(p.shape, generator=generator)
    problem = Problem(robot, Unknowns(GaussianCoordinates(1, L, robot.rod.force_scale)), [Markers(s, p, 1e-3 * L)])
    fit = estimate(problem)
    drawn = sampled_intervals(problem, fit)
    for truth, interval in ((force.norm(dim=-1), drawn.magnitude), (force[..., 0], drawn.force[:, :, 0]), (place, drawn.location)):
        inside = (truth >= interval[..., 0]) & (truth <= interval[..., 1])
        assert float(inside[fit.accepted].double().mean()) > 0.88


def test_there_are_no_draws_where_nothing_has_converged():
    """Once an error of a reshape."""
    robot, generator = strip(1.0), torch.Generator().manual_seed(1)
    _, _, load = pushed_along_x(robot, 3, generator)
    s = torch.linspace(L / 20, L, 20)
    p = solve_shape(robot, load, None, s, 3, steps=80).p
    problem = Problem(robot, Unknowns(GaussianCoordinates(1, L, robot.rod.force_scale)), [Markers(s, p, 1e-3)])
    fit = estimate(problem, Settings(max_iterations=1, restarts=(), basins=0))
    assert not fit.accepted.any()
    assert sampled_intervals(problem, fit).magnitude.isnan().all()


def test_a_push_across_a_strip_has_both_signs_unless_the_base_is_read():
    """Markers see how the soft side gives way, which is alike for both: one sign was once reported as if it were known."""
    robot, generator, B = strip(1e6), torch.Generator().manual_seed(3), 24
    scale = robot.rod.force_scale
    across = scale * (0.4 + 0.6 * torch.rand(B, generator=generator)) * torch.tensor([1.0, -1.0]).repeat(B // 2)
    soft = 1e-3 * scale * (1 + torch.rand(B, generator=generator))
    force, place = torch.stack([soft, across], -1), L * (0.5 + 0.3 * torch.rand(B, 1, generator=generator))
    s = torch.linspace(L / 20, L, 20)
    shape = solve_shape(robot, (PointForces(torch.nn.functional.pad(force, (0, 1)).unsqueeze(1), place),), None, s, B, steps=160)
    p = shape.p + 1e-4 * L * torch.randn(shape.p.shape, generator=generator)
    unknowns = Unknowns(GaussianCoordinates(1, L, scale, "point"))
    markers = Markers(s, p, 1e-4 * L)
    problem = Problem(robot, unknowns, [markers])
    found = analyze(problem, sampled=True)
    assert found.estimate.accepted.all() and found.intervals is not None
    low, high = found.intervals.force[:, 0, 1].unbind(-1)
    held = (low <= across) & (across <= high)
    told = torch.tensor([len(others) > 0 for others in found.diagnosis.others])
    assert held.double().mean() > 0.85
    assert (
        low * high < 0
    ).double().mean() > 0.85  # 67 % of draws about one fit; a push that hardly shows has one broad fit for both
    assert told.double().mean() > 0.3
    assert bool((low * high < 0)[told].all())
    assert "measure the force under the base" in found.message(int(told.nonzero()[0]))
    base = BaseWrench(shape.base_wrench, 0.05 * scale, 0.05 * scale * L)
    known = analyze(Problem(robot, unknowns, [markers, base]))
    assert ((known.estimate.force[:, 0, 1] > 0) == (across > 0)).all()
    assert not any(known.diagnosis.others)
