"""Actuation by displacement: paths are as long as they were left, slack tendons carry nothing, tensions give the shape back."""

import math

import pytest
import torch

from tests.robots import T, busy_robot
from torchrod import PointForces, Robot, Rod, Tendon, Tendons, reference_lengths, solve_displacement, solve_shape
from torchrod.mechanics.actuation import _secant

S = torch.linspace(0.05, 0.4, 8, dtype=torch.float64)


def one_tendon(gravity=(9.81, 0.0, 0.0)) -> Robot:
    return Robot(Rod.circular(0.4, 1.4e-3, 207e9, 79e9, 0.144), Tendons((Tendon.straight(7e-3, 0.0, 0.4),)), T(gravity))


def test_a_straight_tendon_is_as_long_as_its_rod_and_a_helix_longer():
    lengths = reference_lengths(busy_robot())
    slope = 12 * 0.007
    assert abs(float(lengths[0]) - 0.4 * math.hypot(1, slope)) < 2e-6, "the routing is a spline through 15 points of the helix"
    assert abs(float(lengths[1]) - 0.23) < 1e-12


def test_constant_curvature():
    """Without gravity a tendon at r bends the rod to a circle: u = tau r / EI, and the path is (1 - r u + axial strain) e."""
    robot = one_tendon((0.0, 0.0, 0.0))
    answer = solve_displacement(robot, (), T([[5e-3]]), S)
    tau, r = float(answer.tension[0, 0]), 7e-3
    EI, EA = float(robot.rod.K_bt[1, 1]), float(robot.rod.K_se[2, 2])
    assert abs(0.4 * (r * tau * r / EI + tau / EA) - 5e-3) < 1e-9
    assert abs(float(answer.path[0, 0]) - 0.395) < 1e-9


@pytest.mark.many_fits
def test_what_was_pulled_is_what_the_tension_gives():
    """Every sample has its own load; the solved tensions, put into the forward solve, give the same shape and path."""
    robot = Robot(busy_robot().rod, busy_robot().tendons, T([9.81, 0.0, 0.0]))
    push = PointForces(T([[[0.5, 0.2, 0.0]], [[-0.3, 0.4, 0.0]], [[0.0, 0.0, 0.0]]]), T([[0.2], [0.3], [0.1]]))
    d = T([[3e-3, 1e-3], [1e-3, 4e-3], [5e-3, -1e-2]])
    answer = solve_displacement(robot, (push,), d, S)
    again = solve_shape(robot, (push,), answer.tension, S, 3)
    assert (answer.equilibrium.p - again.p).abs().max() < 1e-7
    gap = reference_lengths(robot) - d - answer.path
    assert torch.where(answer.slack, 0.0, gap).abs().max() < 1e-9
    assert (gap > -1e-9).all(), "no path is longer than what the motor leaves"
    assert bool(answer.slack[2, 1])
    assert (answer.tension[answer.slack] == 0).all()


@pytest.mark.many_fits
def test_a_sample_does_not_depend_on_its_batch():
    robot, d = one_tendon(), T([[2e-3], [11e-3], [torch.nan], [-1e-3]])
    together = solve_displacement(robot, (), d, S)
    assert torch.isnan(together.tension[2]).all()
    for b in (0, 1, 3):
        alone = solve_displacement(robot, (), d[b : b + 1], S)
        assert (alone.tension[0] - together.tension[b]).abs().max() < 1e-9
        assert (alone.equilibrium.p[0] - together.equilibrium.p[b]).abs().max() < 1e-9


def test_displacements_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="one per tendon"):
        solve_displacement(one_tendon(), (), T([[1e-3, 1e-3]]), S)


def antagonists() -> tuple[torch.Tensor, torch.Tensor]:
    """Pulls of two tendons at right angles, paid out opposite, and gravity from everywhere."""
    generator = torch.Generator().manual_seed(12)
    pull = 0.016 * torch.rand(24, 2, generator=generator, dtype=torch.float64)
    pull[::5, 0] = 0.0
    pull[1::7, 1] = pull[1::7, 0]
    gravity = torch.nn.functional.normalize(torch.randn(24, 3, generator=generator, dtype=torch.float64), dim=-1)
    return torch.cat([pull, -pull], -1), 9.81 * gravity


@pytest.mark.many_fits
def test_antagonists_pulled_and_paid_out_by_the_same_length():
    """(1) holds: no path is too long, what is slack carries nothing, and the tensions give the shape back."""
    d, gravity = antagonists()
    tendons = tuple(Tendon.straight(x, y, 0.5) for x, y in ((0.015, 0.0), (0.0, 0.015), (-0.015, 0.0), (0.0, -0.015)))
    robot = Robot(Rod.circular(0.5, 0.002, 200e9, 80e9, 0.0251), Tendons(tendons), gravity)
    answer = solve_displacement(robot, (), d, T([0.25, 0.5]))
    assert (answer.equilibrium.status == 0).all()
    gap = 0.5 - d - answer.path
    assert (gap > -1e-9).all()
    assert (answer.tension >= 0).all()
    assert torch.minimum(answer.tension / 100, gap).abs().max() < 1e-9
    again = solve_shape(robot, (), answer.tension, T([0.25, 0.5]), len(d))
    assert (answer.equilibrium.p - again.p).abs().max() < 1e-6


def test_the_pair_that_was_refused():
    """An independent solver, DOP853 and shooting: 15.989, 16.626, 0, 0 N, tip (182.57, 177.80, 399.85) mm."""
    tendons = tuple(Tendon.straight(x, y, 0.5) for x, y in ((0.01506, 0.0), (0.0, 0.01506), (-0.01506, 0.0), (0.0, -0.01506)))
    robot = Robot(Rod.circular(0.5, 0.002, 200e9, 80e9, 0.0251327412), Tendons(tendons), T([9.81, 0.0, 0.0]))
    answer = solve_displacement(robot, (), T([[0.012, 0.012, -0.012, -0.012]]), T([0.5]))
    assert (answer.tension[0] - T([15.989, 16.626, 0.0, 0.0])).abs().max() < 1e-3
    assert (answer.equilibrium.p[0, 0] - T([0.18257, 0.17780, 0.39985])).abs().max() < 1e-5


def test_a_secant_slope_foretells_the_last_change_and_nothing_else():
    g = torch.Generator().manual_seed(0)
    slope, step, change, other = (torch.randn(4, *shape, generator=g) for shape in ((3, 3), (3,), (3,), (3,)))
    step[3] = 0.0
    across = other - step * (other * step).sum(-1, keepdim=True) / step.square().sum(-1, keepdim=True).clamp(min=1e-30)
    found = _secant(slope, step, change)
    assert torch.allclose((found @ step.unsqueeze(-1)).squeeze(-1)[:3], change[:3])
    assert torch.allclose(found @ across.unsqueeze(-1), slope @ across.unsqueeze(-1))
    assert torch.equal(found[3], slope[3]), "no step says nothing"
