"""Tendons that run straight from disc to disc, against a solver that takes every line by itself (tests/discs.py)."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.discs import disc_by_disc
from tests.problems import slopes
from torchrod import (
    GaussianCoordinates,
    Markers,
    PointForces,
    PointWrenches,
    Problem,
    Robot,
    Rod,
    Tendon,
    Tendons,
    Unknowns,
    estimate,
    kernel,
    solve_displacement,
    solve_shape,
)
from torchrod.cli import main
from torchrod.estimation.evaluator import KernelEvaluator, TorchEvaluator, evaluator
from torchrod.io import read_robot
from torchrod.mechanics.lie import rotate

L = 0.27
HELIX = tuple((s, 0.007 * np.cos(4 * s), 0.007 * np.sin(4 * s)) for s in np.linspace(0, L, 12).tolist())
ROUTINGS = {"straight": [((0.0, 0.008, 0.0),)], "two": [((0.0, 0.008, 0.0),), ((0.0, -0.003, 0.007),)], "helix": [HELIX]}


def places(count: int) -> tuple[float, ...]:
    return (*(L * (i + 1) / count for i in range(count - 1)), L)


def robot_of(routings: list, discs: tuple[float, ...], mass: float = 0.08, mu: float = 0.0) -> Robot:
    """The rod of the real robot: 270 mm, 1 mm, 2 g discs at 27 mm as a mass per length."""
    tendons = tuple(Tendon(rows, L, friction=mu, discs=discs) for rows in routings)
    return Robot(Rod.circular(L, 0.001, 69e9, 26e9, mass), Tendons(tendons), torch.tensor([0.0, -9.81, 0.0], dtype=torch.float64))


def solved(robot: Robot, tension: list[float], force: list[float], s: tuple[float, ...]):
    dead = torch.tensor([[force]], dtype=torch.float64)
    load = PointWrenches(dead, 0 * dead, torch.tensor([L], dtype=torch.float64))
    shape = solve_shape(robot, (load,), torch.tensor([tension], dtype=torch.float64), torch.tensor(s, dtype=torch.float64), 1)
    assert shape.status[0] == 0
    return shape


def truth(robot: Robot, tension: list[float], force: list[float], count: int, mu: float = 0.0) -> np.ndarray:
    """The places of the discs by the other solver."""
    s = (0.0, *places(count))
    shape, at = solved(robot, tension, force, s), torch.tensor(s, dtype=torch.float64)
    r = torch.stack([t.offset_at(at)[0] for t in robot.tendons.tendons], 1)
    holes = shape.p[0].unsqueeze(1) + torch.stack([rotate(shape.q[0], r[:, j]) for j in range(r.shape[1])], 1)
    guess = holes.numpy(), shape.base_wrench[0, 3:].numpy()
    given = np.array(s[1:]), np.array(tension), np.array(force), robot.weight.numpy()
    return disc_by_disc(robot.rod.K_se.numpy(), robot.rod.K_bt.numpy(), r[..., :2].numpy(), *given, guess, mu)[0]


@pytest.mark.parametrize("routing", ROUTINGS)
def test_against_a_solver_of_lines(routing):
    """At ten discs a tendon that follows the rod misses by millimetres, one from disc to disc by a tenth of that at most."""
    tension, force = [2.0, 1.0][: len(ROUTINGS[routing])], [0.02, 0.04, 0.0]
    exact, errors = truth(robot_of(ROUTINGS[routing], places(10)), tension, force, 10), []
    for discs in ((), places(10)):
        p = solved(robot_of(ROUTINGS[routing], discs), tension, force, places(10)).p[0].numpy()
        errors.append(float(np.abs(p - exact).max()))
    assert errors[0] > 1e-3
    assert errors[1] < errors[0] / 10


def test_what_is_left_falls_with_the_spacing():
    missed = []
    for count in (10, 20):
        robot = robot_of(ROUTINGS["straight"], places(count))
        exact = truth(robot, [2.0], [0.02, 0.04, 0.0], count)
        missed.append(float(np.abs(solved(robot, [2.0], [0.02, 0.04, 0.0], places(count)).p[0].numpy() - exact).max()))
    assert missed[0] < 2e-4
    assert missed[1] < missed[0] / 3


def test_friction_in_the_holes():
    """Theta of the section is the turning in the holes by the midpoint rule: in a plane what is left falls with the square."""
    missed = []
    for count in (10, 20):
        robot = robot_of(ROUTINGS["straight"], places(count), 0.0, 0.2)
        exact = truth(robot, [2.0], [0.0, 0.0, 0.0], count, 0.2)
        missed.append(float(np.abs(solved(robot, [2.0], [0.0, 0.0, 0.0], places(count)).p[0].numpy() - exact).max()))
    assert missed[0] < 1e-4
    assert missed[1] < missed[0] / 3


@pytest.mark.skipif(not kernel.available(), reason="needs a compiler")
def test_kernel_and_derivatives():
    """To 1e-10, with friction, a tendon that follows the rod beside one that does not, and one that ends between discs."""
    robot = robot_of([((0.0, 0.008, 0.0),), HELIX, ((0.0, -0.003, 0.007),)], places(5), mu=0.1)
    own = robot.tendons.tendons
    robot = replace(robot, tendons=Tendons((own[0], replace(own[1], ends_at=0.2), replace(own[2], discs=()))))
    g = torch.Generator().manual_seed(2)
    markers = Markers(torch.tensor([0.1, 0.2, 0.27]), 0.1 * torch.randn(3, 3, 3, generator=g), 1e-3, 0.01 * torch.eye(3))
    tension = torch.tensor([[2.0, 1.0, 0.5], [4.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    problem = Problem(robot, Unknowns(GaussianCoordinates(1, L, robot.rod.force_scale), tension_std=0.3), [markers], tension, 2)
    x = 0.3 * torch.randn(3, problem.size, generator=g)
    assert isinstance(evaluator(problem), KernelEvaluator)
    _, H = problem.linearized(x)
    found, plain = KernelEvaluator(problem).sums(x), TorchEvaluator(problem).sums(x)
    for name in ("A", "g", "cost", "r", "C"):
        a, b = getattr(found, name), getattr(plain, name)
        assert (a - b).abs().max() < 1e-10 * b.abs().max(), name
    for slope, column in zip(slopes(problem, x, differentiable=False).unbind(-1), H.unbind(-1), strict=True):
        assert torch.allclose(slope, column, rtol=1e-5, atol=1e-6 * float(column.abs().max()))


def test_a_push_on_a_robot_with_discs():
    """Found on a shape of such a robot to 0.1 mm; taken for one whose tendon follows the rod it is not explained."""
    robot = robot_of(ROUTINGS["straight"], places(10))
    s = torch.tensor(places(10), dtype=torch.float64)
    load = PointForces(torch.tensor([[[0.05, 0.1, 0.0]]], dtype=torch.float64), torch.tensor([[0.2]], dtype=torch.float64))
    tension = torch.tensor([[2.0]], dtype=torch.float64)
    p = solve_shape(robot, (load,), tension, s, 1).p
    unknowns = Unknowns(GaussianCoordinates(1, L, robot.rod.force_scale, "point"))
    fit = estimate(Problem(robot, unknowns, [Markers(s, p, 1e-4)], tension))
    assert fit.accepted[0]
    assert abs(float(fit.location[0, 0]) - 0.2) < 5e-4
    follows = replace(robot, tendons=Tendons((replace(robot.tendons.tendons[0], discs=()),)))
    assert not estimate(Problem(follows, unknowns, [Markers(s, p, 1e-4)], tension)).accepted[0]


def test_displacement_shortens_the_way_through_the_holes():
    robot = robot_of(ROUTINGS["straight"], places(10))
    s = torch.tensor([0.0, *places(10)], dtype=torch.float64)
    answer = solve_displacement(robot, (), torch.tensor([[0.004]], dtype=torch.float64), s)
    at = answer.equilibrium
    holes = at.p[0] + rotate(at.q[0], torch.tensor([0.008, 0.0, 0.0], dtype=torch.float64).expand(11, 3))
    assert abs(float(holes.diff(dim=0).norm(dim=-1).sum()) - (L - 0.004)) < 1e-8
    assert 0.5 < float(answer.tension) < 3


ROD = """[rod]
length = 0.27
diameter = 0.001
youngs_modulus = 69e9
shear_modulus = 26e9
[[tendons]]
offset = [0.008, 0.0]
"""


def test_files(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    discs = [round(0.027 * (i + 1), 3) for i in range(10)]
    Path("m.toml").write_text(f"{ROD}discs = {discs}\n")
    Path("mm.toml").write_text(f"{ROD}discs_mm = {[27 * (i + 1) for i in range(10)]}\n")
    a, b = read_robot("m.toml").tendons.tendons[0], read_robot("mm.toml").tendons.tendons[0]
    assert a.discs == pytest.approx(b.discs)
    assert a.holes == pytest.approx((0.0, *discs))
    assert main(["simulate", "m.toml", "--tension", "2", "--at", *map(str, discs), "--out", "s.csv"]) == 0
    assert main(["estimate", "m.toml", "s.csv", "--noise", "1e-4", "--contacts", "auto", "--out", "r.json"]) == 0
    assert json.loads(Path("r.json").read_text())["results"][0]["loads"] == []
    capsys.readouterr()
    for value in ("[0.1, 0.05]", "[0.0, 0.1]", "[0.1, 0.3]", "0.1", '["a"]'):
        Path("bad.toml").write_text(f"{ROD}discs = {value}\n")
        assert main(["simulate", "bad.toml", "--tension", "2", "--out", "x.csv"]) == 2
        assert "tendons[0].discs" in capsys.readouterr().err
    with pytest.raises(ValueError, match="discs"):
        Tendon(((0.0, 0.008, 0.0),), L, discs=(0.2, 0.1))
