"""Walk the arc-length step along the rod, and carry tangents with it.

`march` is the definition, in torch, for any transform. `march_linearized` returns the states at chosen nodes together with their
derivatives along given tangents: by the compiled kernel where it serves (torchrod.fast), else by torch.func on `march`. Both
differentiate the discrete steps, so they agree to round-off.
"""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from . import fast
from .grid import Grid
from .jacobian import forward_jacobian
from .step import Section, StageTable, State, rk4_step


def march(section: Section, y: State, table: StageTable, grid: Grid, reverse: bool = False) -> Float[Tensor, "... S1 13"]:
    """The state at every node, in the order of the nodes; `reverse` starts from the last node."""
    h, states = grid.h, [y]
    steps = range(h.shape[-1])
    table = table.reversed() if reverse else table
    for i in reversed(steps) if reverse else steps:
        y = rk4_step(section, y, table.step(i), -h[..., i] if reverse else h[..., i])
        states.append(y)
    return torch.stack(states[::-1] if reverse else states, -2)


def states_at(states: Float[Tensor, "... S1 c"], at: Int[Tensor, "... P"]) -> Float[Tensor, "... P c"]:
    """The states at given nodes, which may differ from sample to sample."""
    if at.ndim == 1:
        return states[..., at, :]
    return states.gather(-2, at.unsqueeze(-1).expand(*states.shape[:-2], at.shape[-1], states.shape[-1]))


def compiled(section: Section, y: State) -> bool:
    """Whether the kernel serves this march: one section for the whole batch, float64 on the CPU, and a compiler."""
    plain = section.K_se.ndim == 2 and section.K_bt.ndim == 2
    return plain and y.dtype == torch.float64 and y.device.type == "cpu" and fast.available()


def march_linearized(
    section: Section,
    y0: Float[Tensor, "B 13"],
    dy0: Float[Tensor, "B 13 n"],
    table: StageTable,
    dlocal: Float[Tensor, "B S 3 6 g"] | None,
    grid: Grid,
    keep: Int[Tensor, "*B P"],
    reverse: bool = False,
) -> tuple[Float[Tensor, "B P 13"], Float[Tensor, "B P 13 n"]]:
    """States at the nodes `keep` and their derivatives along n tangents.

    The nodes stay where they are. Tangent k moves the first state by dy0[..., k] and, where k < g, the local load integrals
    [G, G2] by dlocal[..., k].
    """
    if compiled(section, y0):
        return fast.march_linearized(section, y0, dy0, table, dlocal, grid, keep, reverse)
    if dy0.shape[-1] == 0:
        states = states_at(march(section, y0, table, grid, reverse), keep)
        return states, states.new_zeros(*states.shape, 0)

    def moved(e: Float[Tensor, "B n"]) -> Float[Tensor, "B P13"]:
        here = table
        if dlocal is not None and table.loads.G is not None and table.loads.G2 is not None:
            d = (dlocal * e[:, None, None, None, : dlocal.shape[-1]]).sum(-1)
            here = replace(table, loads=replace(table.loads, G=table.loads.G + d[..., :3], G2=table.loads.G2 + d[..., 3:]))
        states = march(section, y0 + (dy0 * e.unsqueeze(-2)).sum(-1), here, grid, reverse)
        return states_at(states, keep).flatten(-2)

    value, tangents = forward_jacobian(moved, torch.zeros(len(y0), dy0.shape[-1], dtype=y0.dtype))
    return value.unflatten(-1, (-1, 13)), tangents.unflatten(-2, (-1, 13))
