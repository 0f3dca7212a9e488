"""Stable equilibria: columns, heavy rods and tendon robots against shooting and boundary value problems by SciPy."""

import math
import time
from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import simpson, solve_bvp, solve_ivp
from scipy.optimize import brentq
from scipy.special import ellipk

from tests.problems import posed
from tests.robots import T, steel_rod
from torchrod import PointCoordinates, PointForces, PointWrenches, Robot, Rod, Status, Tendon, Tendons, solve_shape
from torchrod.estimation.at_rest import without_load
from torchrod.mechanics.statics import stable_at

L, EI = 0.4, 0.039
LENGTH = T([L])


def inextensible(weight: torch.Tensor, tendons: Tendons | None = None, flat: float = 1.0) -> Robot:
    """weight: N/m, base frame. flat: the other bending stiffness, over EI."""
    rod = Rod.from_stiffness(L, torch.eye(3) * 1e9, torch.diag(T([flat * EI, EI, 0.76 * EI])), 1.0)
    return Robot(rod, tendons or Tendons(), weight)


def planar(weight: np.ndarray, moment: float) -> np.ndarray:
    """Tip (x, z) of the elastica in the plane: EI th'' = -w (L - s) . (cos th, -sin th), EI th'(L) = moment.

    w in units of EI / L^3, the moment of EI / L; put on together from none, so that the branch is the one that begins there.
    """

    def rate(f: float):
        def inside(x, y):
            wx, wz = f * weight
            return np.vstack([y[1], -(1 - x) * (wx * np.cos(y[0]) - wz * np.sin(y[0]))])

        return inside

    x, y, solution = np.linspace(0, 1, 61), np.zeros((2, 61)), None
    for f in np.linspace(0, 1, 4 + int(6 * np.linalg.norm(weight)))[1:]:
        solution = solve_bvp(rate(f), lambda a, b, f=f: np.array([a[0], b[1] - f * moment]), x, y, tol=1e-7, max_nodes=100_000)
        assert solution.success
        x, y = solution.x, solution.y
    assert solution is not None
    angle = solution.sol(np.linspace(0, 1, 4001))[0]
    return L * np.array([simpson(np.sin(angle), dx=1 / 4000), simpson(np.cos(angle), dx=1 / 4000)])


def leaning(force: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The same tip by shooting, for a load with a share towards +x.

    One solution has a tip's angle between 0 and the load's own: the branch that begins without load.
    """

    def march(a: np.ndarray) -> np.ndarray:
        """The angle at the base, its rate, x and z for every angle of the tip."""

        def rate(x, y):
            angle, turn = y.reshape(4, -1)[:2]
            Fx, Fz = (force[i] + weight[i] * (1 - x) for i in (0, 1))
            return np.concatenate([turn, -(Fx * np.cos(angle) - Fz * np.sin(angle)), np.sin(angle), np.cos(angle)])

        begin = np.concatenate([a, np.zeros(3 * len(a))])
        return solve_ivp(rate, (1.0, 0.0), begin, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1].reshape(4, -1)

    load = force + weight
    angles = np.linspace(1e-9, math.atan2(load[0], load[1]), 120)
    missed = march(angles)[0]
    (roots,) = np.nonzero(missed[1:] * missed[:-1] < 0)
    assert len(roots) == 1
    a = brentq(lambda a: march(np.array([a]))[0, 0], angles[roots[0]], angles[roots[0] + 1], xtol=1e-13)
    return -L * march(np.array([a]))[2:, 0]


def solved(robot: Robot, force=(0.0, 0.0, 0.0), tension=None):
    load = PointWrenches(T([[list(map(float, force))]]), torch.zeros(1, 1, 3), LENGTH)
    return solve_shape(robot, (load,), tension, LENGTH, 1)


def aside(p: torch.Tensor, azimuth: float) -> np.ndarray:
    return np.array([float(p[0]) * math.cos(azimuth) + float(p[1]) * math.sin(azimuth), float(p[2])])


def some(cases: list[tuple[float, float, float]]) -> list[Any]:
    """All of them; a plain run takes every other one."""
    return [pytest.param(*case, marks=pytest.mark.study if i % 2 else ()) for i, case in enumerate(cases)]


def euler_columns() -> list[Any]:
    rng = np.random.default_rng(2)
    return some([(rng.uniform(0.5, 5), 10 ** rng.uniform(-2.3, -0.5), rng.uniform(0, 2 * math.pi)) for _ in range(10)])


@pytest.mark.parametrize(("times", "share", "azimuth"), euler_columns())
def test_a_column_bends_with_the_side_force(times, share, azimuth):
    """0.5 to 5 times the critical load pi^2 EI / 4 L^2, a share of it sideways."""
    P = times * math.pi**2 / 4
    found = solved(
        inextensible(torch.zeros(3)), EI / L**2 * P * np.array([share * math.cos(azimuth), share * math.sin(azimuth), -1.0])
    )
    assert found.stable[0]
    assert found.status[0] == Status.CONVERGED
    exact = leaning(P * np.array([share, -1.0]), np.zeros(2))
    assert np.abs(aside(found.p[0, 0], azimuth) - exact).max() < 2e-6


@pytest.mark.parametrize("times", [0.5, 0.99, 1.001, 1.1, 1.5, 3.0, 5.0])
def test_a_column_without_a_side_force(times):
    """Straight up to the critical load, then the elastica: sqrt(P L^2 / EI) = K(sin(a / 2)), elliptic, a the tip's angle."""
    P = times * math.pi**2 / 4
    found = solved(inextensible(torch.zeros(3)), [0.0, 0.0, -P * EI / L**2])
    assert found.stable[0]
    low, high = 0.0, 1 - 1e-12
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if ellipk(middle) < math.sqrt(P) else (low, middle)
    deflection = 2 * math.sqrt(low) / math.sqrt(P) * L if times > 1 else 0.0
    assert abs(float(found.p[0, 0, :2].norm()) - deflection) < 1e-5
    assert float(found.p[0, 0, 0]) >= 0, "where nothing else decides, towards +x"


def test_the_straight_column_is_stable_up_to_the_critical_load_and_no_further():
    """Round, and flat: there the other direction has its own, higher load."""
    for flat in (1.0, 6.0):
        robot, upright = inextensible(torch.zeros(3), flat=flat), T([[0.0, 0.0, 0.0, 1.0]])
        for times in (0.5, 0.98, 1.02, 2.0, 5.0, 8.98, 9.02):
            load = PointWrenches(T([[[0.0, 0.0, -times * math.pi**2 / 4 * EI / L**2]]]), torch.zeros(1, 1, 3), LENGTH)
            assert bool(stable_at(robot, (load,), None, upright)[0]) == (times < 1), (flat, times)
    pulled = PointWrenches(T([[[0.0, 0.0, 5.0]]]), torch.zeros(1, 1, 3), LENGTH)
    assert stable_at(inextensible(torch.zeros(3)), (pulled,), None, T([[0.0, 0.0, 0.0, 1.0]]))[0]


def heavy_columns() -> list[Any]:
    rng = np.random.default_rng(8)
    tilts = [rng.uniform(0, math.pi) if i % 2 else 10 ** rng.uniform(-2.5, -0.5) for i in range(10)]
    cases = [(rng.uniform(1, 20), tilt, rng.uniform(0, 2 * math.pi)) for tilt in tilts]
    return some(cases[:5] + cases[6:] + cases[5:6])  # of both kinds of tilt in a plain run


@pytest.mark.parametrize(("load", "tilt", "azimuth"), heavy_columns())
def test_a_heavy_column_falls_the_way_it_leans(load, tilt, azimuth):
    """w L^3 / EI up to 20 at any tilt."""
    way = T([math.sin(tilt) * math.cos(azimuth), math.sin(tilt) * math.sin(azimuth), -math.cos(tilt)])
    found = solved(inextensible(load * EI / L**3 * way))
    assert found.stable[0]
    exact = leaning(np.zeros(2), load * np.array([math.sin(tilt), -math.cos(tilt)]))
    assert np.abs(aside(found.p[0, 0], azimuth) - exact).max() < 2e-6


def test_an_upright_column_stands_to_its_own_critical_weight():
    """7.837 (Greenhill)."""
    for load, stands in ((7.8, True), (7.87, False), (20.0, False)):
        robot = inextensible(T([0.0, 0.0, -load * EI / L**3]))
        assert bool(stable_at(robot, (), None, T([[0.0, 0.0, 0.0, 1.0]]))[0]) == stands
        found = solved(robot)
        assert found.stable[0]
        assert (float(found.p[0, 0, :2].norm()) < 1e-6) == stands


def tendon_robots() -> list[Any]:
    rng = np.random.default_rng(5)
    return some([(rng.uniform(2, 15), rng.uniform(-math.pi, math.pi), rng.uniform(0.1, 1.5)) for _ in range(8)])


@pytest.mark.parametrize(("load", "tilt", "bend"), tendon_robots())
def test_a_tendon_robot_with_gravity(load, tilt, bend):
    """A straight tendon at offset r bends an inextensible rod like a moment tau r at the tip: in the plane of tendon and weight."""
    r = 8e-3
    weight = load * EI / L**3 * T([math.sin(tilt), 0.0, -math.cos(tilt)])
    robot = inextensible(weight, Tendons((Tendon.straight(r, 0.0, L),)))
    found = solved(robot, tension=T([[bend * EI / L / r]]))
    # The tension is on before the weight is, here; and together with it in `planar`: the same where neither branch ends.
    exact = planar(load * np.array([math.sin(tilt), -math.cos(tilt)]), bend)
    if found.status[0] == Status.CONVERGED:
        assert found.stable[0]
        assert np.abs(aside(found.p[0, 0], 0.0) - exact).max() < 5e-6
    else:
        assert not found.stable[0]


def test_gradients_flow():
    """Through both directions of the march and through the tip's orientation, kernel or not; torch.func is refused."""
    robot, s = steel_rod(), T([0.2, 0.4])

    def energy(force: torch.Tensor, push: torch.Tensor, K_bt: torch.Tensor) -> torch.Tensor:
        rod = Rod(0.4, robot.rod.K_se, K_bt, T(0.1), robot.rod.reference_curvature)
        loads = (
            PointWrenches(force.reshape(1, 1, 3), torch.zeros(1, 1, 3), LENGTH),
            PointForces(torch.cat([push, T([0.0])]).reshape(1, 1, 3), T([[0.3]])),
        )
        shape = solve_shape(Robot(rod, Tendons(), T([9.81, 0.0, 0.0])), loads, None, s, 1)
        return (shape.p * T([[1.0, -2.0, 0.5], [0.3, 1.0, 2.0]])).sum() + 0.1 * shape.base_wrench.sum()

    at = [T([0.3, 0.2, -0.4]), T([0.2, -0.1]), robot.rod.K_bt.clone()]
    leaves = [x.clone().requires_grad_() for x in at]
    energy(*leaves).backward()
    for i, x in enumerate(at):
        gradient = leaves[i].grad
        assert gradient is not None
        for j in ((1,), (0,)) if x.ndim == 1 else ((0, 0), (2, 2)):
            step = 1e-4 * float(x[j].abs())
            moved = [[y.clone() for y in at] for _ in range(2)]
            moved[0][i][j] += step
            moved[1][i][j] -= step
            slope = float(energy(*moved[0]) - energy(*moved[1])) / (2 * step)
            assert float(gradient[j]) == pytest.approx(slope, rel=1e-5, abs=1e-9)  # round-off of an energy of 1 over 2e-5
    with pytest.raises(ValueError, match="backward"):
        torch.func.grad(lambda f: energy(f, at[1], at[2]))(at[0])


def test_a_modulus_in_the_wrong_unit_is_told_at_once():
    """E in GPa: the weight is 1e10 of what the rod carries. No OverflowError, no hundred million increments."""
    for E in (207.0, 2.07e-7, 1e-300):
        robot = Robot(Rod.circular(0.4, 1.4e-3, E, 0.4 * E, 0.1), Tendons(), T([9.81, 0.0, 0.0]))
        began = time.monotonic()
        assert solve_shape(robot, (), None, LENGTH, 1).status[0] != Status.CONVERGED
        problem = posed(LENGTH, torch.zeros(2, 1, 3), robot=robot, loads=PointCoordinates(1, 0.4, 1.0))
        assert without_load(problem).p.isnan().all()
        assert time.monotonic() - began < 20
