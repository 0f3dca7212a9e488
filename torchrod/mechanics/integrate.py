"""Walk the arc-length step along the rod, and carry tangents with it.

`march` is the definition, in torch, for any transform. `march_linearized` returns the states at chosen nodes together with their
derivatives along given tangents: by the compiled kernel where it serves (torchrod.kernel), else by torch.func. Both differentiate
the discrete steps, so they agree to round-off.
"""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.func import jvp, vmap

from .. import kernel
from .grid import Grid
from .lie import Vector
from .section import MATRICES, STATE, Section, StageTable, State, rk4_step


def march(section: Section, y: State, table: StageTable, grid: Grid, reverse: bool = False) -> Float[Tensor, "... S1 state"]:
    """The state at every node, in the order of the nodes; `reverse` starts from the last node.

    Where tendons rub, y may have Theta of every one behind it, as the answer then has; else they have not turned so far.
    """
    width, y = y.shape[-1], with_theta(y, table)
    h, states = grid.h, [y]
    steps = range(h.shape[-1])
    table = table.reversed() if reverse else table
    for i in reversed(steps) if reverse else steps:
        y = rk4_step(section, y, table.step(i), -h[..., i] if reverse else h[..., i])
        states.append(y)
    return torch.stack(states[::-1] if reverse else states, -2)[..., :width]


def with_theta(y: Float[Tensor, "... c"], table: StageTable) -> Float[Tensor, "... d"]:
    """y with zeros for what the tendons have turned, where they rub and it says nothing of it."""
    rubbing = 0 if table.tendons is None or table.tendons.friction is None else table.tendons.tau.shape[-1]
    return torch.nn.functional.pad(y, (0, STATE + rubbing - y.shape[-1]))


def states_at(states: Float[Tensor, "... S1 c"], at: Int[Tensor, "... P"]) -> Float[Tensor, "... P c"]:
    """The states at given nodes, which may differ from sample to sample."""
    if at.ndim == 1:
        return states[..., at, :]
    return states.gather(-2, at.unsqueeze(-1).expand(*states.shape[:-2], at.shape[-1], states.shape[-1]))


def compiled(section: Section, y: State) -> bool:
    """Whether the kernel serves this march: one rod for the whole batch, float64 on the CPU, and a compiler."""
    plain = section.K_se.ndim == 2 and section.K_bt.ndim == 2
    return plain and y.dtype == torch.float64 and y.device.type == "cpu" and kernel.available()


def known(
    section: Section, table: StageTable, grid: Grid, keep: Int[Tensor, "*B P"]
) -> tuple[dict[str, Tensor | None], dict[str, int]]:
    """What the kernel is handed of a robot on a grid: struct Known by name. A table keeps its row per sample where it has one."""
    t, loads, of = table.tendons, table.loads, table.section or section
    diagonal = all(bool((K - torch.diag_embed(K.diagonal(dim1=-2, dim2=-1)) == 0).all()) for K in (of.K_se, of.K_bt))
    tensors: dict[str, Tensor | None] = {
        **{name: getattr(of, name).reshape(*of.K_se.shape[:-2] or (1, 1), 3, 3).contiguous() for name in MATRICES},
        **{"h": grid.h.contiguous(), "u_star": table.u_star.contiguous(), "at": keep.contiguous()},
        **{name: None if (W := getattr(loads, name)) is None else W.contiguous() for name in ("Gm", "Wn", "Wm")},
    }
    if t is not None:
        tensors |= {"L": t.L.contiguous(), "dr": t.dr.contiguous(), "tau": t.tau.contiguous()}
        for name in ("ddr", "chord"):
            tensors[name] = None if (x := getattr(t, name)) is None else x.contiguous()
        if t.friction is not None:
            tensors |= {"friction": torch.cat([t.friction, t.friction.new_tensor([t.floor])])}
    numbers = {
        "steps": grid.h.shape[-1],
        "tendons": 0 if t is None else t.tau.shape[-1],
        "newton": 0 if t is None else t.newton,
        "varying": int(table.section is not None),
        "diagonal": int(diagonal),
        "outputs": keep.shape[-1],
    }
    return tensors, numbers


def march_linearized(
    section: Section,
    y0: Float[Tensor, "B state"],
    dy0: Float[Tensor, "B state n"],
    table: StageTable,
    dlocal: Float[Tensor, "B S 3 6 g"] | None,
    grid: Grid,
    keep: Int[Tensor, "*B P"],
    reverse: bool = False,
) -> tuple[Float[Tensor, "B P state"], Float[Tensor, "B P state n"]]:
    """States at the nodes `keep` and their derivatives along n tangents.

    The nodes stay where they are. Tangent k moves the first state by dy0[..., k] and, where k < g, the local load integrals
    [G, G2] by dlocal[..., k].
    """
    width, y0, dy0 = y0.shape[-1], with_theta(y0, table), with_theta(dy0.mT, table).mT
    if compiled(section, y0):
        tensors, numbers = known(section, table, grid, keep)
        local = None if (G := table.loads.G) is None or (G2 := table.loads.G2) is None else torch.cat([G, G2], -1)
        local = None if local is None else local.expand(len(y0), -1, 3, 6)
        states, tangents = kernel.march_linearized(tensors, numbers, local, dlocal, y0, dy0, reverse)
        return states[..., :width], tangents[..., :width, :]
    n, loads = dy0.shape[-1], table.loads
    G, G2 = loads.G, loads.G2

    def walk(y0: State, *local: Vector) -> Float[Tensor, "B P state"]:
        moved = replace(table, loads=replace(loads, G=local[0], G2=local[1])) if local else table
        return states_at(march(section, y0, moved, grid, reverse), keep)

    if n == 0:
        states = walk(y0)
        return states[..., :width], states.new_empty(*states.shape[:-1], width, 0)
    at, along = (y0,), (dy0.movedim(-1, 0),)
    if dlocal is not None and G is not None and G2 is not None:
        moves = torch.nn.functional.pad(dlocal, (0, n - dlocal.shape[-1])).movedim(-1, 0)
        at = (y0, *(x.expand(len(y0), *x.shape[-3:]) for x in (G, G2)))
        along = (*along, moves[..., :3], moves[..., 3:])

    def column(*tangents: Tensor) -> tuple[Tensor, Tensor]:
        value, tangent, *_ = jvp(walk, at, tangents)
        return value, tangent

    states, tangents = vmap(column, out_dims=(None, 0))(*along)  # pyright: ignore[reportArgumentType]
    return states[..., :width], tangents.movedim(0, -1)[..., :width, :]
