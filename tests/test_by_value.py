"""What is kept from call to call is kept by the numbers it was worked out from, however these have come to change."""

from collections.abc import Callable
from dataclasses import replace
from itertools import count

import numpy as np
import pytest
import torch

from tests.problems import posed
from tests.robots import T, busy_robot, steel_rod
from tests.test_fast import needs_compiler
from torchrod import Estimate, GaussianCoordinates, Markers, Problem, Robot, Settings, Tracker, Unknowns, cold_start, estimate
from torchrod.estimation import at_rest as equilibrium
from torchrod.estimation import walk
from torchrod.estimation.at_rest import without_load
from torchrod.estimation.solve import linearize
from torchrod.mechanics.rod import Rod
from torchrod.util.by_value import Kept, key

S = T([0.1, 0.2, 0.3, 0.4], dtype=torch.float64)
LOADS = GaussianCoordinates(1, 0.4, 1.0)


def positions() -> torch.Tensor:
    return torch.stack([0.02 * S, 0 * S, S], -1).repeat(3, 1, 1)


def twin(robot: Robot) -> Robot:
    """The same robot in tensors of its own."""
    rod = robot.rod
    own = Rod(rod.length, rod.K_se.clone(), rod.K_bt.clone(), rod.mass_per_length.clone(), rod.reference_curvature.clone())
    return Robot(own, robot.tendons, robot.gravity.clone())


def again(problem: Problem) -> Problem:
    """The same problem in tensors of its own, of which nothing has been worked out yet."""
    markers = problem.markers
    assert markers is not None and markers.offsets is not None
    tension = None if problem.tension is None else problem.tension.clone()
    s, p, offsets = markers.s.clone(), markers.positions.clone(), markers.offsets.clone()
    return posed(s, p, markers.noise, twin(problem.robot), LOADS, tension, offsets)


_drawn = count(1)


def hanging(with_tendons: bool) -> Problem:
    """Another robot and other offsets at every call: what other tests have left behind is not what is looked up here."""
    own = 1.0 + 1e-3 * next(_drawn)
    robot = busy_robot() if with_tendons else Robot(busy_robot().rod, gravity=T([0.0, -9.81, 0.0]))
    rod = robot.rod
    robot = replace(robot, rod=Rod(rod.length, rod.K_se, own * rod.K_bt, rod.mass_per_length, rod.reference_curvature))
    tension = T([[3.0, 2.0], [1.0, 4.0], [0.0, 7.0]]) if with_tendons else None
    return again(posed(S, positions(), 1e-3, robot, LOADS, tension, 0.005 * own * torch.eye(4, 3)))


def numpy_times(x: torch.Tensor, factor: float) -> None:
    y = x.numpy()
    np.multiply(y, factor, out=y)


WAYS: dict[str, Callable[[torch.Tensor, float], object]] = {
    "in place": lambda x, factor: x.mul_(factor),
    "data": lambda x, factor: x.data.mul_(factor),
    "numpy": numpy_times,
}
PARTS: dict[str, Callable[[Problem], torch.Tensor | None]] = {
    "stiffness": lambda problem: problem.robot.rod.K_bt,
    "gravity": lambda problem: problem.robot.gravity,
    "mass": lambda problem: problem.robot.rod.mass_per_length,
    "s": lambda problem: problem.s,
    "offsets": lambda problem: problem.sensors[0].offsets,  # pyright: ignore[reportAttributeAccessIssue]
    "positions": lambda problem: problem.sensors[0].positions,  # pyright: ignore[reportAttributeAccessIssue]
    "tension": lambda problem: problem.tension,
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("part", PARTS)
def test_an_answer_follows_what_it_was_worked_out_from(part, way):
    """Also on the same Problem; and what was kept for the numbers of before is not what they have become."""

    def fitted(problem: Problem) -> Estimate:
        return estimate(problem, Settings(restarts=(), basins=0))

    for with_tendons in (False, True):
        problem = hanging(with_tendons)
        former, tensor = again(problem), PARTS[part](problem)
        if tensor is None:
            continue
        before = fitted(problem)
        WAYS[way](tensor, 0.9)
        after, fresh = fitted(problem), fitted(again(problem))
        assert torch.equal(after.x, fresh.x)
        assert torch.equal(after.covariance, fresh.covariance)
        assert not torch.equal(after.x, before.x)
        assert torch.equal(fitted(former).x, before.x)


@pytest.mark.parametrize("way", WAYS)
def test_a_start_follows_a_robot_that_changes(way):
    """Of a problem that is made anew; the same one keeps its units (Problem says so), and `estimate` makes its own."""
    for robot in (twin(steel_rod()), twin(Robot(busy_robot().rod, gravity=T([0.0, -9.81, 0.0])))):
        problem = posed(S, positions(), 1e-3, robot, LOADS)
        first = cold_start(problem).x
        for change in (robot.rod.K_bt, robot.gravity, robot.rod.mass_per_length):
            WAYS[way](change, 1.5)
            fresh = posed(S, positions(), 1e-3, twin(robot), LOADS)
            assert robot.rod.force_scale == fresh.robot.rod.force_scale
            for same in (posed(S, positions(), 1e-3, robot, LOADS), replace(problem)):
                assert torch.equal(cold_start(same).x, cold_start(fresh).x)
        assert not torch.equal(first, cold_start(replace(problem)).x) or not bool(robot.weight.any())


@pytest.mark.parametrize("way", WAYS)
def test_a_shape_without_load_follows_its_arc_lengths(way):
    robot = Robot(busy_robot().rod, gravity=T([0.0, -9.81, 0.0]))
    problem = posed(S.clone(), positions(), 1e-3, robot)
    before = without_load(problem).p
    WAYS[way](problem.s, 0.9)
    after = without_load(problem).p
    assert torch.equal(after, without_load(posed(0.9 * S, positions(), 1e-3, robot)).p)
    assert not torch.equal(before, after)


@pytest.mark.parametrize("way", ["in place", "numpy"])
def test_markers_that_go_missing(way):
    problem = posed(S, positions())
    markers = problem.markers
    assert markers is not None and markers.present.all()
    assert estimate(problem).accepted.all()
    where = markers.positions if way == "in place" else markers.positions.numpy()
    where[1, 2, 0] = torch.nan
    assert markers.present.tolist() == [[True] * 4, [True, True, False, True], [True] * 4]
    where[0, 0, 2] = torch.nan
    where[2, 3, 1] = torch.inf
    assert (~markers.present).nonzero().tolist() == [[0, 0], [1, 2], [2, 3]]
    fit = estimate(problem)
    assert fit.residual.isnan().any(-1).nonzero().tolist() == [[0, 0], [1, 2], [2, 3]]
    assert torch.equal(fit.x, estimate(posed(S, markers.positions.clone())).x)
    with pytest.raises(ValueError, match=r"Markers.positions has shape"):
        Markers(S[:3], positions(), 1e-3).check()


@needs_compiler
def test_single_precision_is_worked_out_once(monkeypatch):
    """Arc lengths and positions as a camera gives them, made float64 anew for each call."""
    robot, asked = Robot(busy_robot().rod, gravity=T([0.0, -9.81, 0.0])), []
    layout, rest = walk._layout, equilibrium.at_rest
    monkeypatch.setattr(walk, "_layout", lambda *a: asked.append("layout") or layout(*a))
    monkeypatch.setattr(equilibrium, "at_rest", lambda *a: asked.append("rest") or rest(*a))

    def posed_again() -> Problem:
        return posed(S.float() * 0.99, positions().float(), 1e-3, robot, LOADS)

    follow = Tracker(robot, Unknowns(LOADS), S.float() * 0.99, 1e-3)
    calls = (
        lambda: estimate(posed_again()),
        lambda: without_load(posed_again()),
        lambda: follow(positions()[0].float()),
    )
    for call in calls:
        call()
    assert set(asked) == {"layout", "rest"}
    asked.clear()
    for call in calls:
        call()
    assert not asked


def test_what_is_worked_out_in_inference_mode_serves_outside_of_it():
    problem, weight = hanging(False), torch.ones(3, 4, dtype=torch.float64, requires_grad=True)
    with torch.inference_mode():
        without_load(problem)
        within = estimate(problem)
        markers = Markers(S, positions().clone(), 1e-3)
        assert markers.present.all()
        markers.positions[0, 0] = torch.nan
        assert not markers.present.all()
        made_within = posed(S.clone(), markers.positions)
        first = estimate(made_within)
    assert not without_load(problem).wrench.is_inference()
    x = within.x.clone().requires_grad_()
    found = linearize(problem, x)
    found.cost.sum().backward()
    assert x.grad is not None and x.grad.isfinite().all()
    assert problem.markers is not None
    torch.where(problem.markers.present, weight, 0.0).sum().backward()
    assert weight.grad is not None
    assert torch.equal(estimate(made_within).x, first.x)
    assert torch.equal(estimate(problem).x, within.x)


def test_keys_are_equal_where_all_numbers_are():
    one, other = torch.arange(6.0).reshape(2, 3), torch.arange(6.0).reshape(2, 3)
    assert key(one) == key(other) and hash(key(one)) == hash(key(other))
    assert key(one) == key(torch.arange(6.0).reshape(3, 2).mT.contiguous().mT.reshape(2, 3))
    assert key(one) != key(one.reshape(3, 2)) and key(one) != key(one.long())
    assert key(one) == key(torch.stack([one, one], -1)[..., 0]), "whatever the strides"
    assert key((steel_rod(), one, None)) == key((twin(steel_rod()), other, None))
    before = key((steel_rod(), one))
    numpy_times(one, 2.0)
    assert key((steel_rod(), one)) != before
    robot = twin(steel_rod())
    before = key(robot)
    robot.rod.K_se.data.mul_(1.1)
    assert key(robot) != before


def test_worked_out_once():
    kept, asked = Kept(2), []

    def ask(number: int) -> int:
        return kept(number, lambda: asked.append(number) or 10 * number)

    assert [ask(1), ask(1), ask(2), ask(1)] == [10, 10, 20, 10]
    assert asked == [1, 2]
    assert [ask(3), ask(1), ask(3), ask(2)] == [30, 10, 30, 20], "the one that was asked for longest ago is worked out again"
    assert asked == [1, 2, 3, 2]
