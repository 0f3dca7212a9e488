"""Rods whose section varies: against a solver of high order written here, the elastica, the kernel, and the file that says so."""

import json
import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, root

from tests.problems import check_jacobian, posed
from tests.robots import T
from tests.test_fast import needs_compiler
from torchrod import (
    GaussianCoordinates,
    InputError,
    Markers,
    Piece,
    PointCoordinates,
    PointWrenches,
    Robot,
    Rod,
    Tendon,
    Tendons,
    calibrate,
    forward_jacobian,
    read_robot,
    solve_shape,
)
from torchrod.data.dataset import _robot_record
from torchrod.data.shards import _robot
from torchrod.estimation.evaluator import KernelEvaluator, evaluator
from torchrod.estimation.walk import kernel_walks
from torchrod.io.robot_text import write_calibrated
from torchrod.util.by_value import key

E, G, L = 207e9, 79e9, 0.4
Diameters = Callable[[float], tuple[float, float]]


def step(s: float) -> tuple[float, float]:
    return (0.002, 0.0) if s < 0.13 else (0.0012, 0.0)


def taper(s: float) -> tuple[float, float]:
    return 0.002 - 0.0009 * s / L, 0.0


def tube(s: float) -> tuple[float, float]:
    return (0.0022, 0.0015) if s < 0.25 else (0.0022 - 0.004 * (s - 0.25), 0.0015 - 0.004 * (s - 0.25))


RODS: dict[str, tuple[tuple[Piece, ...], Diameters]] = {
    "step": ((Piece.round(0.13, 0.002, E, G), Piece.round(L, 0.0012, E, G)), step),
    "taper": ((Piece.round(L, (0.002, 0.0011), E, G),), taper),
    "tube": ((Piece.round(0.25, 0.0022, E, G, 0.0, 0.0015), Piece.round(L, (0.0022, 0.0016), E, G, 0.0, (0.0015, 0.0009))), tube),
}
DISCS = T([[0.1, 0.002], [0.31, 0.003], [L, 0.005]], dtype=torch.float64)
GRAVITY = T([6.0, -4.0, 6.0], dtype=torch.float64)


def shot(
    diameters: Diameters, rho: float, masses: np.ndarray, g: np.ndarray, tip: np.ndarray, places: list[float], start: np.ndarray
):
    """The shape (m) at places by n' = -f, m' = -p' x n, piece by piece with DOP853, the base wrench by shooting at the tip."""
    jumps = sorted({0.13, 0.25, *masses[:, 0], *places, L})

    def cross(a: np.ndarray, b: np.ndarray) -> list[float]:  # numpy's takes longer than all the rest
        return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]

    def rate(s: float, y: np.ndarray) -> np.ndarray:
        D, d = diameters(s)
        A, Ix = math.pi * (D**2 - d**2) / 4, math.pi * (D**4 - d**4) / 64
        R, (N, M) = y[3:12].reshape(3, 3), y[12:].reshape(2, 3) @ y[3:12].reshape(3, 3)
        x, y_, z = M / [E * Ix, E * Ix, 2 * G * Ix]
        dp = R @ (N / [G * A, G * A, E * A] + [0, 0, 1])
        turn = R @ [[0, -z, y_], [z, 0, -x], [-y_, x, 0]]
        return np.array([*dp, *turn.ravel(), *(-rho * g), *cross(y[12:15], dp)])

    def march(wrench: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        y, shape = np.r_[np.zeros(3), np.eye(3).ravel(), wrench], []
        for a, b in zip([0.0, *jumps[:-1]], jumps, strict=True):
            inside = [a + 1e-12, b - 1e-12]
            y = solve_ivp(lambda s, y, at=inside: rate(min(max(s, at[0]), at[1]), y), (a, b), y, "DOP853", rtol=1e-8, atol=1e-10).y[
                :, -1
            ]
            if b in places:
                shape.append(y[:3])
            y = y - np.r_[np.zeros(12), sum((m * g for s, m in masses if s == b), np.zeros(3)), np.zeros(3)]
        return np.array(shape), y[12:] - np.r_[tip, np.zeros(3)]

    found = root(lambda w: march(w)[1], start, tol=1e-10)
    return march(found.x)[0]


@pytest.mark.parametrize("heavy", [False, True], ids=["", "masses"])
@pytest.mark.parametrize("kind", RODS)
def test_against_a_solver_of_high_order(kind, heavy):
    """The brief's 1e-6 m for any section; weight, masses along the rod and a camera at the tip included."""
    pieces, diameters = RODS[kind]
    rho, masses = (0.05, DISCS) if heavy else (0.0, DISCS[:0])
    rod = replace(Rod.of_pieces(pieces), mass_per_length=T(rho), masses=masses)
    places = [0.13, 0.31, L]
    force = T([0.3, 0.5, -0.2])
    tip = PointWrenches(force.reshape(1, 1, 3), torch.zeros(1, 1, 3), T([L]))
    shape = solve_shape(Robot(rod, gravity=GRAVITY), (tip,), None, T(places), 1)
    assert bool(shape.stable.all())
    expected = shot(diameters, rho, masses.numpy(), GRAVITY.numpy(), force.numpy(), places, shape.base_wrench[0].numpy())
    assert np.abs(shape.p[0].numpy() - expected).max() < 1e-6


def test_elastica_of_varying_stiffness():
    """A plane cantilever without shear under a dead force across its tip: (EI(s) th')' = -F cos th, by another solver."""
    EI = (0.05, 0.02)
    stiff = 1e9 * torch.eye(3)
    K = tuple(torch.diag(T([x, x, x])) for x in EI)
    rod = Rod.of_pieces((Piece.of_stiffness(L, stiff, (K[0], K[1])),))
    F = 1.5

    def bent(m0: float, places=(L,)) -> np.ndarray:
        def rate(s, y):
            th, m = y[2], y[3]
            return [math.sin(th), math.cos(th), m / (EI[0] + (EI[1] - EI[0]) * s / L), -F * math.cos(th)]

        return solve_ivp(rate, (0, L), [0, 0, 0, m0], "DOP853", t_eval=places, rtol=1e-12, atol=1e-13).y

    m0 = float(brentq(lambda m: bent(m)[3, -1], 0.0, 2 * F * L, xtol=1e-14))  # pyright: ignore[reportArgumentType]
    places = [0.1, 0.25, L]
    shape = solve_shape(Robot(rod), (PointWrenches(T([[[F, 0.0, 0.0]]]), torch.zeros(1, 1, 3), T([L])),), None, T(places), 1)
    assert np.abs(shape.p[0][:, [0, 2]].numpy().T - bent(m0, places)[:2]).max() < 1e-6
    assert float(shape.p[0, -1, 0]) > 0.1 * L


def test_order_four():
    """Of the steps, on a taper with a jump of section in it: both are steps' ends."""
    pieces = (Piece.round(0.16, (0.002, 0.0015), E, G), Piece.round(L, (0.0012, 0.0009), E, G))
    robot = Robot(Rod.of_pieces(pieces, T([[0.0, 2.0, 1.0, 0.5]])))
    tip = PointWrenches(T([[[0.4, 0.3, 0.1]]]), torch.zeros(1, 1, 3), T([L]), "local")

    def shape(steps: int) -> torch.Tensor:
        return solve_shape(robot, (tip,), None, T([0.2, L]), 1, steps).p

    exact = shape(640)
    errors = [float((shape(n) - exact).abs().max()) for n in (10, 20, 40)]
    assert all(14 < a / b < 18.5 for a, b in pairwise(errors)), errors


def varied(tendons: bool = False, round_: bool = True) -> Robot:
    """Steps, a taper and masses, with an oval piece unless it is to be round, hanging where it has tendons or is oval."""
    last = Piece.round(L, 0.0011, E, G, 0.02) if round_ else Piece.oval(L, (0.0013, (0.001, 0.0009)), E, G, 0.02, 0.5)
    pieces = (Piece.round(0.1, 0.0018, E, G, 0.05, 0.001), Piece.round(0.3, (0.0016, 0.0012), E, G, (0.05, 0.02)), last)
    rod = Rod.of_pieces(pieces, T([[0.0, 0.5, -1.0, 2.0]]), DISCS)
    pulled = Tendons((Tendon.straight(0.008, 0.0, L), Tendon.straight(-0.003, 0.007, 0.21))) if tendons else Tendons()
    return Robot(rod, pulled, GRAVITY if tendons or not round_ else torch.zeros(3))


ROBOTS = {"round": varied(), "oval, hanging": varied(round_=False), "tendons": varied(True, False)}


def problem_of(robot: Robot, family=None, steps: int = 4):
    tension = T([[3.0, 2.0], [0.0, 4.0]]) if len(robot.tendons) else None
    positions = 0.1 * torch.randn(2, 3, 3, generator=torch.Generator().manual_seed(3))
    return posed(T([0.1, 0.25, L]), positions, 1e-3, robot, family, tension, 0.01 * torch.eye(3), steps=steps)


@pytest.mark.parametrize("robot", ROBOTS)
def test_jacobian(robot):
    check_jacobian(problem_of(ROBOTS[robot]))


@needs_compiler
@pytest.mark.parametrize("robot", ROBOTS)
def test_the_kernel_is_the_torch_model(robot):
    problem = problem_of(ROBOTS[robot], GaussianCoordinates(2, L, ROBOTS[robot].rod.force_scale))
    x = 0.3 * torch.randn(2, problem.size, generator=torch.Generator().manual_seed(0))
    evaluate = evaluator(problem)
    assert isinstance(evaluate, KernelEvaluator)
    h, H = forward_jacobian(problem.h, x)
    sums, plain, r = evaluate.sums(x), problem.weights, problem.reading - h
    g, A = torch.einsum("bz,bzn,bz->bn", plain, H, r), torch.einsum("bz,bzn,bzm->bnm", plain, H, H)
    assert (sums.r - r).abs().max() < 1e-10 * r.abs().max()
    assert (sums.g.sum(1) - g).abs().max() < 1e-10 * g.abs().max()
    assert (sums.A.sum(1).tril() - A.tril()).abs().max() < 1e-10 * A.abs().max()
    moving = problem_of(ROBOTS[robot], PointCoordinates(1, L, 1.0))
    assert not kernel_walks(moving)  # nodes that move along a section that varies: left to torch


def test_pieces_of_one_section_are_a_uniform_rod():
    """Scales, shape, weight; and k K is k times as stiff all along."""
    uniform = Rod.circular(L, 0.0014, E, G, 0.06)
    cut = Rod.of_pieces((Piece.round(0.15, 0.0014, E, G, 0.06), Piece.round(L, 0.0014, E, G, 0.06)))
    assert math.isclose(cut.force_scale, uniform.force_scale, rel_tol=1e-12)
    assert math.isclose(cut.mass, uniform.mass, rel_tol=1e-12)
    assert math.isclose(cut.softest, uniform.softest, rel_tol=1e-12)
    shapes = [solve_shape(Robot(rod, gravity=GRAVITY), (), None, T([0.15, L]), 1).p for rod in (uniform, cut)]
    assert (shapes[0] - shapes[1]).abs().max() < 1e-10
    rod = varied(round_=False).rod
    twice = replace(
        rod, K_se=2 * rod.K_se, K_bt=2 * rod.K_bt, mass_per_length=2 * rod.mass_per_length, masses=rod.masses * T([1.0, 2.0])
    )
    one, two = (solve_shape(Robot(r, gravity=GRAVITY), (), None, T([0.15, L]), 1).p for r in (rod, twice))
    assert (one - two).abs().max() < 1e-10
    assert math.isclose(float(twice.softest), 2 * rod.softest, rel_tol=1e-12)


def test_the_scale_is_that_of_the_tips_compliance():
    """A small force at the tip moves it by F L^3 / (3 EI), EI the rod's bending_stiffness."""
    rod = Rod.of_pieces(RODS["step"][0])
    F = 1e-4 * rod.force_scale
    tip = PointWrenches(T([[[F, 0.0, 0.0]]]), torch.zeros(1, 1, 3), T([L]))
    moved = float(solve_shape(Robot(rod), (tip,), None, T([L]), 1).p[0, 0, 0])
    assert math.isclose(moved, F * L**3 / (3 * rod.bending_stiffness), rel_tol=1e-4)


BASE = "[rod]\nlength = 0.4\ndiameter = 0.0014\nyoungs_modulus = 207e9\nshear_modulus = 79e9\nmass_per_length = 0.02\n"
SECTIONS = """gravity = [9.81, 0.0, 0.0]
reference_curvature = [[0.0, 0.0, 0.0, 0.0], [0.4, 0.0, 4.0, 0.0]]
[[rod.sections]]
to = 0.1
inner_diameter = 0.0008
[[rod.sections]]
to = 0.25
diameter = [0.0014, 0.001]
mass_per_length = [0.02, 0.01]
[[rod.sections]]
to = 0.3
axes = [0.001, 0.0012]
angle = 0.3
reference_curvature = [0.0, 1.0, 2.0]
[[rod.sections]]
K_se = [[2e4, 2e4, 5e4], [1e4, 1e4, 3e4]]
K_bt = [[0.03, 0.04, 0.02], [0.02, 0.02, 0.01]]
[[rod.masses]]
s = 0.4
mass = 0.003
"""


def read(tmp_path, text: str) -> Robot:
    (tmp_path / "robot.toml").write_text(text)
    return read_robot(tmp_path / "robot.toml")


def test_the_file_says_the_same(tmp_path):
    rod = read(tmp_path, BASE + SECTIONS).rod
    s, inside = T([0.1, 0.1, 0.25, 0.3, L]), T([0.05, 0.2, 0.2, 0.35, 0.35])
    assert rod.pieces is not None
    K_se, K_bt = rod.pieces.stiffness(rod.K_se, rod.K_bt, s, inside)
    EI = [E * math.pi * (D**4 - d**4) / 64 for D, d in ((0.0014, 0.0008), (0.0014, 0.0), (0.001, 0.0))]
    assert torch.allclose(K_bt[:3, 0, 0], T(EI), rtol=1e-12)
    assert torch.allclose(K_bt[3:].diagonal(dim1=-2, dim2=-1), T([[0.03, 0.04, 0.02], [0.02, 0.02, 0.01]]), rtol=1e-12)
    assert torch.allclose(K_se[3:].diagonal(dim1=-2, dim2=-1), T([[2e4, 2e4, 5e4], [1e4, 1e4, 3e4]]), rtol=1e-12)
    curved = rod.curvature_at(T([0.2, 0.27, 0.35]), T([0.2, 0.27, 0.35]))
    assert torch.allclose(curved, T([[0.0, 2.0, 0.0], [0.0, 1.0, 2.0], [0.0, 3.5, 0.0]]))
    assert math.isclose(rod.mass, 0.02 * 0.1 + 0.015 * 0.15 + 0.02 * 0.15 + 0.003, rel_tol=1e-12)


def test_a_calibrated_file_keeps_its_sections(tmp_path):
    robot = read(tmp_path, BASE + SECTIONS)
    rod = replace(robot.rod, K_se=1.1 * robot.rod.K_se, K_bt=1.1 * robot.rod.K_bt, mass_per_length=1.3 * robot.rod.mass_per_length)
    write_calibrated(tmp_path / "new.toml", tmp_path / "robot.toml", replace(robot, rod=rod), 1.1)
    new = read_robot(tmp_path / "new.toml").rod
    assert new.pieces is not None and robot.rod.pieces is not None
    assert torch.allclose(new.pieces.K_bt, robot.rod.pieces.K_bt, rtol=0, atol=1e-9)
    assert torch.allclose(new.K_bt, rod.K_bt, rtol=1e-9, atol=0)
    assert math.isclose(new.mass - 0.003, 1.3 * (robot.rod.mass - 0.003), rel_tol=1e-9)


def test_a_data_set_keeps_the_robot():
    robot = varied(True, False)
    kept = _robot(json.loads(json.dumps(_robot_record(robot))))
    assert key(replace(kept, name="")) == key(replace(robot, name=""))


def test_calibration_knows_the_masses_on_the_rod():
    """The rod's own mass from shapes that discs of known mass bend as well."""
    robot = Robot(replace(varied(False).rod, reference_curvature=torch.zeros(1, 4)), gravity=GRAVITY)
    s = T([0.2, 0.3, L])
    seen = solve_shape(robot, (), None, s, 1).p
    lighter = replace(robot, rod=replace(robot.rod, mass_per_length=0.7 * robot.rod.mass_per_length))
    found = calibrate(lighter, Markers(s, seen, 1e-5))
    assert math.isclose(float(found.values[0]), float(robot.rod.mass_per_length), rel_tol=1e-4)


ONE = "[[rod.sections]]\n"
BAD = {
    "sections = 3": ("rod.sections", "array of tables"),
    ONE + "diameter = 0.001\n" + ONE: ("rod.sections[0].to", "is missing"),
    ONE + "to = 0.2\n" + ONE + "to = 0.1\n" + ONE: ("rod.sections[1].to", "one after the other"),
    ONE + "to = 0.2\n" + ONE + "to = 0.3\n": ("rod.sections[1].to", "must end at the rod's length"),
    ONE + "to = 0.2\n" + ONE + "to = 0.5\n": ("rod.sections[1].to", "must end at the rod's length"),
    ONE + "diamter = 0.001": ("rod.sections[0]", "unknown key 'diamter'"),
    ONE + "diameter = -0.001": ("rod.sections[0].diameter", "must be positive"),
    ONE + "diameter = [0.001, 0.0]": ("rod.sections[0].diameter[1]", "must be positive"),
    ONE + "diameter = [0.001, 0.002, 0.003]": ("rod.sections[0].diameter", "a number, or two"),
    ONE + "inner_diameter = 0.0014": ("rod.sections[0].inner_diameter", "less than the diameter"),
    ONE + "inner_diameter = -0.1": ("rod.sections[0].inner_diameter", "at least 0"),
    ONE + "youngs_modulus = 207": ("rod.sections[0].youngs_modulus", "in pascals"),
    ONE + "shear_modulus = 0": ("rod.sections[0].shear_modulus", "must be positive"),
    ONE + "mass_per_length = [0.1, -0.1]": ("rod.sections[0].mass_per_length[1]", "at least 0"),
    ONE + "axes = 0.001": ("rod.sections[0].axes", "two axes"),
    ONE + "axes = [0.001, 0.0]": ("rod.sections[0].axes[1]", "must be positive"),
    ONE + "axes = [0.001, 0.002]\ndiameter = 0.001": ("rod.sections[0].axes", "beside a diameter"),
    ONE + "axes = [0.001, 0.002]\nangle = 'x'": ("rod.sections[0].angle", "must be a number"),
    ONE + "K_se = [1e4, 1e4, 1e4]": ("rod.sections[0].K_bt", "given together"),
    ONE + "K_se = [1e4, 1e4, 1e4]\nK_bt = [1, 1, 1]\ndiameter = 1": ("rod.sections[0].diameter", "stands beside K_se"),
    ONE + "K_se = [1e4, 1e4, 1e4]\nK_bt = [[1, 1, 1], [1, 1, -1]]": ("rod.sections[0].K_bt[1]", "positive definite"),
    ONE + "reference_curvature = [1, 2]": ("rod.sections[0].reference_curvature", "list of 3"),
    "diameter = [0.002, 0.001]\n" + ONE: ("rod.diameter", "a taper beside sections"),
    "[[rod.masses]]\ns = 0.1": ("rod.masses[0].mass", "is missing"),
    "[[rod.masses]]\nmass = 0.1": ("rod.masses[0].s", "is missing"),
    "[[rod.masses]]\ns = 0.5\nmass = 0.1": ("rod.masses[0].s", "beyond the rod's length"),
    "[[rod.masses]]\ns = -0.1\nmass = 0.1": ("rod.masses[0].s", "at least 0"),
    "[[rod.masses]]\ns = 0.1\nmass = -0.1": ("rod.masses[0].mass", "at least 0"),
    "[[rod.masses]]\ns = 0.1\nkg = 0.1": ("rod.masses[0]", "unknown key 'kg'"),
    "masses = 0.1": ("rod.masses", "array of tables"),
}


@pytest.mark.parametrize("text", BAD)
def test_bad_input_is_refused_in_a_sentence(tmp_path, text):
    base = BASE.replace("diameter = 0.0014\n", "") if text.startswith("diameter") else BASE
    with warnings.catch_warnings(), pytest.raises(InputError) as refused:
        warnings.simplefilter("ignore")
        read(tmp_path, base + text + "\n")
    said = str(refused.value)
    assert "\n" not in said and str(tmp_path / "robot.toml") in said
    assert all(part in said for part in BAD[text]), said


def test_pieces_that_are_none_are_refused():
    for make in (
        lambda: Rod.of_pieces(()),
        lambda: Rod.of_pieces((Piece.round(0.2, 0.001, E, G), Piece.round(0.1, 0.001, E, G))),
        lambda: Piece.round(0.2, 0.001, E, G, 0.0, (0.0005, 0.001)),
        lambda: Piece.oval(0.2, (0.001, math.nan), E, G),
        lambda: Rod.of_pieces((Piece.of_stiffness(0.2, torch.eye(3), -torch.eye(3)),)),
        lambda: replace(Rod.of_pieces(RODS["step"][0]), length=0.5),
        lambda: replace(Rod.of_pieces(RODS["step"][0]), masses=T([[0.5, 0.1]])),
    ):
        with pytest.raises(ValueError, match=r"\w"):
            make()
