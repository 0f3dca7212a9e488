"""The force-torque sensor under the robot, beside markers and alone."""

import pytest
import torch

from tests.problems import check_jacobian
from tests.robots import T, busy_robot, steel_rod
from torchrod import (
    BaseWrench,
    GaussianCoordinates,
    Markers,
    PointForces,
    Problem,
    Unknowns,
    estimate,
    solve_shape,
)

S = torch.linspace(0.02, 0.4, 20, dtype=torch.float64)
TURN = torch.nn.functional.normalize(T([0.1, -0.2, 0.3, 1.0], dtype=torch.float64), dim=-1)


def contact(robot) -> Unknowns:
    return Unknowns(GaussianCoordinates(1, robot.rod.length, robot.rod.force_scale, "point"))


def pushed(count: int = 1):
    generator = torch.Generator().manual_seed(2)
    size, angle, place = torch.rand(3, count, generator=generator)
    size, angle, place = 0.5 + 0.5 * size, 2 * torch.pi * angle, 0.1 + 0.29 * place
    force = torch.stack([size * angle.cos(), size * angle.sin(), 0 * size], -1).unsqueeze(1)
    return size, place, solve_shape(steel_rod(), (PointForces(force, place.unsqueeze(1)),), None, S, count, 80)


def test_the_jacobian_is_that_of_h_and_of_differences():
    robot = busy_robot()
    sensors = [Markers(S, torch.zeros(2, 20, 3), 1e-3), BaseWrench(torch.zeros(2, 6), 0.01, 1e-3, TURN)]
    problem = Problem(robot, contact(robot), sensors, T([[3.0, 2.0], [1.0, 2.0]]), 10)
    check_jacobian(problem)


def test_it_reads_what_the_rod_puts_on_its_base():
    """In the sensor's own axes, the forward solve's base wrench; whatever frame the cameras measure in."""
    _, _, shape = pushed(2)
    read = BaseWrench(torch.zeros(2, 6), 0.01, 1e-3, TURN)
    problem = Problem(steel_rod(), contact(steel_rod()), [read])
    x = problem.state.join(torch.zeros(2, 4), shape.base_wrench)
    import roma

    R = roma.unitquat_to_rotmat(TURN)
    wanted = torch.cat([shape.base_wrench[:, :3] @ R, shape.base_wrench[:, 3:] @ R], -1)
    assert torch.allclose(problem.h(x)[:, :6], wanted, atol=1e-12)
    assert read.moved(R, T([1.0, 2.0, 3.0])) is read


def test_it_tells_a_push_that_markers_hardly_see():
    """A push near the base, 1 mm noise: the standard deviation of its force falls to a fifth or less with a 5 mN, 1 mN m sensor."""
    push = PointForces(T([[[0.5, 0.0, 0.0]]]), T([[0.06]]))
    shape = solve_shape(steel_rod(), (push,), None, S, 1, 80)
    markers = Markers(S, shape.p, 1e-3)
    wrench = BaseWrench(shape.base_wrench, 5e-3, 1e-3)
    alone, both = (estimate(Problem(steel_rod(), contact(steel_rod()), sensors)) for sensors in ([markers], [markers, wrench]))
    assert both.accepted[0]
    assert both.magnitude_std[0, 0] < 0.2 * alone.magnitude_std[0, 0]
    assert abs(float(both.magnitude[0, 0]) - 0.5) < 3 * float(both.magnitude_std[0, 0])


def test_the_intervals_hold_the_truth():
    """Markers with 1 mm noise and a sensor with 20 mN, 2 mN m, 300 cases: 95 % intervals of force and location."""
    size, place, shape = pushed(300)
    generator = torch.Generator().manual_seed(7)
    scale = T([0.02] * 3 + [0.002] * 3)
    read = shape.base_wrench + scale * torch.randn(300, 6, generator=generator)
    p = shape.p + 1e-3 * torch.randn(shape.p.shape, generator=generator)
    fit = estimate(Problem(steel_rod(), contact(steel_rod()), [Markers(S, p, 1e-3), BaseWrench(read, 0.02, 0.002)]))
    assert fit.accepted.double().mean() > 0.98
    for truth, interval in ((size, fit.magnitude_interval[:, 0]), (place, fit.location_interval[:, 0])):
        share = ((truth > interval[:, 0]) & (truth < interval[:, 1])).double().mean()
        assert 0.92 < share < 0.98, share


def test_forces_and_moments_weigh_by_their_own_noise():
    """Noises of two sizes and units, one of them for each sample: exchanged, or one taken for both, the weights are others."""
    sensor = BaseWrench(torch.zeros(2, 6), 0.1, T([0.01, 0.02]))
    assert torch.allclose(sensor.weights[:, :3], torch.full((2, 3), 100.0))
    assert torch.allclose(sensor.weights[:, 3:], T([[1e4] * 3, [2.5e3] * 3]))


def test_a_missing_reading_weighs_nothing():
    _, _, shape = pushed()
    markers = Markers(S, shape.p, 1e-3)
    missing = BaseWrench(torch.full((1, 6), torch.nan), 0.01, 1e-3)
    both, alone = (Problem(steel_rod(), contact(steel_rod()), sensors) for sensors in ([markers, missing], [markers]))
    assert int(both.seen[0]) == int(alone.seen[0]) == 60
    assert torch.allclose(estimate(both).x, estimate(alone).x, rtol=1e-6, atol=1e-7)


def test_samples_and_noises_must_belong_together():
    _, _, shape = pushed()
    markers = Markers(S, shape.p, 1e-3)
    with pytest.raises(ValueError, match="different numbers of samples"):
        Problem(steel_rod(), contact(steel_rod()), [markers, BaseWrench(torch.zeros(2, 6), 0.01, 1e-3)]).check()
    with pytest.raises(ValueError, match=r"BaseWrench\.moment_noise is 0 N m"):
        Problem(steel_rod(), contact(steel_rod()), [markers, BaseWrench(torch.zeros(1, 6), 0.01, 0.0)]).check()
    with pytest.raises(ValueError, match=r"BaseWrench\.readings has shape"):
        Problem(steel_rod(), contact(steel_rod()), [markers, BaseWrench(torch.zeros(1, 3), 0.01, 0.01)]).check()
