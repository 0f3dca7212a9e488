"""Problems that several tests pose."""

from typing import Any

import torch
from torch import Tensor

from tests.robots import steel_rod
from torchrod import GaussianCoordinates, Markers, Problem, Robot, Unknowns, forward_jacobian


def posed(
    s: Tensor,
    positions: Tensor,
    noise: float | Tensor = 1e-3,
    robot: Robot | None = None,
    loads: Any = None,
    tension: Tensor | None = None,
    offsets: Tensor | None = None,
    steps: int = 40,
    **unknown: Any,
) -> Problem:
    """Markers on the paper's rod under one contact, unless another robot or other loads are given; unknown: as in Unknowns."""
    robot = robot or steel_rod()
    loads = GaussianCoordinates(1, robot.rod.length, robot.rod.force_scale) if loads is None else loads
    return Problem(robot, Unknowns(loads, **unknown), [Markers(s, positions, noise, offsets)], tension, steps)


def unknowns_of(
    robot: Robot, count: int = 1, prior: str = "contact", locations: tuple[float, ...] | None = None, **rest
) -> Unknowns:
    """So many Gaussian loads on a robot; rest: as in Unknowns."""
    return Unknowns(GaussianCoordinates(count, robot.rod.length, robot.rod.force_scale, prior, locations), **rest)


def slopes(problem: Problem, x: Tensor, step: float = 1e-6, differentiable: bool = True) -> Tensor:
    """Central differences (B, m, n) of h (B, m) in every unknown: all of them in two calls, each a sample of its own."""
    batch, n = x.shape
    each = problem.take(torch.arange(batch).repeat_interleave(n))
    at, d = x.repeat_interleave(n, 0), step * torch.eye(n, dtype=x.dtype).repeat(batch, 1)
    both = [each.h(at + sign * d, differentiable) for sign in (1, -1)]
    return ((both[0] - both[1]) / (2 * step)).unflatten(0, (batch, n)).mT


def check_jacobian(problem: Problem) -> None:
    """H of a problem near its start, against torch.func through the whole of h and against central differences."""
    x = 0.3 * torch.randn(problem.batch, problem.size, generator=torch.Generator().manual_seed(0))
    h, H = problem.linearized(x)
    other, J = forward_jacobian(problem.h, x)
    assert torch.allclose(h, other, rtol=0, atol=1e-12)
    assert torch.allclose(H, J, rtol=1e-9, atol=1e-10)
    assert torch.allclose(slopes(problem, x), H, rtol=1e-6, atol=1e-6)
