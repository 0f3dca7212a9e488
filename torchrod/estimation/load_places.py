"""Where estimated loads act in space, and which way: the fitted rod at their locations."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..mechanics.integrate import march_linearized
from ..mechanics.lie import rotate
from ..mechanics.loads import PointForces
from ..mechanics.section import Section
from ..mechanics.statics import base_state, grid_for, stage_table
from ..model.problem import Problem
from ..model.unknowns import Unknowns
from ..util.precision import DTYPE
from ..util.threads import one_thread
from .result import Estimate

CHUNK = 512  # samples at a time


@dataclass(frozen=True)
class LoadPlaces:
    """Of up to K loads on B samples, in the robot's own base frame; NaN where there is no load.

    position: (B, K, 3) m, p(S), of the centre line at the load's location. force: (B, K, 3) N,
    R(S) [F_x, F_y, F_z], F_z = 0 unless it is unknown.
    """

    position: Float[Tensor, "B K 3"]
    force: Float[Tensor, "B K 3"]


def _sections(
    problem: Problem, x: Float[Tensor, "b n"], at: Float[Tensor, "b K"]
) -> tuple[Float[Tensor, "b K 3"], Float[Tensor, "b K 4"]]:
    """p (m) and q of the fitted rod at places (m) of each sample's own, which become nodes of its grid."""
    robot, state = problem.robot, problem.state
    loads = problem.unknowns.loads.loads(x[:, state.loads.at]) if state.loads.size else ()
    marks = PointForces(at.new_zeros(*at.shape, 3), at)
    grid = grid_for(robot, (*loads, marks), at.new_zeros(0), problem.steps)
    table = stage_table(robot, loads, problem.pulling(x), grid)
    section, y = Section.of(robot.rod.K_se, robot.rod.K_bt), base_state(robot, state.base.of(x), table)
    node = torch.searchsorted(grid.nodes.contiguous(), at.contiguous())
    states, _ = march_linearized(section, y, y.new_zeros(*y.shape, 0), table, None, grid, node)
    return states[..., :3], states[..., 3:7]


def load_places(problem: Problem, parts: Sequence[tuple[Unknowns, Int[Tensor, " b"]]], fit: Estimate) -> LoadPlaces:
    """Places and forces of all loads of a fit; parts: of the batch, each with the unknowns it was fitted by."""
    L, (B, K) = problem.robot.rod.length, fit.location.shape
    position, force = (torch.full((B, K, 3), torch.nan, dtype=DTYPE) for _ in range(2))
    for unknowns, index in parts:
        own = problem.of(unknowns)
        known = index[torch.isfinite(fit.x[index, : own.size]).all(-1)]
        for some in known.split(CHUNK) if len(known) and K and own.unknowns.loads.size else ():
            at = fit.location[some]
            there = torch.isfinite(at).unsqueeze(-1)
            with one_thread():
                p, q = _sections(own.take(some), fit.x[some, : own.size], at.nan_to_num(0.0).clamp(0, L))
            axial = torch.zeros_like(at) if fit.axial is None else fit.axial[some]
            pushed = torch.cat([fit.force[some], axial.unsqueeze(-1)], -1)
            position[some] = torch.where(there, p, torch.nan)
            force[some] = torch.where(there, rotate(q, pushed), torch.nan)
    return LoadPlaces(position, force)
