"""Problems that several tests pose."""

from typing import Any

from torch import Tensor

from tests.robots import steel_rod
from torchrod import GaussianCoordinates, Markers, Problem, Robot, Unknowns


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
