"""The structures of known.h, loads.h, measure.h, filter.h, course.h and kernel.cpp, for ctypes, and how tensors become them."""

import ctypes
from collections.abc import Mapping

import torch
from torch import Tensor

from ..util.threads import kernel_threads

GROUPS = 4  # that are worth a thread
_I, _D, _P = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class Table(ctypes.Structure):
    """A tensor that the batch shares (stride 0) or that has one row per sample."""

    _fields_ = [("data", _P), ("stride", _I)]


class Known(ctypes.Structure):
    """struct Known."""

    _fields_ = [
        *((n, _I) for n in ("steps", "tendons", "newton", "diagonal")),
        *((n, _P) for n in ("K_se", "K_bt", "K_se_inverse", "K_bt_inverse")),
        *((n, Table) for n in ("h", "Gm", "Wn", "Wm", "u_star", "L", "dr", "tau", "at")),
        ("outputs", _I),
    ]


class Loads(ctypes.Structure):
    """struct Loads."""

    _fields_ = [
        *((n, _I) for n in ("family", "count", "per_load", "size")),
        *((n, _D) for n in ("length", "force_scale", "eps", "beta1", "beta2")),
        *((n, _P) for n in ("locations", "basis")),
        *((n, Table) for n in ("s", "inside", "node")),
    ]


class Fit(ctypes.Structure):
    """struct Fit."""

    _fields_ = [
        ("known", Known),
        ("loads", Loads),
        *((n, _I) for n in ("size", "tip", "tensions", "registration")),
        *((n, _D) for n in ("force_unit", "moment_unit", "length_unit", "angle_unit", "tension_unit", "robust")),
        ("offsets", _P),
        *((n, Table) for n in ("active", "weight")),
        *((n, _P) for n in ("positions", "w")),
    ]


class Filter(ctypes.Structure):
    """struct Filter."""

    _fields_ = [
        *((n, _P) for n in ("mean", "precision", "Q")),
        *((n, _D) for n in ("step", "decrement", "share", "settled", "gain")),
        *((n, _P) for n in ("x", "Sigma", "before", "cap", "Sigma0", "done")),
    ]


class Perceptron(ctypes.Structure):
    """struct Perceptron."""

    _fields_ = [("depth", _I), ("sizes", _P), ("weights", _P)]


class Course(ctypes.Structure):
    """struct Course."""

    _fields_ = [
        *((n, _P) for n in ("coarse", "fine", "rough", "filter", "out")),
        ("most", _I),
        *((n, _P) for n in ("near", "converged", "iterations")),
    ]


class March(ctypes.Structure):
    """struct March."""

    _fields_ = [
        ("known", Known),
        *((n, _I) for n in ("batch", "tangents", "load_tangents", "reverse")),
        *((n, _P) for n in ("y0", "dy0", "local", "dlocal", "out", "dout")),
    ]


class Sums(ctypes.Structure):
    """struct Sums."""

    _fields_ = [(n, _P) for n in ("A", "g", "cost", "r", "line")]


# Tensors that may have a row per sample, and their dimensions when they have none.
SHARED_DIMENSIONS = {
    **{"h": 1, "Gm": 3, "Wn": 3, "Wm": 3, "u_star": 3, "L": 5, "dr": 4, "tau": 3},
    **{"at": 1, "s": 2, "inside": 2, "node": 1, "weight": 1, "active": 3},
}


# What the kernel reads and writes at an address: double, but for these.
_DOUBLE, _INT64, _FLAGS = (torch.float64,), (torch.int64,), (torch.bool, torch.uint8)
_TYPES = {
    **dict.fromkeys(("at", "node", "sizes", "iterations", "index", "live"), _INT64),
    **dict.fromkeys(("done", "near", "converged"), _FLAGS),
    "weights": (torch.float32,),
}


def pointer(x: Tensor | None, name: str) -> int | None:
    """The address of a contiguous tensor's first number, of the type that the kernel takes `name` for; null for none.

    Errors: TypeError for another type, which the kernel would read and write beyond its end.
    """
    if x is None:
        return None
    wanted = _TYPES.get(name, _DOUBLE)
    if x.dtype not in wanted:
        raise TypeError(f"{name} is {x.dtype}, but the compiled kernel takes {wanted[0]}; convert it with .to({wanted[0]})")
    assert x.is_contiguous(), "the kernel reads contiguous memory"
    return x.data_ptr()


def address(x: Tensor | None, name: str) -> ctypes.c_void_p:
    """The same as an argument of a function."""
    return ctypes.c_void_p(pointer(x, name))


def fill(structure: ctypes.Structure, tensors: Mapping[str, Tensor | None], numbers: Mapping[str, float | int]) -> None:
    """Set every field of a structure, and of those within it, by name. The tensors must outlive its use."""
    for name, kind, *_ in structure._fields_:
        if kind is Table:
            x = tensors.get(name)
            rows = x is not None and x.ndim > SHARED_DIMENSIONS[name]
            setattr(structure, name, Table(pointer(x, name), x[0].numel() if x is not None and rows else 0))
        elif kind is _P:
            setattr(structure, name, pointer(tensors.get(name), name))
        elif isinstance(kind, type) and issubclass(kind, ctypes.Structure):
            fill(getattr(structure, name), tensors, numbers)
        else:
            value = numbers[name]
            setattr(structure, name, value if kind is _D else int(value))


def threads(samples: int, lanes: int) -> int:
    """As many as there are, but none for less than GROUPS groups of lanes."""
    return max(1, min(kernel_threads(), samples // (GROUPS * lanes)))
