"""Tendons that rub: the capstan in closed form, a solver of high order written here, both directions, the kernel, and the file."""

import json
import math
import warnings
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from tests.problems import check_jacobian, posed
from tests.robots import T
from tests.test_fast import needs_compiler
from torchrod import (
    GaussianCoordinates,
    InputError,
    PointCoordinates,
    PointWrenches,
    Problem,
    Robot,
    Rod,
    Tendon,
    Tendons,
    forward_jacobian,
    kernel,
    read_robot,
    shape_from_base,
    solve_displacement,
    solve_shape,
)
from torchrod.data.dataset import _robot_record
from torchrod.data.shards import _robot
from torchrod.estimation.evaluator import KernelEvaluator, evaluator
from torchrod.mechanics.integrate import march
from torchrod.mechanics.lie import logarithm
from torchrod.mechanics.section import STATE, Section
from torchrod.mechanics.statics import base_state, grid_for, stage_table
from torchrod.mechanics.tendons import STRAIGHT
from torchrod.util.by_value import key

L, MU = 0.3, 0.2
PIECES = 4  # of a gap between discs


def rubbing(*tendons: Tendon, mu: float = MU, motion: float = 1.0) -> Tendons:
    return Tendons(tuple(replace(t, friction=mu, motion=motion) for t in tendons))


def straight() -> Tendon:
    return Tendon.straight(0.008, 0.0, L)


def helix(radius: float = 0.006, turn: float = 9.0) -> Tendon:
    s = torch.linspace(0, L, 61, dtype=torch.float64).tolist()
    return Tendon(tuple((x, radius * math.cos(turn * x), radius * math.sin(turn * x)) for x in s), L)


def hanging(mu: float = MU, motion: float = 1.0) -> Robot:
    """Gravity, a helical tendon, and a straight one that ends half way."""
    rod = Rod.circular(L, 0.0012, 70e9, 26e9, 0.05)
    return Robot(rod, rubbing(helix(), Tendon.straight(-0.003, 0.007, 0.17), mu=mu, motion=motion), T([5.0, 2.0, -6.0]))


def turned_at_tip(robot: Robot, tension: float) -> float:
    """Theta of the first tendon from base to tip, without load, marched from the base."""
    grid = grid_for(robot, (), T([L]), 40)
    table = stage_table(robot, (), T([[tension]]), grid)
    y = torch.nn.functional.pad(base_state(robot, torch.zeros(1, 6), table), (0, 1))
    return float(march(Section.of(robot.rod.K_se, robot.rod.K_bt), y, table, grid)[0, -1, STATE])


@pytest.mark.parametrize("motion", [1.0, -1.0, 0.3])
@pytest.mark.parametrize("curved", [0.0, 2.0])
def test_the_capstan_on_a_rod_that_it_bends(curved, motion):
    """In a plane Theta' = u = a + b exp(-mu Theta), b = tau r / EI: exp(mu Theta) = (1 + b/a) exp(mu a s) - b/a.

    Theta(L) is the angle of the tip, found from tip to base.
    """
    K_bt = 0.01 * torch.eye(3)
    rod = Rod.from_stiffness(L, 1e9 * torch.eye(3), K_bt, 0.0, T([[0.0, 0.0, curved, 0.0]]))
    tension, mu = 4.0, MU * motion
    shape = solve_shape(Robot(rod, rubbing(straight(), motion=motion)), (), T([[tension]]), T([0.5 * L, L]), 1)
    b = tension * 0.008 / 0.01
    angles = [float(logarithm(q).norm()) for q in shape.q[0]]
    for s, angle in zip((0.5 * L, L), angles, strict=True):
        grown = 1 + mu * b * s if curved == 0 else (1 + b / curved) * math.exp(mu * curved * s) - b / curved
        assert abs(angle - math.log(grown) / mu) < 1e-6
    assert abs(angles[-1] - (curved + b) * L) > 0.03 * abs(motion) * angles[-1], "friction is seen"


def test_the_capstan_on_helices():
    """Theta' is constant: of a straight tendon in a helical rod |u x t|, of a helical one on a straight rod r turn^2 / stretch."""
    stiff, u = 1e9 * torch.eye(3), np.array([0.0, 6.0, 8.0])
    rod = Rod.from_stiffness(L, stiff, stiff, 0.0, T([[0.0, *u]]))
    along = np.array([0, 0, 1]) + np.cross(u, [0.008, 0, 0])
    rate = np.linalg.norm(np.cross(u, along / np.linalg.norm(along)))
    found = turned_at_tip(Robot(rod, rubbing(straight())), 1.0)
    assert abs(found - math.hypot(rate * L, STRAIGHT)) < 1e-8
    radius, turn = 0.006, 40.0
    s = torch.linspace(0, L, 481, dtype=torch.float64).tolist()
    wound = Tendon(tuple((x, radius * math.cos(turn * x), radius * math.sin(turn * x)) for x in s), L)
    found = turned_at_tip(Robot(Rod.from_stiffness(L, stiff, stiff), rubbing(wound)), 1.0)
    exact = radius * turn**2 / math.sqrt(1 + (radius * turn) ** 2) * L
    assert abs(found / exact - 1) < 1e-4, "to what the spline leaves"


def balanced(w: np.ndarray, K: np.ndarray, r: np.ndarray, dr: np.ndarray, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Strains and the tendons' unit tangents of w = K (x - x*) + sum tau [t, r x t]."""

    x = np.array([0, 0, 1.0, 0, 0, 0])
    for _ in range(60):  # by substitution: the directions hardly depend on the strains
        a = x[:3] + np.cross(x[3:], r) + dr
        t = a / np.linalg.norm(a, axis=-1, keepdims=True)
        old, x = x, (w - (tau[:, None] * np.c_[t, np.cross(r, t)]).sum(0)) / K + [0, 0, 1, 0, 0, 0]
        if np.abs(x - old).max() < 1e-12:
            return x, t
    raise AssertionError("the strains do not settle")


@pytest.mark.parametrize("motion", [1.0, -1.0])
def test_against_a_solver_of_high_order(motion):
    """Gravity, a helical and a straight tendon and a force at the tip: DOP853 from the same base wrench comes to the same places.

    Nothing is left at its tip. The turning of its tendons, all terms of it, is Theta to a thousandth.
    """
    robot, tension = hanging(motion=motion), T([[3.0, 2.0]])
    force, places = np.array([0.05, 0.1, -0.02]), [0.17, L]
    tip = PointWrenches(T(force).reshape(1, 1, 3), torch.zeros(1, 1, 3), T([L]))
    shape = solve_shape(robot, (tip,), tension, T(places), 1)
    assert bool(shape.stable.all())
    K = torch.cat([robot.rod.K_se.diagonal(), robot.rod.K_bt.diagonal()]).numpy()
    g, tau0, mu = robot.gravity.numpy() * 0.05, np.array([3.0, 2.0]), MU * motion

    rows = np.array(helix().routing)
    wound = CubicSpline(rows[:, 0], np.c_[rows[:, 1:], 0 * rows[:, 0]])

    def section(s: float, y: np.ndarray, pulls: np.ndarray) -> tuple[np.ndarray, ...]:
        r, dr, ddr = (np.stack([wound(s, i), [-0.003, 0.007, 0.0] if i == 0 else np.zeros(3)]) for i in range(3))
        R = y[3:12].reshape(3, 3)
        x, t = balanced(np.r_[R.T @ y[12:15], R.T @ y[15:18]], K, r, dr, pulls * tau0 * np.exp(-mu * y[18:]))
        return x, t, r, dr, ddr, R

    def rate(s: float, y: np.ndarray, pulls: np.ndarray) -> np.ndarray:
        x, t, r, dr, ddr, R = section(s, y, pulls)
        u, size = x[3:], np.linalg.norm(x[:3] + np.cross(x[3:], r) + dr, axis=-1, keepdims=True)
        change = np.cross(u, dr) + ddr
        turn = np.cross(u, t) + (change - (t * change).sum(-1, keepdims=True) * t) / size
        hat = np.array([[0, -u[2], u[1]], [u[2], 0, -u[0]], [-u[1], u[0], 0]])
        dp = R @ x[:3]
        return np.r_[dp, (R @ hat).ravel(), -g, -np.cross(dp, y[12:15]), pulls * np.linalg.norm(turn, axis=-1)]

    y, found, ways = np.r_[np.zeros(3), np.eye(3).ravel(), shape.base_wrench[0].numpy(), 0, 0], [], []
    for a, b, pulls in ((0, 0.17, np.array([1, 1])), (0.17, L, np.array([1, 0]))):
        solved = solve_ivp(
            lambda s, y, on=pulls: rate(min(s, L - 1e-12), y, on), (a, b), y, "DOP853", rtol=1e-7, atol=1e-9, dense_output=True
        )
        y = solved.y[:, -1]
        found.append(y[:3])
        ways.append([(R @ t[0]) for s in np.linspace(a, b, 60) for _, t, *_, R in [section(s, solved.sol(s), pulls)]])
    assert np.abs(shape.p[0].numpy() - np.array(found)).max() < 1e-6
    assert np.abs(y[12:18] - np.r_[force, np.zeros(3)]).max() < 1e-6
    turning = sum(math.acos(min(1.0, float(a @ b))) for way in ways for a, b in pairwise(way))
    assert abs(turning / y[18] - 1) < 1e-3
    without = solve_shape(hanging(0.0), (tip,), tension, T(places), 1)
    assert (without.p - shape.p).abs().max() > 1e-3


def disc_by_disc(discs: int, tension: float, EI: float, r: float) -> np.ndarray:
    """The tip (x, z) of a plane rod with so many discs, whose tendon runs straight from hole to hole and rubs in the holes alone.

    In a gap the rod carries what balances the tendon on the line through its two holes, whose angle is found gap by gap.
    """
    y, tau, way = np.zeros(3), tension, 0.0
    h = L / discs / PIECES

    def hole(y: np.ndarray) -> np.ndarray:
        return y[:2] + r * np.array([math.cos(y[2]), -math.sin(y[2])])

    for _ in range(discs):
        first = hole(y)

        def across(angle: float, start=y, first=first, tau=tau, way=way) -> tuple[float, np.ndarray, float]:
            pull = tau * math.exp(-MU * abs(angle - way))
            d = np.array([math.sin(angle), math.cos(angle)])

            def rate(at: np.ndarray) -> np.ndarray:
                a = first - at[:2]
                return np.array([math.sin(at[2]), math.cos(at[2]), -pull * (a[1] * d[0] - a[0] * d[1]) / EI])

            end = start
            for _ in range(PIECES):
                k1 = rate(end)
                k2 = rate(end + 0.5 * h * k1)
                k3 = rate(end + 0.5 * h * k2)
                end = end + h / 6 * (k1 + 2 * (k2 + k3) + rate(end + h * k3))
            b = hole(end) - first
            return b[0] * d[1] - b[1] * d[0], end, pull

        line = brentq(lambda x, at=across: at(x)[0], y[2] - 0.2, y[2] + 0.8, xtol=1e-12)
        angle = float(line)  # pyright: ignore[reportArgumentType]
        _, y, tau = across(angle)
        way = angle
    return y[:2]


def test_discs_are_what_it_converges_to():
    """With the square of their spacing."""
    EI, r, tension = 0.01, 0.008, 4.0
    rod = Rod.from_stiffness(L, 1e9 * torch.eye(3), EI * torch.eye(3))
    tip = solve_shape(Robot(rod, rubbing(straight())), (), T([[tension]]), T([L]), 1).p[0, 0, [0, 2]].numpy()
    errors = [float(np.linalg.norm(disc_by_disc(n, tension, EI, r) - tip)) for n in (10, 20, 40)]
    assert errors[0] < 5e-3
    assert all(3.9 < a / b < 4.2 for a, b in pairwise(errors)), errors


@needs_compiler
def test_order_four_and_back():
    """Of the steps, from tip to base; and from base to tip the same shape, with nothing left at the tip."""
    robot, tension, tip = hanging(), T([[3.0, 2.0]]), PointWrenches(T([[[0.05, 0.1, 0.0]]]), torch.zeros(1, 1, 3), T([L]))
    robot = replace(robot, tendons=rubbing(helix(), Tendon.straight(-0.003, 0.007, 0.15)))
    places = T([0.15, L])
    exact = solve_shape(robot, (tip,), tension, places, 1, 640)
    errors = [float((solve_shape(robot, (tip,), tension, places, 1, n).p - exact.p).abs().max()) for n in (20, 40, 80)]
    assert all(13 < a / b < 19 for a, b in pairwise(errors)), errors
    back = shape_from_base(robot, (tip,), exact.base_wrench, tension, places, 640, differentiable=False)
    assert (back.p - exact.p).abs().max() < 1e-10
    assert back.tip_residual.abs().max() < 1e-9


def problem_of(robot: Robot, steps: int, family=None, **unknown) -> Problem:
    positions = 0.1 * torch.randn(2, 2, 3, generator=torch.Generator().manual_seed(3))
    return posed(T([0.1, L]), positions, 1e-3, robot, family, T([[3.0, 2.0], [0.0, 4.0]]), 0.01 * torch.eye(2, 3), steps, **unknown)


@needs_compiler
def test_jacobian():
    """The kernel's march against torch.func and central differences."""
    check_jacobian(problem_of(hanging(), 2))


@needs_compiler
@pytest.mark.parametrize("unknown", [{}, {"tension_std": 0.5, "tip": "force"}], ids=["", "tensions, tip"])
@pytest.mark.parametrize("family", ["gaussian", "points"])
def test_the_kernel_is_the_torch_model(family, unknown):
    robot = hanging(motion=-1.0)
    loads = GaussianCoordinates(1, L, robot.rod.force_scale)
    if family == "points":  # whose nodes move: straight tendons only
        robot = replace(robot, tendons=rubbing(straight(), Tendon.straight(-0.003, 0.007, 0.17)))
        loads = PointCoordinates(1, L, robot.rod.force_scale)
    problem = problem_of(robot, 3, loads, **unknown)
    x = 0.3 * torch.randn(2, problem.size, generator=torch.Generator().manual_seed(0))
    evaluate = evaluator(problem)
    assert isinstance(evaluate, KernelEvaluator)
    h, H = forward_jacobian(problem.h, x)
    sums, w, r = evaluate.sums(x), problem.weights, problem.reading - h
    g, A = torch.einsum("bz,bzn,bz->bn", w, H, r), torch.einsum("bz,bzn,bzm->bnm", w, H, H)
    assert (sums.r - r).abs().max() < 1e-10 * r.abs().max()
    assert (sums.g.sum(1) - g).abs().max() < 1e-10 * g.abs().max()
    assert (sums.A.sum(1).tril() - A.tril()).abs().max() < 1e-10 * A.abs().max()


def test_gradients_of_the_forward_solve():
    """By the implicit function theorem, Theta at the tip included, against central differences."""
    robot, tension = hanging(), T([[3.0, 2.0]], requires_grad=True)

    def tip(tension: torch.Tensor) -> torch.Tensor:
        return solve_shape(robot, (), tension, T([L]), 1, 4).p[0, 0]

    slopes = torch.stack([torch.autograd.grad(x, tension, retain_graph=True)[0][0] for x in tip(tension)])
    with torch.no_grad():
        for j, e in enumerate(1e-4 * torch.eye(2)):
            assert torch.allclose(slopes[:, j], (tip(tension + e) - tip(tension - e)) / 2e-4, rtol=1e-6, atol=1e-9)


@needs_compiler
def test_the_forward_solve_without_the_kernel(monkeypatch):
    robot, tension = replace(hanging(), gravity=torch.zeros(3)), T([[3.0, 2.0]])
    compiled = solve_shape(robot, (), tension, T([L]), 1, 2)
    monkeypatch.setattr(kernel, "available", lambda: False)
    assert (solve_shape(robot, (), tension, T([L]), 1, 2).p - compiled.p).abs().max() < 1e-10


def test_no_friction_is_no_friction():
    """mu = 0, and a motion that is half and half, are a tendon that slides."""
    places, tension = T([0.1, L]), T([[3.0, 2.0]])
    one, two, three = (solve_shape(r, (), tension, places, 1, 10).p for r in (hanging(0.0), hanging(MU, 0.0), hanging(1e-9)))
    assert torch.equal(one, two)
    assert 0 < (one - three).abs().max() < 1e-7


def test_pulled_by_a_length():
    """A tendon that rubs takes more tension for the same length."""
    robot = replace(hanging(), tendons=rubbing(straight()), gravity=torch.zeros(3))
    smooth = replace(robot, tendons=Tendons((straight(),)))
    one, two = (solve_displacement(r, (), T([[0.008]]), T([L]), 10) for r in (robot, smooth))
    assert (one.equilibrium.status == 0).all() and float(one.tension) > 1.02 * float(two.tension)


TENDON = "[[tendons]]\noffset = [0.008, 0.0]\n"
ROD = "[rod]\nlength = 0.3\ndiameter = 0.001\nyoungs_modulus = 70e9\nshear_modulus = 26e9\n"


@pytest.mark.parametrize(
    ("said", "mu"),
    [("", 0.0), ("friction = 0.3", 0.3), ('friction = 0.3\nmotion = "release"', -0.3), ("friction = 0.2\nmotion = 0.5", 0.1)],
)
def test_the_file_and_data_sets_say_the_same(tmp_path, said, mu):
    (tmp_path / "robot.toml").write_text(ROD + TENDON + said)
    robot = read_robot(tmp_path / "robot.toml")
    assert (0.0 if robot.tendons.friction is None else float(robot.tendons.friction)) == pytest.approx(mu)
    assert key(_robot(json.loads(json.dumps(_robot_record(robot))))) == key(robot)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("friction = -0.1", ("tendons[0].friction", "at least 0")),
        ("friction = 'high'", ("tendons[0].friction", "must be a number")),
        ("friction = inf", ("tendons[0].friction", "finite")),
        ("motion = 'push'", ("tendons[0].motion", '"pull", "release"')),
        ("motion = 1.5", ("tendons[0].motion", "from -1 to 1")),
        ("motion = true", ("tendons[0].motion", "from -1 to 1")),
    ],
)
def test_bad_input_is_refused_in_a_sentence(tmp_path, text, parts):
    (tmp_path / "robot.toml").write_text(ROD + TENDON + text)
    with warnings.catch_warnings(), pytest.raises(InputError) as refused:
        warnings.simplefilter("ignore")
        read_robot(tmp_path / "robot.toml")
    said = str(refused.value)
    assert "\n" not in said and str(tmp_path / "robot.toml") in said
    assert all(part in said for part in parts), said


def test_tendons_that_are_none_are_refused():
    for wrong in ({"friction": math.nan}, {"motion": 2.0}, {"motion": math.nan}):
        with pytest.raises(ValueError, match="must be"):
            replace(straight(), **wrong)
