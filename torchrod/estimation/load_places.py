"""Where estimated loads act in space, and which way: the fitted rod at their locations."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..mechanics.lie import normalized, rotate
from ..model.problem import Problem
from ..model.sensors import Markers
from ..model.unknowns import Unknowns
from ..util.precision import DTYPE
from .result import Estimate

NODES = 101  # along the rod: cubics between them are within 1e-6 of the length and 1e-4 rad of it
CHUNK = 256  # samples at a time


@dataclass(frozen=True)
class LoadPlaces:
    """Of up to K loads on B samples, in the robot's own base frame; NaN where there is no load.

    position: (B, K, 3) m, p(S), of the centre line at the load's location. force: (B, K, 3) N,
    R(S) [F_x, F_y, F_z], F_z = 0 unless it is unknown.
    """

    position: Float[Tensor, "B K 3"]
    force: Float[Tensor, "B K 3"]


def _cubic(nodes: Float[Tensor, "b N k"], at: Float[Tensor, "b K"]) -> Float[Tensor, "b K k"]:
    """Values at `at` (in nodes, from 0) of the cubic through the four nearest nodes."""
    first = (at.floor().long() - 1).clamp(0, nodes.shape[1] - 4)
    t = (at - first).unsqueeze(-1)
    near = [nodes.gather(1, (first + i).unsqueeze(-1).expand(-1, -1, nodes.shape[-1])) for i in range(4)]
    w = [(t - 1) * (t - 2) * (t - 3) / -6, t * (t - 2) * (t - 3) / 2, t * (t - 1) * (t - 3) / -2, t * (t - 1) * (t - 2) / 6]
    return sum((a * b for a, b in zip(w[1:], near[1:], strict=True)), w[0] * near[0])


def load_places(problem: Problem, parts: Sequence[tuple[Unknowns, Int[Tensor, " b"]]], fit: Estimate) -> LoadPlaces:
    """Places and forces of all loads of a fit; parts: of the batch, each with the unknowns it was fitted by."""
    L, (B, K) = problem.robot.rod.length, fit.location.shape
    s = torch.linspace(0.0, L, NODES, dtype=DTYPE)
    position, force = (torch.full((B, K, 3), torch.nan, dtype=DTYPE) for _ in range(2))
    for unknowns, index in parts:
        own = problem.of(unknowns)
        known = index[torch.isfinite(fit.x[index, : own.size]).all(-1)]
        for some in known.split(CHUNK) if len(known) and K and own.unknowns.loads.size else ():
            unseen = Markers(s, torch.full((len(some), NODES, 3), torch.nan, dtype=DTYPE), 1.0)
            shape = replace(own.take(some), sensors=[unseen]).shape(fit.x[some, : own.size], False)
            at = fit.location[some].clamp(0, L) / L * (NODES - 1)
            there = torch.isfinite(at)
            at = at.nan_to_num(0.0)
            q = normalized(_cubic(shape.q, at))
            axial = torch.zeros_like(fit.location[some]) if fit.axial is None else fit.axial[some]
            pushed = torch.cat([fit.force[some], axial.unsqueeze(-1)], -1)
            position[some] = torch.where(there.unsqueeze(-1), _cubic(shape.p, at), torch.nan)
            force[some] = torch.where(there.unsqueeze(-1), rotate(q, pushed), torch.nan)
    return LoadPlaces(position, force)
