"""What is estimated: point loads on the paper's rod, as files that every path and peer reads.

The files carry plain numbers, so that a process that measures one peer need import neither torch nor another peer.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import torch

from studies import peers
from studies.reproduction.cases import steel_rod
from torchrod import GaussianCoordinates, Markers, PointForces, Problem, Registration, Unknowns, solve_shape
from torchrod.mechanics.statics import grid_for
from torchrod.model.unknowns import TURN_SCALE

DISTINCT = 256  # different samples; larger batches repeat them
OFF = 0.1  # how far from the truth, in units of x, an iteration is timed
SEED = 7
FRAMES_A_CYCLE = 200


@dataclass(frozen=True)
class Case:
    """Loads to estimate, whether the registration is unknown too, markers, RK4 steps, and noise (m) on the markers."""

    loads: int = 1
    registration: bool = True
    markers: int = 20
    steps: int = 40
    noise: float = 1e-3

    @property
    def name(self) -> str:
        """For a file."""
        return f"{self.loads}_{int(self.registration)}_{self.markers}_{self.steps}"

    def unknowns(self) -> Unknowns:
        """torchrod's, with the width prior of a contact."""
        rod = steel_rod().rod
        loads = GaussianCoordinates(self.loads, rod.length, rod.force_scale)
        return Unknowns(loads, registration=Registration() if self.registration else None)

    def problem(self, positions: torch.Tensor) -> Problem:
        """torchrod's, of markers at these positions (B, P, 3) m."""
        return Problem(steel_rod(), self.unknowns(), [Markers(self.markers_at(), positions, self.noise)], steps=self.steps)

    def markers_at(self) -> torch.Tensor:
        """Evenly spaced to the tip, (P,) m."""
        length = steel_rod().rod.length
        return torch.linspace(length / self.markers, length, self.markers, dtype=torch.float64)


ITERATION = Case()  # 16 unknowns
STUDY = Case(registration=False)  # Study 1 of the paper, 10 unknowns


def as_peers(problem: Problem, case: Case) -> peers.Problem:
    """As the peers want it."""
    rod, grid = problem.robot.rod, grid_for(problem.robot, (), problem.s, case.steps)
    compliance = 1 / torch.cat([rod.K_se.diagonal(), rod.K_bt.diagonal()])
    return peers.Problem(
        loads=case.loads,
        registration=case.registration,
        length=rod.length,
        compliance=compliance.numpy(),
        nodes=grid.nodes.numpy(),
        keep=grid.outputs.numpy(),
        force_scale=rod.force_scale,
        moment_scale=rod.moment_scale,
        shift=TURN_SCALE * rod.length,
        turn=TURN_SCALE,
        prior_mean=problem.mean.numpy(),
        prior_precision=problem.precision.numpy(),
        noise=case.noise,
        tip_precision=problem.tip_weights.numpy(),
    )


def write(case: Case, folder: Path) -> Path:
    """The file of a case: the problem; near (B, n), states not far from the truth; start (B, n); positions (B, P, 3) m."""
    path = folder / f"{case.name}.npz"
    if path.is_file():
        return path
    generator = torch.Generator().manual_seed(SEED)
    size, angle, place = torch.rand(3, DISTINCT, case.loads, generator=generator, dtype=torch.float64)
    # Study 1: 0.5 to 1 N at 10 to 39 cm; several loads share that range, each in its own part of it.
    size, angle = 0.5 + 0.5 * size, 2 * math.pi * angle
    place = 0.1 + 0.29 * (torch.arange(case.loads) + place) / case.loads
    force = torch.stack([size * angle.cos(), size * angle.sin(), 0 * size], -1)
    robot = steel_rod()
    shape = solve_shape(robot, (PointForces(force, place),), None, case.markers_at(), DISTINCT, 160)
    problem = case.problem(shape.p)
    gamma = problem.unknowns.loads.start().reshape(-1, 4).repeat(DISTINCT, 1, 1)
    start = problem.state.join(gamma.flatten(1), torch.zeros(DISTINCT, 6, dtype=torch.float64))
    gamma[..., :2] = force[..., :2] / robot.rod.force_scale
    gamma[..., 2] = torch.logit(place / robot.rod.length)
    near = problem.state.join(gamma.flatten(1), shape.base_wrench)
    near = near + OFF * torch.randn(near.shape, generator=generator, dtype=torch.float64)
    seen = shape.p + case.noise * torch.randn(shape.p.shape, generator=generator, dtype=torch.float64)
    as_peers(problem, case).save(path, near=near.numpy(), start=start.numpy(), positions=seen.numpy())
    return path


def write_frames(count: int, folder: Path) -> Path:
    """The file of a film: Study 1's problem, and `count` frames of one push that moves and changes slowly."""
    path = folder / f"frames_{count}.npz"
    if path.is_file():
        return path
    generator = torch.Generator().manual_seed(SEED + 1)
    t = torch.arange(count, dtype=torch.float64) / FRAMES_A_CYCLE * 2 * math.pi
    place, size, angle = 0.25 + 0.1 * t.sin(), 0.75 + 0.2 * (1.7 * t).sin(), 0.3 * t
    force = torch.stack([size * angle.cos(), size * angle.sin(), 0 * size], -1)
    load = PointForces(force[:, None], place[:, None])
    p = solve_shape(steel_rod(), (load,), None, STUDY.markers_at(), count, 160).p
    p = p + STUDY.noise * torch.randn(p.shape, generator=generator, dtype=torch.float64)
    as_peers(STUDY.problem(p), STUDY).save(path, positions=p.numpy())
    return path
