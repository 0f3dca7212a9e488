"""Digital twins of the paper's two tendon robots: displaced tendons, a push, eight noisy markers, a model a little wrong."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrod import (
    Estimate,
    GaussianCoordinates,
    Markers,
    Model,
    PointForces,
    Robot,
    Rod,
    Settings,
    Tendon,
    Tendons,
    estimate,
    load_bound,
    solve_displacement,
)

NOISE = 0.25e-3  # m
MARKERS = 8
MISMATCH = 0.03  # one standard deviation of stiffness, mass and tension, relative
GRAVITY = (9.81, 0.0, 0.0)  # m/s^2: the robots lie across it


def _robot(length: float, diameter: float, mass: float, tendons: tuple[Tendon, ...]) -> Robot:
    rod = Rod.circular(length, diameter, 207e9, 79e9, mass)
    return Robot(rod, Tendons(tendons), torch.tensor(GRAVITY, dtype=torch.float64))


def one_tendon() -> Robot:
    """0.4 m, 1.4 mm steel, a tendon at 7 mm to the tip, 0.144 kg/m."""
    return _robot(0.4, 1.4e-3, 0.144, (Tendon.straight(7e-3, 0.0, 0.4),))


def two_tendons() -> Robot:
    """0.56 m, 2 mm steel, tendons at 25 mm: along x to the tip and along y to the middle, 0.252 kg/m."""
    return _robot(0.56, 2e-3, 0.252, (Tendon.straight(25e-3, 0.0, 0.56), Tendon.straight(0.0, 25e-3, 0.28)))


@dataclass(frozen=True)
class Twin:
    """What was done to a robot and seen of it: displacement (B, T) m, force (B, 2) N, location (B,) m, true tension (B, T) N,
    true positions (B, 8, 3) m, base wrench (B, 6), and what the estimator is told: noisy markers with its readings of tension.
    """

    robot: Robot
    force: Tensor
    location: Tensor
    tension: Tensor
    base_wrench: Tensor
    positions: Tensor
    told: Markers

    def estimate(self) -> Estimate:
        """One contact, gravity and tensions known, registration perfect.

        Many fits of a wrong model are not accepted; starting them again from other magnitudes would not make the model right.
        """
        rod = self.robot.rod
        model = Model(self.robot, GaussianCoordinates(1, rod.length, rod.force_scale, "contact"))
        return estimate(model, self.told, NOISE, Settings(restarts=()))

    def bound(self) -> tuple[Tensor, Tensor]:
        """Cramer-Rao bounds of location (m) and magnitude (N) for marker noise alone, width known."""
        markers = Markers(self.told.s, self.positions, None, self.tension)
        return load_bound(self.robot, markers, self.force, self.location, self.base_wrench, NOISE)


def twin(robot: Robot, displacement: Tensor, force: Tensor, location: Tensor, mismatch: float, draws: int, seed: int) -> Twin:
    """Every row of displacement (R, T) m, force (R, 2) N and location (R,) m, `draws` times over.

    The true robot is k times as stiff as the model and m times as heavy, and a tension is read with a relative error. A rod k times
    as stiff has the same shape under k times the loads, so the model's own rod is solved under the loads divided by k.
    """
    generator = torch.Generator().manual_seed(seed)
    d, f, at = (x.repeat_interleave(draws, 0) for x in (displacement, force, location))
    B = len(d)
    wrong = 1 + mismatch * torch.randn(B, 2 + d.shape[-1], generator=generator, dtype=torch.float64).clamp(-3, 3)
    k, m, read = wrong[:, :1], wrong[:, 1:2], wrong[:, 2:]
    real = Robot(robot.rod, robot.tendons, robot.gravity * m / k)
    push = PointForces(torch.nn.functional.pad(f / k, (0, 1)).unsqueeze(1), at.unsqueeze(1))
    s = robot.rod.length * torch.arange(1, MARKERS + 1, dtype=torch.float64) / MARKERS
    answer = solve_displacement(real, (push,), d, s)
    tension = k * answer.tension
    p = answer.equilibrium.p
    noisy = p + NOISE * torch.randn(p.shape, generator=generator, dtype=torch.float64)
    told = Markers(s, noisy, None, tension * read)
    return Twin(robot, f, at, tension, k * answer.equilibrium.base_wrench, p, told)


def push(force: Tensor, angle: Tensor) -> Tensor:
    """Force components (N) in the section frame from a magnitude and a direction (rad)."""
    return torch.stack([force * angle.cos(), force * angle.sin()], -1)
