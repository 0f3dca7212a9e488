"""The rough equilibrium that starts are made of, by the kernel and without it, against the forward solve."""

from dataclasses import replace

import pytest
import torch

from tests.problems import posed
from tests.robots import T, busy_robot, steel_rod
from tests.test_fast import TENSION, needs_compiler, stiffened
from torchrod import GaussianCoordinates, PaperCoordinates, PointCoordinates, Problem, Robot, Tendon, Tendons, kernel
from torchrod.estimation import at_rest as equilibrium
from torchrod.estimation.at_rest import Rest, at_rest, without_load
from torchrod.mechanics.statics import solve_shape


def heavy() -> Robot:
    """So heavy that the weight is put on in three parts, with a tendon."""
    rod = steel_rod().rod
    weight = T([2.0, -1.0, 0.5]) * 5.0 * rod.bending_stiffness / rod.length**3 / T([2.0, -1.0, 0.5]).norm()
    return Robot(replace(rod, mass_per_length=T(1.0)), Tendons((Tendon.straight(0.008, 0.0, 0.4),)), weight)


ROBOTS = {"passive": steel_rod, "tendons and gravity": busy_robot, "full stiffness": stiffened, "heavy": heavy}


def case(robot: Robot, family) -> tuple[Problem, torch.Tensor]:
    """Five samples at places that are not nodes of the coarse grid."""
    generator = torch.Generator().manual_seed(2)
    tension = TENSION[torch.tensor([0, 1, 2, 0, 1]), : len(robot.tendons)] if len(robot.tendons) else None
    gamma = family.start().expand(5, -1)
    gamma = gamma + torch.where(gamma.abs() > 100, 0.1 * gamma.abs(), 0.3) * torch.randn(5, family.size, generator=generator)
    return posed(T([0.013, 0.2, 0.31, 0.4]), torch.zeros(5, 4, 3), 1e-3, robot, family, tension), gamma


def solved(problem: Problem, gamma: torch.Tensor) -> Rest:
    loads = problem.unknowns.loads.loads(gamma) if gamma.shape[-1] else ()
    shape = solve_shape(problem.robot, loads, problem.tension, problem.s, len(gamma), 160)
    return Rest(shape.base_wrench, shape.p)


def agree(found: Rest, exact: Rest) -> None:
    """To what ROUGH_TOLERANCE and twenty steps leave."""
    assert torch.allclose(found.p, exact.p, atol=3e-5, rtol=0)
    assert torch.allclose(found.wrench, exact.wrench, atol=2e-4, rtol=1e-3)


KINDS = ("one gaussian", "two gaussians", "the paper's", "point")
WAYS = [pytest.param(robot, kind, True, marks=needs_compiler, id=f"{robot}-{kind}-kernel") for robot in ROBOTS for kind in KINDS]
# Without the kernel every kind of load goes the same way, which is slow: one of them for two robots.
WAYS += [
    pytest.param("passive", "one gaussian", False, id="passive-one gaussian-torch"),
    pytest.param(
        "tendons and gravity", "one gaussian", False, marks=pytest.mark.study, id="tendons and gravity-one gaussian-torch"
    ),
]


@pytest.mark.parametrize(("robot", "kind", "compiled"), WAYS)
def test_it_is_the_forward_solve(robot, kind, compiled, monkeypatch):
    r = ROBOTS[robot]()
    f = r.rod.force_scale
    family = {
        "one gaussian": GaussianCoordinates(1, 0.4, f),
        "two gaussians": GaussianCoordinates(2, 0.4, f),
        "the paper's": PaperCoordinates(1, 0.4, 0.02, eps=0.3, beta1=-0.01, beta2=0.43),
        "point": PointCoordinates(1, 0.4, f),
    }[kind]
    problem, gamma = case(r, family)
    exact, bare = solved(problem, gamma), solved(problem, gamma[:, :0])
    q_tip = solve_shape(r, family.loads(gamma), problem.tension, problem.s, 5, 40).q[:, -1]
    if compiled and kind != "point":  # a point moves the nodes, and is left to the forward solve
        monkeypatch.setattr(equilibrium, "solve_shape", None)
    elif not compiled:
        monkeypatch.setattr(kernel, "available", lambda: False)
    agree(at_rest(problem, gamma), exact)
    agree(without_load(problem), bare)
    agree(at_rest(problem, gamma, q_tip), exact)


@needs_compiler
def test_what_does_not_settle_is_solved_in_the_definition(monkeypatch):
    """A start for the tip that is nowhere near, for one sample; and a tension that is no number disturbs nobody."""
    problem, gamma = case(busy_robot(), GaussianCoordinates(1, 0.4, 1.0))
    exact = solved(problem, gamma)
    asked = []
    monkeypatch.setattr(equilibrium, "solve_shape", lambda *a, **k: asked.append(a[4]) or solve_shape(*a, **k))
    q_tip = solve_shape(problem.robot, problem.unknowns.loads.loads(gamma), problem.tension, problem.s, 5, 40).q[:, -1]
    q_tip[2] = torch.nan
    found = at_rest(problem, gamma, q_tip)
    assert asked == [1]
    keep = torch.tensor([0, 1, 3, 4])
    agree(Rest(found.wrench[keep], found.p[keep]), Rest(exact.wrench[keep], exact.p[keep]))
    assert problem.tension is not None
    tension = problem.tension.clone()
    tension[1] = torch.nan
    found = at_rest(replace(problem, tension=tension), gamma)
    assert found.wrench[1].isnan().all()
    keep = torch.tensor([0, 2, 3, 4])
    agree(Rest(found.wrench[keep], found.p[keep]), Rest(exact.wrench[keep], exact.p[keep]))
