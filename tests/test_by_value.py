"""What is kept from call to call holds no longer than the tensors it was worked out from."""

import torch
from torchrod.util.kept import kept, version

from tests.robots import T, busy_robot, steel_rod
from torchrod import GaussianCoordinates, Markers, Model, Robot, cold_start, estimate
from torchrod.estimation.at_rest import without_load
from torchrod.mechanics.rod import Rod

S = T([0.1, 0.2, 0.3, 0.4], dtype=torch.float64)


def positions() -> torch.Tensor:
    return torch.stack([0.02 * S, 0 * S, S], -1).repeat(3, 1, 1)


def test_markers_that_go_missing_in_place():
    markers = Markers(S, positions())
    assert markers.present.all()
    assert markers.present is markers.present
    markers.positions[1, 2, 0] = torch.nan
    assert markers.present.tolist() == [[True] * 4, [True, True, False, True], [True] * 4]
    markers.positions[0, 0, 2] = torch.nan
    markers.positions[2, 3, 1] = torch.inf
    assert (~markers.present).nonzero().tolist() == [[0, 0], [1, 2], [2, 3]]
    assert Markers(S[:3], positions()).misshapen is not None


def twin(robot: Robot) -> Robot:
    """The same robot in tensors of its own, for which nothing is kept yet."""
    rod = robot.rod
    own = Rod(rod.length, rod.K_se.clone(), rod.K_bt.clone(), rod.mass_per_length.clone(), rod.reference_curvature.clone())
    return Robot(own, robot.tendons, robot.gravity.clone())


def test_a_robot_that_changes_in_place():
    """Every start and every answer afterwards is that of a robot which has been so from the beginning."""
    heavy = Robot(busy_robot().rod, gravity=T([0.0, -9.81, 0.0]))
    for robot in (twin(steel_rod()), twin(heavy)):
        model, markers = Model(robot, GaussianCoordinates(1, 0.4, 1.0)), Markers(S, positions())
        found = [estimate(model, markers, 1e-3).x]
        for change in (robot.rod.K_bt, robot.gravity, robot.rod.mass_per_length):
            change.mul_(1.5)
            fresh = Model(twin(robot), GaussianCoordinates(1, 0.4, 1.0))
            assert torch.equal(cold_start(model, markers, 1e-3).x, cold_start(fresh, markers, 1e-3).x)
            assert robot.rod.force_scale == fresh.robot.rod.force_scale
            now = estimate(Model(robot, model.coordinates), markers, 1e-3).x
            assert torch.equal(now, estimate(fresh, markers, 1e-3).x)
            found.append(now)
        assert not torch.equal(found[0], found[1])


def test_arc_lengths_that_change_in_place():
    model = Model(Robot(busy_robot().rod, gravity=T([0.0, -9.81, 0.0])), GaussianCoordinates(1, 0.4, 1.0))
    markers = Markers(S.clone(), positions())
    before = without_load(model, markers).p
    markers.s.mul_(0.9)
    after = without_load(model, markers).p
    assert torch.equal(after, without_load(model, Markers(0.9 * S, positions())).p)
    assert not torch.equal(before, after)


def test_a_tensor_of_inference_mode_is_looked_at_every_time():
    with torch.inference_mode():
        markers = Markers(S, positions().clone())
        assert markers.present.all()
        markers.positions[0, 0] = torch.nan
        assert not markers.present.all()
    assert version(markers.positions) != version(markers.positions)


def test_what_is_kept_in_inference_mode_serves_autograd():
    markers, weight = Markers(S, positions()), torch.ones(3, 4, dtype=torch.float64, requires_grad=True)
    model = Model(steel_rod(), GaussianCoordinates(1, 0.4, 1.0))
    with torch.inference_mode():
        without_load(model, markers)
        assert markers.present.all()
    assert not without_load(model, markers).wrench.is_inference()
    torch.where(markers.present, weight, 0.0).sum().backward()
    assert weight.grad is not None


def test_worked_out_once():
    markers, asked = Markers(S, positions()), []

    def work_out(x: torch.Tensor) -> int:
        asked.append(x)
        return len(asked)

    assert [kept(markers, "count", markers.positions, work_out) for _ in range(3)] == [1, 1, 1]
    markers.positions.add_(1.0)
    assert kept(markers, "count", markers.positions, work_out) == 2
