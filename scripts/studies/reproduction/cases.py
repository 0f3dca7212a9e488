"""Study 1 of the paper: point loads of 0.5 to 1 N, 10 to 39 cm along a 0.4 m steel rod, 20 markers. And its Cramer-Rao bound."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrod import (
    Estimate,
    GaussianCoordinates,
    Markers,
    PointForces,
    Problem,
    Robot,
    Rod,
    Unknowns,
    estimate,
    load_bound,
    solve_shape,
)

L = 0.4
S = torch.linspace(0.02, L, 20, dtype=torch.float64)


def steel_rod() -> Robot:
    """The paper's rod: 1.4 mm spring steel."""
    return Robot(Rod.circular(L, 0.0014, 207e9, 79e9))


@dataclass(frozen=True)
class Study:
    """True loads and the shapes they make: force (B, 2) N, location (B,) m, positions (B, 20, 3) m, base wrench (B, 6)."""

    robot: Robot
    force: Tensor
    location: Tensor
    positions: Tensor
    base_wrench: Tensor

    def repeated(self, times: int) -> "Study":
        """The same cases over and over, for several draws of noise."""
        parts = (self.force, self.location, self.positions, self.base_wrench)
        return Study(self.robot, *(x.repeat(times, *[1] * (x.ndim - 1)) for x in parts))

    def noisy(self, noise: float, seed: int, told: float | None = None) -> Markers:
        """Markers with Gaussian noise (m) on every coordinate. told: what they state (m), where that is another."""
        draw = torch.randn(self.positions.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        return Markers(S, self.positions + noise * draw, noise if told is None else told)

    def problem(self, markers: Markers, prior: str = "contact") -> Problem:
        """The default unknowns with a width prior."""
        return Problem(self.robot, Unknowns(GaussianCoordinates(1, L, self.robot.rod.force_scale, prior)), [markers])

    def estimate(self, markers: Markers, prior: str) -> Estimate:
        """The default estimator with a width prior."""
        return estimate(self.problem(markers, prior))

    def bound(self, noise: float, width_known: bool) -> tuple[Tensor, Tensor]:
        """Cramer-Rao bounds (standard deviations) of location (m) and magnitude (N)."""
        markers = Markers(S, self.positions, noise)
        return load_bound(self.robot, markers, self.force, self.location, self.base_wrench, width_known=width_known)


def mean_error(bounds: list[float]) -> float:
    """Mean |error| of Gaussian errors with these standard deviations."""
    return math.sqrt(2 / math.pi) * sum(bounds) / len(bounds)


def study1(count: int, seed: int = 0) -> Study:
    """`count` random cases; their shapes with 160 steps and exact point loads, from tip to base."""
    generator = torch.Generator().manual_seed(seed)
    size, angle, place = torch.rand(3, count, generator=generator, dtype=torch.float64)
    size, angle, place = 0.5 + 0.5 * size, 2 * math.pi * angle, 0.1 + 0.29 * place
    force = torch.stack([size * angle.cos(), size * angle.sin(), 0 * size], -1)
    robot = steel_rod()
    shape = solve_shape(robot, (PointForces(force.unsqueeze(1), place.unsqueeze(1)),), None, S, count, 160)
    return Study(robot, force[:, :2], place, shape.p, shape.base_wrench)
