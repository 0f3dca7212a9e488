"""Cases: markers with known loads, and the state that an oracle would start from.

The draws are held out: training has its own random loads, tendons, weights, marker layouts and noise. Its rod is the paper's, in
dimensionless features, so the nitinol and the silicone rod here are other rods, and the tendon robots other robots.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from studies.reproduction.study2 import Study2
from torchrod import GaussianCoordinates, Markers, PointForces, Problem, Robot, Unknowns, solve_shape
from torchrod.estimation.starts import in_equilibrium

MM = 1e-3
SEED = 41_000  # far from the seeds of training and of the studies
APART = 0.05  # m between two contacts
STEPS = 160  # of the simulated shapes: finer than the estimator's model
NEAREST_TIP = 0.999  # of the length: eta of a load at the very tip is infinite


@dataclass(frozen=True)
class Part:
    """B samples of one problem: what was measured, true loads, and the oracle's start.

    force (B, K, 2) N and location (B, K) m, by location; or the smooth loads of Study 2. oracle (B, n): x at the true loads.
    """

    problem: Problem
    truth: "tuple[Tensor, Tensor] | Study2"
    oracle: Tensor


@dataclass(frozen=True)
class Case:
    """A row of the ablation. draws: how many samples in a row share a load; intervals resample the loads.

    bar: the largest warm / cold ratio of mean iterations asked for, or None. in_distribution: whether loads, rod and markers lie
    within what the checkpoints were trained for.
    """

    name: str
    title: str
    parts: tuple[Part, ...]
    bar: float | None
    in_distribution: bool
    draws: int = 1


def rand(seed: int) -> Callable[..., Tensor]:
    """Uniform draws in (0, 1) from a seed of their own."""
    generator = torch.Generator().manual_seed(seed)
    return lambda *size: torch.rand(*size, generator=generator, dtype=torch.float64)


def between(low: float, high: float) -> Callable[[Tensor], Tensor]:
    """Uniform."""
    return lambda u: low + (high - low) * u


def log_between(low: float, high: float) -> Callable[[Tensor], Tensor]:
    """Log-uniform."""
    return lambda u: low * (high / low) ** u


@dataclass(frozen=True)
class Draw:
    """How point loads are drawn: magnitude (N) and place (m) from uniform numbers, markers along the rod, noise (m), the largest
    tension (N), and how many markers are lost.
    """

    magnitude: Callable[[Tensor], Tensor]
    place: Callable[[Tensor], Tensor]
    noise: float = MM
    contacts: int = 1
    markers: int = 20
    tension: float = 0.0
    missing: int = 0


def with_noise(positions: Tensor, noise: float, missing: int, seed: int) -> Tensor:
    """Gaussian noise (m) on every coordinate, and `missing` markers of every sample lost at random."""
    generator = torch.Generator().manual_seed(seed)
    noisy = positions + noise * torch.randn(positions.shape, generator=generator, dtype=torch.float64)
    lost = torch.rand(positions.shape[:2], generator=generator).argsort(-1).argsort(-1) < missing
    return noisy.masked_fill(lost.unsqueeze(-1), torch.nan)


def contact_part(robot: Robot, markers: Markers, force: Tensor, location: Tensor, tension: Tensor | None = None) -> Part:
    """A part whose truth is point loads; its oracle knows them, and takes the prior's width. Contacts are of about L / 40."""
    loads = GaussianCoordinates(location.shape[1], robot.rod.length, robot.rod.force_scale)
    problem = Problem(robot, Unknowns(loads), [markers], tension)
    eta = torch.logit((location / robot.rod.length).clamp(max=NEAREST_TIP))
    gamma = loads.start().unflatten(0, (*location.shape[1:], 4)).expand(*location.shape, 4).clone()
    gamma[..., :2], gamma[..., 2] = force / robot.rod.force_scale, eta
    return Part(problem, (force, location), in_equilibrium(problem, gamma.flatten(1)))


def drawn(robot: Robot, draw: Draw, count: int, seed: int) -> Part:
    """`count` random samples; shapes that have no solution are left out."""
    u, K = rand(seed), draw.contacts
    place = draw.place(u(20 * count, K)).sort(-1).values
    place = place[(place.diff(dim=-1) >= APART).all(-1)][:count]
    size, angle = draw.magnitude(u(count, K)), 2 * math.pi * u(count, K)
    force = torch.stack([size * angle.cos(), size * angle.sin(), 0 * size], -1)
    s = robot.rod.length * torch.arange(1, draw.markers + 1, dtype=torch.float64) / draw.markers
    tension = draw.tension * u(count, len(robot.tendons)) if len(robot.tendons) else None
    shape = solve_shape(robot, (PointForces(force, place),), tension, s, count, STEPS)
    solved = (shape.status == 0).nonzero().squeeze(-1)
    markers = Markers(s, with_noise(shape.p, draw.noise, draw.missing, seed + 1), draw.noise).take(solved)
    return contact_part(robot, markers, force[solved, :, :2], place[solved], None if tension is None else tension[solved])
