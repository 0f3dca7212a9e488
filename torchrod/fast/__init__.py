"""The compiled march: built from kernel.cpp with the machine's own C++ compiler on first use, cached, and loaded with ctypes.

Where there is no compiler the torch path does the same, more slowly, and a warning says so once. TORCHROD_FAST=0 switches it off;
TORCHROD_CACHE names another folder for the library (default ~/.cache/torchrod).
"""

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
import warnings
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..grid import Grid
from ..step import Section, StageTable

SOURCE = Path(__file__).with_name("kernel.cpp")
FLAGS = ("-O3", "-march=native", "-std=c++17", "-shared", "-fPIC", "-fno-math-errno", "-pthread", "-Wno-psabi")
SAMPLES_PER_THREAD = 16  # fewer than this are not worth a thread

_COUNTS = ("batch", "steps", "tangents", "load_tangents", "tendons", "outputs", "newton", "reverse", "own_grid")
_DOUBLES = (
    "K_se",
    "K_bt",
    "K_se_inverse",
    "K_bt_inverse",
    "h",
    "y0",
    "dy0",
    "local",
    "dlocal",
    "Gm",
    "Wn",
    "Wm",
    "u_star",
    "L",
    "dr",
    "tau",
)
_REST = ("at", "out", "dout")


class _March(ctypes.Structure):
    """struct March of kernel.cpp."""

    _fields_ = [(n, ctypes.c_int64) for n in _COUNTS] + [(n, ctypes.c_void_p) for n in (*_DOUBLES, *_REST)]


def _build(compiler: str, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        made = Path(folder) / target.name
        subprocess.run([compiler, *FLAGS, str(SOURCE), "-o", str(made)], check=True, capture_output=True, text=True)
        made.replace(target)  # atomic: another process sees the whole library or none


@functools.lru_cache(maxsize=1)
def library() -> ctypes.CDLL | None:
    """The compiled library, built if need be; None, after one warning, where that is not possible."""
    if os.environ.get("TORCHROD_FAST", "1") == "0":
        return None
    compiler = os.environ.get("CXX") or shutil.which("g++") or shutil.which("clang++")
    folder = Path(os.environ.get("TORCHROD_CACHE") or Path.home() / ".cache" / "torchrod")
    key = hashlib.sha256(SOURCE.read_bytes() + repr((FLAGS, compiler, platform.machine(), _processor())).encode()).hexdigest()[:16]
    target = folder / f"march-{key}.so"
    try:
        if not target.is_file():
            if compiler is None:
                raise OSError("no C++ compiler was found")
            _build(compiler, target)
        return ctypes.CDLL(str(target))
    except (OSError, subprocess.CalledProcessError) as error:
        warnings.warn(
            f"the compiled march is not available ({error}); the torch path, about 100 times slower, is used", stacklevel=2
        )
        return None


def _processor() -> str:
    """What -march=native depends on."""
    info = Path("/proc/cpuinfo")
    if not info.is_file():
        return platform.processor()
    return next((line for line in info.read_text().splitlines() if line.startswith(("flags", "Features"))), "")


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
    B, P, S, n, loads, tendons = len(y0), keep.shape[-1], grid.h.shape[-1], dy0.shape[-1], table.loads, table.tendons
    local = None if loads.G is None or loads.G2 is None else torch.cat([loads.G, loads.G2], -1).expand(B, S, 3, 6)
    if local is not None and dlocal is None:
        dlocal = local.new_zeros(B, S, 3, 6, 0)
    out, dout = y0.new_empty(B, P, 13), y0.new_empty(B, P, 13, n)
    counts = {
        "batch": B,
        "steps": S,
        "tangents": n,
        "load_tangents": 0 if dlocal is None else dlocal.shape[-1],
        "tendons": 0 if tendons is None else tendons.tau.shape[-1],
        "outputs": P,
        "newton": 0 if tendons is None else tendons.newton,
        "reverse": int(reverse),
        "own_grid": int(grid.nodes.ndim == 2),
    }
    # Nodes that differ from sample to sample come with a batch dimension, which may be 1; the kernel wants all of it.
    each = (lambda x: x.expand(B, *x.shape[1:])) if grid.nodes.ndim == 2 else (lambda x: x)
    tensors = {
        **{name: getattr(section, name) for name in ("K_se", "K_bt", "K_se_inverse", "K_bt_inverse")},
        **{"h": each(grid.h), "y0": y0, "dy0": dy0, "local": local, "dlocal": dlocal},
        **{"u_star": each(table.u_star), "at": each(keep)},
        **{name: None if (W := getattr(loads, name)) is None else W.expand(B, S, 3, 3) for name in ("Gm", "Wn", "Wm")},
        "out": out,
        "dout": dout,
    }
    if tendons is not None:
        tensors |= {"L": each(tendons.L), "dr": each(tendons.dr), "tau": tendons.tau.expand(B, S, 3, -1)}
    # The contiguous copies must outlive the call: the structure holds bare addresses.
    alive = {name: x.contiguous() for name, x in tensors.items() if x is not None}
    arguments = _March(**counts, **{name: x.data_ptr() for name, x in alive.items()})
    threads = max(1, min(torch.get_num_threads(), B // SAMPLES_PER_THREAD))
    lib.torchrod_march(ctypes.byref(arguments), ctypes.c_int64(threads))
    return out, dout
