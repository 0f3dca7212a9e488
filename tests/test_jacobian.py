"""H = dh/dx by forward mode against central differences, gravity, helical tendons, registration and offsets included."""

import roma
import torch

from tests.problems import posed, slopes
from tests.robots import T, busy_robot
from torchrod import GaussianCoordinates, PointCoordinates, Problem, Registration, forward_jacobian
from torchrod.estimation.result import load_covariance
from torchrod.mechanics.jacobian import moved_along, pointwise_jacobian
from torchrod.mechanics.lie import exponential, logarithm, product


def check(problem: Problem, x: torch.Tensor) -> None:
    _, J = forward_jacobian(problem.h, x)
    assert torch.isfinite(J).all()
    assert (J - slopes(problem, x)).abs().max() < 1e-6 * J.abs().max()


def test_h_has_exact_derivatives():
    robot = busy_robot()
    s, tension, offsets = T([0.1, 0.23, 0.4]), T([[3.0, 2.0], [1.0, 4.0]]), 0.01 * torch.eye(3)
    torch.manual_seed(0)
    for loads in (GaussianCoordinates(1, 0.4, robot.rod.force_scale), PointCoordinates(1, 0.4, robot.rod.force_scale)):
        problem = posed(s, torch.zeros(2, 3, 3), 1e-3, robot, loads, tension, offsets, 4, registration=Registration())
        start = problem.state.join(loads.start().expand(2, -1), torch.zeros(2, 6))
        check(problem, start + 0.3 * torch.randn(2, problem.size))


def test_derivatives_are_exact_at_zero_load_zero_strain_and_zero_rotation():
    robot = busy_robot()
    loads = GaussianCoordinates(2, 0.4, robot.rod.force_scale)
    s, tension, offsets = T([0.1, 0.4]), T([[0.0, 0.0]]), torch.zeros(2, 3)
    problem = posed(s, torch.zeros(1, 2, 3), 1e-3, robot, loads, tension, offsets, 4, registration=Registration())
    check(problem, problem.state.join(loads.start().unsqueeze(0), torch.zeros(1, 6)))


def test_rotation_vectors_are_romas_and_smooth_at_zero():
    w = torch.cat([torch.randn(20, 3), 1e-3 * torch.randn(20, 3), 1e-9 * torch.randn(5, 3), torch.zeros(1, 3)])
    q = exponential(w)
    assert torch.allclose(q, roma.rotvec_to_unitquat(w), atol=1e-14)
    assert torch.allclose(logarithm(q), roma.unitquat_to_rotvec(roma.rotvec_to_unitquat(w)), atol=1e-13)
    assert torch.allclose(product(q[:20], q[20:40]), roma.quat_product(q[:20], q[20:40]), atol=1e-14)
    _, J = pointwise_jacobian(lambda w: logarithm(exponential(w)), w[20:])
    assert torch.allclose(J, torch.eye(3).expand_as(J), atol=1e-12)


def test_the_covariance_of_a_gaussians_report_goes_by_its_derivative():
    torch.manual_seed(0)
    for locations in (None, (0.1, 0.3)):
        c = GaussianCoordinates(2, 0.4, 1.3, "contact", locations)
        gamma = c.start() + 0.4 * torch.randn(5, c.size)

        def described(gamma: torch.Tensor) -> torch.Tensor:
            report = c.describe(gamma)  # noqa: B023 - called within its turn of the loop
            return torch.cat([report.force, report.location.unsqueeze(-1), report.width.unsqueeze(-1)], -1).flatten(-2)

        _, whole = pointwise_jacobian(described, gamma)
        root = torch.randn(5, c.size, c.size)
        own = root @ root.mT
        found = load_covariance(c, gamma, own)
        J = whole.unflatten(1, (2, 4))
        assert torch.allclose(found, J @ own.unsqueeze(1) @ J.mT, rtol=1e-12, atol=1e-14)


def test_what_moves_along_tangents():
    """Of several tensors at once, as torch.func.jvp has it; of what nothing moves, and along no tangent, nothing."""
    torch.manual_seed(2)
    a, b = torch.randn(4, 3), torch.randn(4, 2)
    da, db = torch.randn(5, 4, 3), torch.randn(5, 4, 2)

    def f(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return torch.cat([torch.where(a > 0, a.sin(), a * b[:, :1]), (b * b).sum(-1, keepdim=True)], -1)

    value, moves = moved_along(f, (a, b), (da, db))
    expected = torch.stack([torch.func.jvp(f, (a, b), (x, y))[1] for x, y in zip(da, db, strict=True)], -1)
    assert torch.equal(value, f(a, b)) and not value.requires_grad
    assert torch.allclose(moves, expected, atol=1e-14)
    assert moved_along(f, (a, b), (da[:0], db[:0]))[1].shape == (4, 4, 0)
    assert (moved_along(lambda a, b: torch.ones(4, 6), (a, b), (da, db))[1] == torch.zeros(4, 6, 5)).all()
