"""Random pushes on the steel rod of Study 1, and what can be wrong with their markers."""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import TypeVar

import roma
import torch
from torch import Tensor
from tqdm import tqdm

from studies.reproduction.cases import L, steel_rod
from torchrod import GaussianCoordinates, Markers, PointForces, Problem, Registration, Unknowns, solve_shape

T = TypeVar("T")
NOISE, SHIFT, TURN = 1e-3, 5e-3, math.radians(3)
GAP = 0.08
ROBOT = steel_rod()


def in_parallel(function: Callable[..., T], rows: Sequence[object], samples: int, seed: int, what: str) -> list[T]:
    """function(row, samples, seed + i) of every row, on two processes of one thread each."""
    with ProcessPoolExecutor(2, get_context("spawn"), torch.set_num_threads, (1,)) as pool:
        jobs = [pool.submit(function, row, samples, seed + i) for i, row in enumerate(rows)]
        return [job.result() for job in tqdm(jobs, desc=what, leave=False)]


def generator(seed: int) -> torch.Generator:
    """Random numbers of a row of a table."""
    return torch.Generator().manual_seed(seed)


def pushed(count: int, prior: str = "contact", registration: Registration | None = None) -> Unknowns:
    """The default unknowns of so many pushes."""
    return Unknowns(GaussianCoordinates(count, L, ROBOT.rod.force_scale, prior), registration=registration)


def posed(markers: Markers, unknowns: Unknowns) -> Problem:
    """Of markers on the rod."""
    return Problem(ROBOT, unknowns, [markers])


def pushes(count: int, samples: int, g: torch.Generator, size: tuple[float, float] = (0.5, 1.0)) -> tuple[Tensor, Tensor]:
    """Forces (B, K, 2) N and places (B, K) m, 100 to 390 mm, sorted, at least GAP apart."""
    place = (0.1 + 0.29 * torch.rand(20 * samples, count, generator=g, dtype=torch.float64)).sort(-1).values
    place = place[(place.diff(dim=-1) >= GAP).all(-1)][:samples]
    how, angle = torch.rand(2, samples, count, generator=g, dtype=torch.float64)
    how, angle = size[0] + (size[1] - size[0]) * how, 2 * math.pi * angle
    return torch.stack([how * angle.cos(), how * angle.sin()], -1), place


def noisy(s: Tensor, positions: Tensor, g: torch.Generator) -> Markers:
    """1 mm on every coordinate."""
    return Markers(s, positions + NOISE * torch.randn(positions.shape, generator=g, dtype=torch.float64), NOISE)


@dataclass(frozen=True)
class Touched:
    """Point forces (B, K, 2) N at (B, K) m; the markers' places (P,) m and true positions (B, P, 3) m; the base wrench (B, 6)."""

    force: Tensor
    place: Tensor
    s: Tensor
    positions: Tensor
    base_wrench: Tensor

    def markers(self, errors: Tensor, noise: float) -> Markers:
        """With these errors (B, P, 3) m, of which they state this noise (m)."""
        return Markers(self.s, self.positions + errors, noise)


def touched(count: int, samples: int, g: torch.Generator, markers: int = 20, size: tuple[float, float] = (0.5, 1.0)) -> Touched:
    """Shapes under random point forces."""
    s = torch.linspace(L / markers, L, markers, dtype=torch.float64)
    force, place = pushes(count, samples, g, size)
    loads = (PointForces(torch.nn.functional.pad(force, (0, 1)), place),) if count else ()
    shape = solve_shape(ROBOT, loads, None, s, samples, 80)
    return Touched(force, place, s, shape.p, shape.base_wrench)


def moved(positions: Tensor, g: torch.Generator, shared: int = 1) -> Tensor:
    """From base frames that are off by 5 mm and 3 degrees in random directions, each shared by so many samples."""
    B = len(positions)
    shift, turn = torch.randn(2, -(-B // shared), 3, generator=g, dtype=torch.float64)
    shift, turn = (size * v / v.norm(dim=-1, keepdim=True) for v, size in ((shift, SHIFT), (turn, TURN)))
    shift, turn = (v.repeat_interleave(shared, 0)[:B] for v in (shift, turn))
    return torch.einsum("bij,bpj->bpi", roma.rotvec_to_rotmat(turn), positions) + shift.unsqueeze(1)


def exchanged(positions: Tensor, pairs: int, g: torch.Generator) -> tuple[Tensor, list[tuple[tuple[int, int], ...]]]:
    """So many pairs of labels exchanged in every sample: neighbours in every other one, any two in the rest."""
    positions, found = positions.clone(), []
    P = positions.shape[1]
    for b in range(len(positions)):
        order = torch.randperm(P, generator=g).tolist()
        own = [tuple(sorted(order[2 * k : 2 * k + 2])) for k in range(pairs)]
        if b % 2 == 0:
            i = int(torch.randint(P - 1, (1,), generator=g))
            rest = [k for k in order if k not in (i, i + 1)]
            own = [(i, i + 1)] + [tuple(sorted(rest[2 * k : 2 * k + 2])) for k in range(pairs - 1)]
        for i, j in own:
            positions[b, [i, j]] = positions[b, [j, i]]
        found.append(tuple(sorted(own)))
    return positions, found
