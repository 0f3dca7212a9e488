"""Study 1 of the paper as the tests want it: the study's own cases, with the problem that they pose."""

from dataclasses import dataclass

import torch
from studies.reproduction import cases
from torch import Tensor

from tests.problems import posed
from torchrod import Estimate, GaussianCoordinates, Problem, Robot, estimate


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
    """Pushes of 0.5 to 1 N at 10 to 39 cm of the steel rod, seen by 20 markers without noise."""
    study = cases.study1(count, seed)
    return Study(study.robot, cases.S, study.positions, study.force, study.location)
