"""The march with tangents by the compiled kernel: torchrod_march of kernel.cpp."""

import ctypes

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..grid import Grid
from ..step import Section, StageTable
from .build import library
from .structures import SHARED_DIMENSIONS, March, fill, threads


def known(
    section: Section, table: StageTable, grid: Grid, keep: Int[Tensor, "*B P"]
) -> tuple[dict[str, Tensor | None], dict[str, int]]:
    """The tensors and numbers of struct Known. A table keeps its row per sample where it has one."""
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


def with_rows(tensors: dict[str, Tensor | None], B: int) -> dict[str, Tensor | None]:
    """Tables that are not shared by the batch get a row for every sample: their own first dimension may be 1."""

    def rows(name: str, x: Tensor | None) -> Tensor | None:
        if x is None or x.ndim == SHARED_DIMENSIONS.get(name, x.ndim):
            return x
        return x.expand(B, *x.shape[1:]).contiguous()

    return {name: rows(name, x) for name, x in tensors.items()}


def march_linearized(
    section: Section,
    y0: Float[Tensor, "B 13"],
    dy0: Float[Tensor, "B 13 n"],
    table: StageTable,
    dlocal: Float[Tensor, "B S 3 6 g"] | None,
    grid: Grid,
    keep: Int[Tensor, "*B P"],
    reverse: bool,
) -> tuple[Float[Tensor, "B P 13"], Float[Tensor, "B P 13 n"]]:
    """States at the kept nodes and their tangents; the first g tangents also move the local loads by dlocal. See torchrod.march."""
    lib = library()
    assert lib is not None
    B, P, n = len(y0), keep.shape[-1], dy0.shape[-1]
    tensors, numbers = known(section, table, grid, keep)
    tensors = with_rows(tensors, B)
    loads, S = table.loads, grid.h.shape[-1]
    if loads.G is not None and loads.G2 is not None:
        tensors["local"] = torch.cat([loads.G, loads.G2], -1).expand(B, S, 3, 6).contiguous()
        tensors["dlocal"] = y0.new_zeros(B, S, 3, 6, 0) if dlocal is None else dlocal.contiguous()
    out, dout = y0.new_empty(B, P, 13), y0.new_empty(B, P, 13, n)
    tensors |= {"y0": y0.contiguous(), "dy0": dy0.contiguous(), "out": out, "dout": dout}
    counts = {"batch": B, "tangents": n, "load_tangents": 0 if dlocal is None else dlocal.shape[-1], "reverse": int(reverse)}
    call = March()
    fill(call, tensors, numbers | counts)
    lib.torchrod_march(ctypes.byref(call), ctypes.c_int64(threads(B, lib.torchrod_lanes())))
    return out, dout
