"""The tracker: frame after frame it finds what a batch finds, with missing markers, jumps and lost frames between."""

import pytest
import torch

from tests.robots import T, busy_robot, steel_rod
from torchrod import GaussianCoordinates, Origin, PointForces, Status, Tracker, Unknowns, cold_start, solve_shape
from torchrod.analysis import tracker as tracker_module
from torchrod.util.threads import kernel_threads, one_thread

FRAMES = 25


@pytest.mark.parametrize("kind", ["passive", "tendons"])
@pytest.mark.many_fits
def test_frame_after_frame(kind):
    robot, s, turn = (
        (busy_robot() if kind == "tendons" else steel_rod()),
        torch.linspace(0.02, 0.4, 20),
        torch.linspace(0, 3, FRAMES),
    )
    force = torch.stack([0.6 * turn.cos(), 0.6 * turn.sin(), 0 * turn], -1).unsqueeze(1)
    at = (0.25 + 0.1 * torch.sin(2 * turn)).unsqueeze(-1)
    tension = T([[3.0, 2.0]]) + torch.sin(turn).unsqueeze(-1) if kind == "tendons" else None
    p = solve_shape(robot, (PointForces(force, at),), tension, s, FRAMES).p
    p = p + 2e-4 * torch.randn(p.shape, generator=torch.Generator().manual_seed(0))
    p[8, 3], p[12] = torch.nan, torch.nan
    tracker = Tracker(robot, Unknowns(GaussianCoordinates(1, 0.4, robot.rod.force_scale, "point")), s, 2e-4)
    fits = [tracker(p[k], None if tension is None else tension[k]) for k in range(FRAMES)]
    seen = [k for k in range(FRAMES) if k != 12]
    assert Status(int(fits[12].status)) is Status.INVALID
    assert all(bool(fits[k].accepted) for k in seen)
    for k in seen:
        assert float((fits[k].force[0, 0] - force[k, 0, :2]).norm()) < 0.06, k
        assert abs(float(fits[k].location[0, 0] - at[k, 0])) < 0.012, k
    # After the first frame, and after the lost one, each begins where the last one ended.
    follow = [k for k in seen if k not in (0, 13)]
    assert all(bool(fits[k].warm_started) for k in follow)
    assert sum(int(fits[k].iterations) for k in follow) / len(follow) < 6


def test_a_jump_is_followed_and_reset_forgets():
    robot, s = steel_rod(), torch.linspace(0.02, 0.4, 20)
    force, at = T([[[0.9, 0.0, 0.0]], [[-0.9, 0.3, 0.0]]]), T([[0.39], [0.15]])
    p = solve_shape(robot, (PointForces(force, at),), None, s, 2).p
    tracker = Tracker(robot, Unknowns(GaussianCoordinates(1, 0.4, 1.0, "point")), s, 1e-4)
    fits = [tracker(p[0]), tracker(p[1])]
    for fit, f in zip(fits, force, strict=True):
        assert bool(fit.accepted)
        assert float((fit.force[0, 0] - f[0, :2]).norm()) < 0.02
    tracker.reset()
    again = tracker(p[1])
    assert torch.allclose(again.force, fits[1].force, atol=1e-4)


def test_a_refused_fit_is_no_start():
    """A frame that no contact explains, and which is finite all the same, is forgotten."""
    robot, s = steel_rod(), torch.linspace(0.02, 0.4, 20)
    p = solve_shape(robot, (PointForces(T([[[0.6, 0.2, 0.0]]]), T([[0.3]])),), None, s, 1).p[0]
    waved = p + 0.01 * torch.sin(40 * s).unsqueeze(-1)
    tracker = Tracker(robot, Unknowns(GaussianCoordinates(1, 0.4, 1.0, "point")), s, 1e-3)
    _, refused, after, onward = (tracker(each) for each in (p, waved, p, p))
    assert int(refused.guess) == Origin.PREVIOUS
    assert not refused.accepted and torch.isfinite(refused.x).all()
    assert int(after.guess) != Origin.PREVIOUS
    assert int(onward.guess) == Origin.PREVIOUS


def test_the_last_fit_is_challenged_at_the_tensions_of_the_frame(monkeypatch):
    robot, s, asked = busy_robot(), torch.linspace(0.02, 0.4, 20), []
    monkeypatch.setattr(tracker_module, "cold_start", lambda problem: asked.append(problem.tension.tolist()) or cold_start(problem))
    tension = T([[3.0, 2.0], [3.0, 2.0], [1.0, 4.0]])
    p = solve_shape(robot, (PointForces(T([[[0.6, 0.2, 0.0]]]), T([[0.3]])),), tension, s, 3).p
    tracker = Tracker(robot, Unknowns(GaussianCoordinates(1, 0.4, robot.rod.force_scale, "point")), s, 1e-3)
    for k in range(3):
        assert tracker(p[k], tension[k]).accepted
    assert asked[-2:] == [[[3.0, 2.0]], [[1.0, 4.0]]]


def test_a_few_samples_leave_torch_one_thread_and_the_kernel_all():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with one_thread():
            assert (torch.get_num_threads(), kernel_threads()) == (1, 2)
            with one_thread():
                assert kernel_threads() == 2
        with one_thread(kernel=True):
            assert (torch.get_num_threads(), kernel_threads()) == (1, 1)
        with one_thread(False):
            assert torch.get_num_threads() == 2
        assert (torch.get_num_threads(), kernel_threads()) == (2, 2)
    finally:
        torch.set_num_threads(before)
