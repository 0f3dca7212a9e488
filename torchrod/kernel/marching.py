"""The march with tangents by the compiled kernel: torchrod_march of kernel.cpp."""

import ctypes

from jaxtyping import Float
from torch import Tensor

from .build import library
from .structures import SHARED_DIMENSIONS, March, fill, threads


def with_rows(tensors: dict[str, Tensor | None], B: int) -> dict[str, Tensor | None]:
    """Tables that are not shared by the batch get a row for every sample: their own first dimension may be 1."""

    def rows(name: str, x: Tensor | None) -> Tensor | None:
        if x is None or x.ndim == SHARED_DIMENSIONS.get(name, x.ndim):
            return x
        return x.expand(B, *x.shape[1:]).contiguous()

    return {name: rows(name, x) for name, x in tensors.items()}


def march_linearized(
    tensors: dict[str, Tensor | None],
    numbers: dict[str, int],
    local: Float[Tensor, "B S 3 6"] | None,
    dlocal: Float[Tensor, "B S 3 6 g"] | None,
    y0: Float[Tensor, "B 13"],
    dy0: Float[Tensor, "B 13 n"],
    reverse: bool,
) -> tuple[Float[Tensor, "B P 13"], Float[Tensor, "B P 13 n"]]:
    """States at the kept nodes and their tangents; the first g tangents also move the local loads by dlocal.

    tensors, numbers: those of struct Known by name (mechanics.integrate.known). local: [G, G2] at the stages.
    """
    lib = library()
    assert lib is not None
    (B, _, n), P = dy0.shape, numbers["outputs"]
    tensors = with_rows(tensors, B)
    if local is not None:
        tensors["local"] = local.contiguous()
        tensors["dlocal"] = y0.new_zeros(*local.shape, 0) if dlocal is None else dlocal.contiguous()
    out, dout = y0.new_empty(B, P, 13), y0.new_empty(B, P, 13, n)
    tensors |= {"y0": y0.contiguous(), "dy0": dy0.contiguous(), "out": out, "dout": dout}
    counts = {"batch": B, "tangents": n, "load_tangents": 0 if dlocal is None else dlocal.shape[-1], "reverse": int(reverse)}
    call = March()
    fill(call, tensors, numbers | counts)
    lib.torchrod_march(ctypes.byref(call), ctypes.c_int64(threads(B, lib.torchrod_lanes())))
    return out, dout
