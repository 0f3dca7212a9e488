"""Walk the arc-length step along the rod, and carry tangents with it.

`march` is the definition, in torch, for any transform. `march_linearized` returns the states at chosen nodes together with their
derivatives along given tangents: by the compiled kernel where it serves (torchrod.kernel), else by torch.func on
each step, which torch.compile can trace. All differentiate the discrete steps, so they agree to round-off.
"""

import os
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.func import jvp, vmap

from .. import kernel
from .grid import Grid
from .lie import Vector
from .section import Section, StageTable, State, rk4_step


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
    return plain and y.dtype == torch.float64 and y.device.type == "cpu" and kernel.available()


def known(
    section: Section, table: StageTable, grid: Grid, keep: Int[Tensor, "*B P"]
) -> tuple[dict[str, Tensor | None], dict[str, int]]:
    """What the kernel is handed of a robot on a grid: struct Known by name. A table keeps its row per sample where it has one."""
    t, loads = table.tendons, table.loads
    diagonal = all(bool((K - torch.diag(K.diagonal()) == 0).all()) for K in (section.K_se, section.K_bt))
    tensors: dict[str, Tensor | None] = {
        **{name: getattr(section, name).contiguous() for name in ("K_se", "K_bt", "K_se_inverse", "K_bt_inverse")},
        **{"h": grid.h.contiguous(), "u_star": table.u_star.contiguous(), "at": keep.contiguous()},
        **{name: None if (W := getattr(loads, name)) is None else W.contiguous() for name in ("Gm", "Wn", "Wm")},
    }
    if t is not None:
        tensors |= {"L": t.L.contiguous(), "dr": t.dr.contiguous(), "tau": t.tau.contiguous()}
    numbers = {
        "steps": grid.h.shape[-1],
        "tendons": 0 if t is None else t.tau.shape[-1],
        "newton": 0 if t is None else t.newton,
        "diagonal": int(diagonal),
        "outputs": keep.shape[-1],
    }
    return tensors, numbers


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
        tensors, numbers = known(section, table, grid, keep)
        local = None if (G := table.loads.G) is None or (G2 := table.loads.G2) is None else torch.cat([G, G2], -1)
        local = None if local is None else local.expand(len(y0), -1, 3, 6)
        return kernel.march_linearized(tensors, numbers, local, dlocal, y0, dy0, reverse)
    n, h = dy0.shape[-1], grid.h
    table = table.reversed() if reverse else table
    if dlocal is not None:
        dlocal = torch.nn.functional.pad(dlocal, (0, n - dlocal.shape[-1])).movedim(-1, 0)
        dlocal = dlocal.flip(-2) if reverse else dlocal
    y, dy, steps = y0, dy0.movedim(-1, 0), range(h.shape[-1])
    states, tangents = [y], [dy]
    for i in reversed(steps) if reverse else steps:
        length = (-h[..., i] if reverse else h[..., i]).expand(y.shape[:-1])
        dG = None if dlocal is None else dlocal[:, :, i]
        y, dy = _step()(section, y, dy, table.step(i), dG, length) if n else (rk4_step(section, y, table.step(i), length), dy)
        states.append(y)
        tangents.append(dy)
    if reverse:
        states, tangents = states[::-1], tangents[::-1]
    kept = states_at(torch.stack(tangents, -2).movedim(0, -1).flatten(-2), keep)
    return states_at(torch.stack(states, -2), keep), kept.unflatten(-1, (13, n))


def step_with_tangents(
    section: Section,
    y: State,
    dy: Float[Tensor, "n B 13"],
    table: StageTable,
    dlocal: Float[Tensor, "n B 3 6"] | None,
    h: Float[Tensor, " B"],
) -> tuple[State, Float[Tensor, "n B 13"]]:
    """One step and its derivatives along n tangents, which move the state by dy and the local loads [G, G2] by dlocal."""
    known = table.loads

    def column(dy: State, d: Float[Tensor, "B 3 6"] | None) -> tuple[State, State]:
        if d is None or known.G is None or known.G2 is None:
            value, tangent, *_ = jvp(lambda y: rk4_step(section, y, table, h), (y,), (dy,))
            return value, tangent

        def step(y: State, G: Vector, G2: Vector) -> State:
            return rk4_step(section, y, replace(table, loads=replace(known, G=G, G2=G2)), h)

        # Copies: torch.compile asserts that a dual number's parts lie alike in memory.
        at = [x.expand(*y.shape[:-1], 3, 3).clone() for x in (known.G, known.G2)]
        value, tangent, *_ = jvp(step, (y, *at), (dy, d[..., :3].clone(), d[..., 3:].clone()))
        return value, tangent

    axes = (0, None if dlocal is None else 0)
    return vmap(column, in_dims=axes, out_dims=(None, 0))(dy, dlocal)  # pyright: ignore[reportArgumentType]


@lru_cache(maxsize=1)
def _step() -> Callable[..., tuple[State, Float[Tensor, "n B 13"]]]:
    """step_with_tangents, compiled whole by torch.compile where TORCHROD_COMPILE names a backend (inductor).

    That is the path that needs no kernel of ours; on a CPU torch's own compiler wants a C++ compiler too. A minute or more for each
    new batch size, robot and family of loads, kept in torch's cache on disk, then 14 times as fast or more (docs/performance.md).
    """
    backend = os.environ.get("TORCHROD_COMPILE", "")
    return torch.compile(step_with_tangents, fullgraph=True, dynamic=False, backend=backend) if backend else step_with_tangents
