"""Rods that are curved without load, with pieces and jumps, against closed forms; and steps that follow curvature and load."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from tests.robots import T, steel_rod
from torchrod import InputError, PointForces, PointWrenches, Robot, Rod, Status, read_robot, solve_shape
from torchrod.mechanics import statics
from torchrod.mechanics.statics import steps_for

BAR = 1e-4  # m


def curved(length: float, rows) -> Robot:
    return Robot(Rod.circular(length, 1e-3, 60e9, 23e9, reference_curvature=T(rows, dtype=torch.float64)))


def turn(u: np.ndarray, s: float) -> tuple[np.ndarray, np.ndarray]:
    """R and p after s of constant curvature u: the exponential of a constant twist."""
    w = float(np.linalg.norm(u))
    k = np.array([[0, -u[2], u[1]], [u[2], 0, -u[0]], [-u[1], u[0], 0]])
    if w * s < 1e-9:
        return np.eye(3), np.array([0.0, 0.0, s])
    a, b = np.sin(w * s) / w, (1 - np.cos(w * s)) / w**2
    return np.eye(3) + a * k + b * k @ k, (s * np.eye(3) + b * k + (s - a) / w**2 * k @ k) @ np.array([0.0, 0.0, 1.0])


def chain(pieces: list[tuple[float, np.ndarray]], s: float) -> np.ndarray:
    """p(s) of a rod of constant pieces (length, u)."""
    R, p = np.eye(3), np.zeros(3)
    for length, u in pieces:
        part = min(length, s)
        dR, dp = turn(u, part)
        R, p, s = R @ dR, p + R @ dp, s - part
    return p


def rows_of(pieces: list[tuple[float, np.ndarray]]) -> list[list[float]]:
    """The table of the robot file, with a jump between two pieces."""
    rows, s = [], 0.0
    for length, u in pieces:
        rows += [[s, *u], [s + length, *u]]
        s += length
    return rows


def members() -> list[list[tuple[float, np.ndarray]]]:
    """Random rods of each kind: J-tips, step-curved tubes, arcs of opposite sign, pigtails with torsion, coils up to 40 turns."""
    rng = np.random.default_rng(16)
    found = []
    for _ in range(6):
        radius, tip = rng.uniform(3e-3, 15e-3), rng.uniform(0.5, 4.0)
        found.append([(rng.uniform(0.3, 1.5), np.zeros(3)), (radius * tip, np.array([0, 1 / radius, 0]))])
        found.append([(rng.uniform(0.02, 0.2), rng.uniform(-20, 20, 3)) for _ in range(rng.integers(2, 6))])
        u = rng.uniform(5, 40)
        found.append([(0.1, np.array([u, 0, 0])), (0.15, np.array([-u, 0, 0]))])
        found.append([(rng.uniform(0.1, 0.5), np.zeros(3)), (0.12, np.array([0, rng.uniform(100, 300), rng.uniform(-60, 60)]))])
        turns, length = rng.uniform(5, 40), rng.uniform(0.3, 1.0)
        w = 2 * math.pi * turns / length
        lead = [(rng.uniform(0.01, 0.3), np.zeros(3))] if rng.random() < 0.5 else []
        found.append([*lead, (length, w * np.array([0.0, 0.97, 0.243])), (rng.uniform(0.01, 0.3), np.zeros(3))])
    return found


@pytest.mark.parametrize("pieces", members(), ids=lambda pieces: f"{len(pieces)} pieces")
def test_pieces_of_constant_curvature(pieces):
    length = sum(part for part, _ in pieces)
    s = torch.linspace(0.11, 1, 7) * length
    shape = solve_shape(curved(length, rows_of(pieces)), (), None, s, 1)
    exact = np.stack([chain(pieces, float(x)) for x in s])
    assert shape.status[0] == Status.CONVERGED
    assert np.abs(shape.p[0].numpy() - exact).max() < 0.1 * BAR


def test_a_table_that_is_linear_between_its_rows():
    rng = np.random.default_rng(4)
    for _ in range(4):
        knots = np.concatenate([[0.0], np.sort(rng.uniform(0.02, 0.38, 3)), [0.4]])
        u = rng.uniform(-30, 30, (5, 3))

        def rate(s, y, knots=knots, u=u):
            x, y_, z = (np.interp(s, knots, u[:, i]) for i in range(3))
            R = y[:9].reshape(3, 3)
            return np.concatenate([(R @ np.array([[0, -z, y_], [z, 0, -x], [-y_, x, 0]])).ravel(), R[:, 2]])

        start = np.concatenate([np.eye(3).ravel(), np.zeros(3)])
        exact = solve_ivp(rate, (0, 0.4), start, method="DOP853", rtol=1e-11, atol=1e-12, max_step=2e-3).y[9:, -1]
        shape = solve_shape(curved(0.4, np.column_stack([knots, u]).tolist()), (), None, T([0.4]), 1)
        assert np.abs(shape.p[0, 0].numpy() - exact).max() < 0.1 * BAR


def test_a_jump_at_either_end_and_a_narrow_ramp():
    arc = [[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 9.0, 0.0], [0.3, 0.0, 9.0, 0.0], [0.3, 0.0, 0.0, 0.0]]
    exact = chain([(0.3, np.array([0, 9.0, 0]))], 0.3)
    assert np.abs(solve_shape(curved(0.3, arc), (), None, T([0.3]), 1).p[0, 0].numpy() - exact).max() < 1e-7
    ramp = [[0.0, 0, 0, 0], [0.052, 0, 0, 0], [0.052001, 0, 20, 0], [0.2, 0, 20, 0]]
    shape = solve_shape(curved(0.2, ramp), (), None, T([0.2]), 1)
    assert (shape.p[0, 0] - T([0.099178, 0.0, 0.061031])).abs().max() < 2e-6


def test_the_number_of_steps_follows_the_rod_and_is_kept_by_value(monkeypatch):
    s = T([0.1, 0.4])
    assert steps_for(steel_rod(), s) == 40
    assert steps_for(curved(0.4, [[0.0, 0.0, 5.0, 0.0]]), s) == 40
    lever = rows_of([(0.1, np.array([0.0, 600.0, 0.0])), (1.9, np.zeros(3))])
    assert steps_for(curved(2.0, lever), s) > 40
    monkeypatch.setattr(statics, "_halved", None)  # would be called for a rod that is not known
    assert steps_for(curved(2.0, lever), s.clone()) > 40
    with pytest.raises(TypeError):
        steps_for(curved(2.0, rows_of([(0.1, np.array([0.0, 601.0, 0.0])), (1.9, np.zeros(3))])), s)


def written(tmp_path, curvature: str):
    path = tmp_path / "robot.toml"
    path.write_text(
        f"[rod]\nlength = 0.2\ndiameter = 0.0015\nyoungs_modulus = 60e9\nshear_modulus = 23e9\nreference_curvature = {curvature}\n"
    )
    return path


def test_rows_of_the_robot_file(tmp_path):
    robot = read_robot(written(tmp_path, "[[0.0, 0, 0, 0], [0.05, 0, 0, 0], [0.05, 0, 20, 0], [0.2, 0, 20, 0]]"))
    exact = chain([(0.05, np.zeros(3)), (0.15, np.array([0, 20.0, 0]))], 0.2)
    assert np.abs(solve_shape(robot, (), None, T([0.2]), 1).p[0, 0].numpy() - exact).max() < 1e-6
    for rows, told in (
        ("[[0.05, 0, 0, 0], [0.04, 0, 0, 0]]", "not fall"),
        ("[[0.0, 0, 0, 0], [0.1, 0, 0, 0], [0.1, 0, 5, 0], [0.1, 0, 9, 0]]", "more than two rows"),
        ("[0.0, 2e4, 0.0]", "1/m"),
        ("[]", "rows"),
    ):
        with pytest.raises(InputError, match=told):
            read_robot(written(tmp_path, rows))


def wrenches(count: int) -> list:
    """Loads up to far beyond what 40 steps follow, of every kind that simulate takes."""
    rng = np.random.default_rng(7)
    found = []
    for i in range(count):
        size = 10 ** rng.uniform(-1, 2)
        way = rng.standard_normal(3)
        way /= np.linalg.norm(way)
        zero, push, s = torch.zeros(1, 1, 3), T((size * way).tolist()).reshape(1, 1, 3), T([0.4])
        turned = 0.05 * push
        kinds = (
            PointForces(push * T([1.0, 1.0, 0.0]), T([[rng.uniform(0.05, 0.39)]])),
            PointWrenches(zero, turned, s, "local"),
            PointWrenches(torch.stack([0.1 * size * T([0.3, 0.0, 1.0])]).reshape(1, 1, 3), zero, s),
            PointWrenches(zero, turned * T([0.0, 1.0, 0.0]), s),
        )
        found.append(kinds[i % 4])
    return found


@pytest.mark.parametrize("load", wrenches(24), ids=lambda load: type(load).__name__)
def test_a_load_is_followed_or_refused(load):
    """Within 0.1 mm of 4,000 steps, or NOT_CONVERGED."""
    found = solve_shape(steel_rod(), (load,), None, T([0.2, 0.4]), 1)
    if found.status[0] == Status.CONVERGED:
        fine = solve_shape(steel_rod(), (load,), None, T([0.2, 0.4]), 1, 4000)
        assert (found.p - fine.p).abs().max() < BAR
    else:
        assert found.p.isnan().all()


def test_forty_steps_were_not_enough():
    """What the test above is for: with 40 steps a 200 N push is off by more than it allows."""
    load = PointForces(T([[[200.0, 0.0, 0.0]]]), T([[0.2]]))
    coarse, fine = (solve_shape(steel_rod(), (load,), None, T([0.4]), 1, n).p for n in (40, 4000))
    assert (coarse - fine).abs().max() > 10 * BAR
    both = PointForces(T([[[200.0, 0.0, 0.0]], [[0.1, 0.0, 0.0]]]), T([[0.2], [0.3]]))
    together = solve_shape(steel_rod(), (both,), None, T([0.4]), 2)
    alone = solve_shape(steel_rod(), (PointForces(both.force[1:], both.s[1:]),), None, T([0.4]), 1)
    assert (together.p[0] - fine[0]).abs().max() < BAR
    assert (together.p[1] - alone.p[0]).abs().max() < 1e-12, "a neighbour that needs more steps has disturbed it"
