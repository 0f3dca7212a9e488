"""The rough equilibrium that starts are made of, by the kernel and without it, against the forward solve."""

from dataclasses import replace

import pytest
import torch

from tests.robots import T, busy_robot, steel_rod
from tests.test_fast import TENSION, needs_compiler, stiffened
from torchrod import GaussianCoordinates, Markers, Model, PaperCoordinates, PointCoordinates, Robot, Tendon, Tendons, kernel
from torchrod.estimation import at_rest as equilibrium
from torchrod.estimation.at_rest import Rest, at_rest, without_load
from torchrod.mechanics.statics import solve_shape


def heavy() -> Robot:
    """So heavy that the weight is put on in three parts, with a tendon."""
    rod = steel_rod().rod
    weight = T([2.0, -1.0, 0.5]) * 5.0 * rod.bending_stiffness / rod.length**3 / T([2.0, -1.0, 0.5]).norm()
    return Robot(replace(rod, mass_per_length=T(1.0)), Tendons((Tendon.straight(0.008, 0.0, 0.4),)), weight)


ROBOTS = {"passive": steel_rod, "tendons and gravity": busy_robot, "full stiffness": stiffened, "heavy": heavy}


def case(robot: Robot, coordinates) -> tuple[Model, Markers, torch.Tensor]:
    """Five samples at places that are not nodes of the coarse grid."""
    generator = torch.Generator().manual_seed(2)
    tension = TENSION[torch.tensor([0, 1, 2, 0, 1]), : len(robot.tendons)] if len(robot.tendons) else None
    gamma = coordinates.start().expand(5, -1)
    gamma = gamma + torch.where(gamma.abs() > 100, 0.1 * gamma.abs(), 0.3) * torch.randn(5, coordinates.size, generator=generator)
    return Model(robot, coordinates), Markers(T([0.013, 0.2, 0.31, 0.4]), torch.zeros(5, 4, 3), None, tension), gamma


def solved(model: Model, markers: Markers, gamma: torch.Tensor) -> Rest:
    loads = model.coordinates.loads(gamma) if gamma.shape[-1] else ()
    shape = solve_shape(model.robot, loads, markers.tension, markers.s, len(gamma), 160)
    return Rest(shape.base_wrench, shape.p)


def agree(found: Rest, exact: Rest) -> None:
    """To what ROUGH_TOLERANCE and twenty steps leave."""
    assert torch.allclose(found.p, exact.p, atol=3e-5, rtol=0)
    assert torch.allclose(found.wrench, exact.wrench, atol=2e-4, rtol=1e-3)


KINDS = ("one gaussian", "two gaussians", "the paper's", "point")
WAYS = [pytest.param(robot, kind, True, marks=needs_compiler, id=f"{robot}-{kind}-kernel") for robot in ROBOTS for kind in KINDS]
# Without the kernel every kind of load goes the same way, which is slow: one of them for two robots.
WAYS += [
    pytest.param(robot, "one gaussian", False, id=f"{robot}-one gaussian-torch") for robot in ("passive", "tendons and gravity")
]


@pytest.mark.parametrize(("robot", "kind", "compiled"), WAYS)
def test_it_is_the_forward_solve(robot, kind, compiled, monkeypatch):
    r = ROBOTS[robot]()
    f = r.rod.force_scale
    coordinates = {
        "one gaussian": GaussianCoordinates(1, 0.4, f),
        "two gaussians": GaussianCoordinates(2, 0.4, f),
        "the paper's": PaperCoordinates(1, 0.4, 0.02, eps=0.3, beta1=-0.01, beta2=0.43),
        "point": PointCoordinates(1, 0.4, f),
    }[kind]
    model, markers, gamma = case(r, coordinates)
    exact, bare = solved(model, markers, gamma), solved(model, markers, gamma[:, :0])
    if compiled and kind != "point":  # a point moves the nodes, and is left to the forward solve
        monkeypatch.setattr(equilibrium, "solve_shape", None)
    elif not compiled:
        monkeypatch.setattr(kernel, "available", lambda: False)
    agree(at_rest(model, markers, gamma), exact)
    agree(without_load(model, markers), bare)
    loads = model.coordinates.loads(gamma)
    q_tip = solve_shape(r, loads, markers.tension, markers.s, 5, 40).q[:, -1]
    agree(at_rest(model, markers, gamma, q_tip), exact)


@needs_compiler
def test_what_does_not_settle_is_solved_in_the_definition(monkeypatch):
    """A start for the tip that is nowhere near, for one sample; and a tension that is no number disturbs nobody."""
    model, markers, gamma = case(busy_robot(), GaussianCoordinates(1, 0.4, 1.0))
    exact = solved(model, markers, gamma)
    asked = []
    monkeypatch.setattr(equilibrium, "solve_shape", lambda *a, **k: asked.append(a[4]) or solve_shape(*a, **k))
    q_tip = solve_shape(model.robot, model.coordinates.loads(gamma), markers.tension, markers.s, 5, 40).q[:, -1]
    q_tip[2] = torch.nan
    found = at_rest(model, markers, gamma, q_tip)
    assert asked == [1]
    keep = torch.tensor([0, 1, 3, 4])
    agree(Rest(found.wrench[keep], found.p[keep]), Rest(exact.wrench[keep], exact.p[keep]))
    assert markers.tension is not None
    tension = markers.tension.clone()
    tension[1] = torch.nan
    found = at_rest(model, replace(markers, tension=tension), gamma)
    assert found.wrench[1].isnan().all()
    keep = torch.tensor([0, 2, 3, 4])
    agree(Rest(found.wrench[keep], found.p[keep]), Rest(exact.wrench[keep], exact.p[keep]))
