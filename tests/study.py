"""Study 1 of the paper: 100 point loads of 0.5 to 1 N, 10 to 39 cm along the rod, 20 markers."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from tests.problems import posed
from tests.robots import steel_rod
from torchrod import Estimate, GaussianCoordinates, PointForces, Problem, Robot, estimate, solve_shape


@dataclass(frozen=True)
class Study:
    robot: Robot
    s: Tensor
    positions: Tensor
    force: Tensor
    location: Tensor

    def problem(self, noise: float, prior: str, sigma: float, seed: int = 1) -> Problem:
        """With that much noise added, and sigma told."""
        generator = torch.Generator().manual_seed(seed)
        positions = self.positions + noise * torch.randn(self.positions.shape, generator=generator)
        loads = GaussianCoordinates(1, 0.4, self.robot.rod.force_scale, prior)
        return posed(self.s, positions, sigma, self.robot, loads)

    def estimate(self, noise: float, prior: str, sigma: float, seed: int = 1) -> Estimate:
        """The fit to it."""
        return estimate(self.problem(noise, prior, sigma, seed))


def study1(count: int = 100, seed: int = 0) -> Study:
    generator = torch.Generator().manual_seed(seed)
    size, angle, place = torch.rand(3, count, generator=generator)
    size, angle, place = 0.5 + 0.5 * size, 2 * math.pi * angle, 0.1 + 0.29 * place
    force = torch.stack([size * angle.cos(), size * angle.sin(), 0 * size], -1)
    robot, s = steel_rod(), torch.linspace(0.02, 0.4, 20)
    shape = solve_shape(robot, (PointForces(force.unsqueeze(1), place.unsqueeze(1)),), None, s, count, 160)
    return Study(robot, s, shape.p, force[:, :2], place)
