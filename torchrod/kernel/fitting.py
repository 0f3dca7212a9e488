"""The fit by the compiled kernel, as operators of torch: h and H, the normal equations, and one iteration of the filter.

The operators are known to torch (torch.library) with a shape-only stand-in each, so torch.compile and exporting go through them.
Their derivatives and batching rules: derivatives.py.
"""

import ctypes
import time
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .build import library
from .structures import Fit, address, fill, pointer, threads
from .structures import Sums as CSums

FAMILIES = {"none": 0, "gaussian": 1, "paper": 2, "point": 3, "linear": 4}

# What an operator is handed, in this order: tensors (empty where there is none), integers and numbers.
_SECTION = ("K_se", "K_bt", "K_se_inverse", "K_bt_inverse")
_ALONG = ("h", "Gm", "Wn", "Wm", "u_star", "L", "dr", "tau", "at", "locations", "basis", "s", "inside", "node")
TENSORS = (*_SECTION, *_ALONG, "offsets", "active", "weight", "positions", "w")
COUNTS = (
    *("steps", "tendons", "newton", "diagonal", "outputs"),
    *("family", "count", "per_load", "gamma", "size", "tip", "tensions", "registration"),
)
NUMBERS = ("length", "force_scale", "eps", "beta1", "beta2")
NUMBERS += ("force_unit", "moment_unit", "length_unit", "angle_unit", "tension_unit", "robust")
_spent = [0.0]


def seconds() -> float:
    """How long this process has spent in the fit's operators so far."""
    return _spent[0]


@dataclass(frozen=True)
class FitTables:
    """All that the fit of a chunk knows beforehand: the tensors of TENSORS, the integers of COUNTS, the numbers of NUMBERS."""

    tensors: list[Tensor]
    counts: list[int]
    numbers: list[float]

    @classmethod
    def of(cls, tensors: dict[str, Tensor | None], counts: dict[str, int], numbers: dict[str, float]) -> "FitTables":
        """From names."""
        none = torch.empty(0, dtype=torch.float64)
        found = [none if (x := tensors.get(name)) is None else x.contiguous() for name in TENSORS]
        return cls(found, [counts[name] for name in COUNTS], [numbers[name] for name in NUMBERS])

    @cached_property
    def structure(self) -> Fit:
        """struct Fit, which points into the tensors."""
        return _structure(self.tensors, self.counts, self.numbers)

    @property
    def markers(self) -> int:
        """P."""
        return _outputs(self.counts)

    def with_rows(self, positions: Float[Tensor, "B P 3"], w: Float[Tensor, "B z"], nu: float) -> "FitTables":
        """The same robot with the rows of other samples, where nothing else has a row per sample: a copy of the structure."""
        rows = [positions.contiguous(), w.contiguous()]
        other = FitTables([*self.tensors[:-2], *rows], self.counts, [*self.numbers[:-1], nu])
        copy = Fit.from_buffer_copy(self.structure)
        copy.positions, copy.w, copy.robust = pointer(rows[0], "positions"), pointer(rows[1], "w"), nu
        vars(other)["structure"] = copy
        return other


def _structure(tensors: list[Tensor], counts: list[int], numbers: list[float]) -> Fit:
    named = {name: x if x.numel() else None for name, x in zip(TENSORS, tensors, strict=True)}
    values: dict[str, float | int] = dict(zip(COUNTS, counts, strict=True)) | dict(zip(NUMBERS, numbers, strict=True))
    fit = Fit()
    fill(fit, named, values)
    fit.loads.size = counts[COUNTS.index("gamma")]  # which has the same name within its own structure as x has in the whole
    return fit


def run(function: str, samples: int, *arguments: object) -> None:
    """Call the library, on as many threads as the samples are worth, and count the time."""
    lib = library(wait=True)
    assert lib is not None
    begun = time.perf_counter()
    getattr(lib, function)(*arguments, ctypes.c_int64(threads(samples, lib.torchrod_lanes())))
    _spent[0] += time.perf_counter() - begun


def _outputs(counts: list[int]) -> int:
    """P."""
    return counts[COUNTS.index("outputs")] - 1


def measure_now(x: Tensor, index: Tensor, slopes: bool, fit: Fit, P: int) -> tuple[Tensor, Tensor, Tensor]:
    """torchrod::measure without torch's dispatcher, for a loop that is not to be traced."""
    b, n = len(x), x.shape[-1]
    h, line = x.new_empty(b, 3 * P + 6), x.new_empty(b, P, 3)
    H = x.new_empty(b, 3 * P + 6, n if slopes else 0)
    x, index = x.contiguous(), index.contiguous()
    given, out = (address(x, "x"), address(index, "index")), (address(h, "h"), address(H if slopes else None, "H"))
    run("torchrod_measure", b, ctypes.byref(fit), *given, ctypes.c_int64(b), *out, address(line, "line"))
    return h, H, line


@torch.library.custom_op("torchrod::measure", mutates_args=(), device_types="cpu")
def measure(
    x: Tensor, index: Tensor, slopes: bool, tensors: list[Tensor], counts: list[int], numbers: list[float]
) -> tuple[Tensor, Tensor, Tensor]:
    """h (b, 3 P + 6), H (b, 3 P + 6, n) (without `slopes`: n = 0), centre line (b, P, 3): of samples `index` at x (b, n)."""
    return measure_now(x, index, slopes, _structure(tensors, counts, numbers), _outputs(counts))


@measure.register_fake
def _(x, index, slopes, tensors, counts, numbers):
    b, n, P = x.shape[0], x.shape[1], _outputs(counts)
    return x.new_empty(b, 3 * P + 6), x.new_empty(b, 3 * P + 6, n if slopes else 0), x.new_empty(b, P, 3)


def normal_equations_now(x: Tensor, fit: Fit, P: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """torchrod::normal_equations without torch's dispatcher."""
    B, n = len(x), x.shape[-1]
    A, g, cost = x.new_empty(B, 2, n, n), x.new_empty(B, 2, n), x.new_empty(B, 2)
    r, line = x.new_empty(B, 3 * P + 6), x.new_empty(B, P, 3)
    sums, x = CSums(), x.contiguous()
    given = address(x, "x")
    fill(sums, {"A": A, "g": g, "cost": cost, "r": r, "line": line}, {})
    run("torchrod_normal", B, ctypes.byref(fit), given, ctypes.c_int64(B), ctypes.byref(sums))
    return A, g, cost, r, line


@torch.library.custom_op("torchrod::normal_equations", mutates_args=(), device_types="cpu")
def normal_equations(
    x: Tensor, tensors: list[Tensor], counts: list[int], numbers: list[float]
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """H^T W H (B, 2, n, n), H^T W r (B, 2, n) and r^T W r (B, 2) of the markers and of the tip residual; r (B, z); centre line."""
    return normal_equations_now(x, _structure(tensors, counts, numbers), _outputs(counts))


@normal_equations.register_fake
def _(x, tensors, counts, numbers):
    B, n, P = x.shape[0], x.shape[1], _outputs(counts)
    return x.new_empty(B, 2, n, n), x.new_empty(B, 2, n), x.new_empty(B, 2), x.new_empty(B, 3 * P + 6), x.new_empty(B, P, 3)


def cost_now(x: Float[Tensor, "B n"], mean: Float[Tensor, " n"], precision: Float[Tensor, " n"], fit: Fit) -> Float[Tensor, " B"]:
    """The cost at x, the prior's (mean and precision) included."""
    x, mean, precision, cost = x.contiguous(), mean.contiguous(), precision.contiguous(), x.new_empty(len(x))
    given = (address(x, "x"), address(mean, "mean"), address(precision, "precision"))
    run("torchrod_cost", len(x), ctypes.byref(fit), *given, ctypes.c_int64(len(x)), address(cost, "cost"))
    return cost


def posterior_now(
    sums: "Sums", x: Float[Tensor, "B n"], mean: Float[Tensor, " n"], precision: Float[Tensor, " n"], stiffer: float
) -> tuple[Float[Tensor, "B n n"], Float[Tensor, " B"]]:
    """From the sums at x: the covariance, with the tip residual's weight multiplied by `stiffer`, and the cost with the prior's."""
    (B, n), x, mean, precision = x.shape, x.contiguous(), mean.contiguous(), precision.contiguous()
    covariance, cost, structure = x.new_empty(B, n, n), x.new_empty(B), CSums()
    fill(structure, vars(sums), {})
    given = (address(x, "x"), address(mean, "mean"), address(precision, "precision"), ctypes.c_int64(n), ctypes.c_double(stiffer))
    out = (address(covariance, "covariance"), address(cost, "cost"))
    run("torchrod_posterior", B, ctypes.byref(structure), *given, ctypes.c_int64(B), *out)
    return covariance, cost


def balance_now(
    x: Float[Tensor, "B n"], q_tip: Float[Tensor, "B 4"] | None, increments: int, tolerance: float, fit: Fit, P: int
) -> tuple[Float[Tensor, "B 6"], Float[Tensor, " B"], Float[Tensor, "B P 3"]]:
    """The base wrench (N, N m) in equilibrium with the loads of x, how far the base is from its clamp (rad), the centre line (m).

    mechanics.statics.solve_shape without its damping: what has not settled to the tolerance (rad) must be solved by that.
    """
    B, x = len(x), x.contiguous()
    q_tip = None if q_tip is None else q_tip.contiguous()
    wrench, missed, line = x.new_empty(B, 6), x.new_empty(B), x.new_empty(B, P + 1, 3)
    start, numbers = address(q_tip, "q_tip"), (ctypes.c_int64(increments), ctypes.c_int64(B), ctypes.c_double(tolerance))
    out = (address(wrench, "wrench"), address(missed, "missed"), address(line, "line"))
    run("torchrod_balance", B, ctypes.byref(fit), address(x, "x"), start, *numbers, *out)
    return wrench, missed, line[:, :P]


@dataclass(frozen=True)
class Sums:
    """What `normal_equations` returns, kept for every sample of a chunk."""

    A: Float[Tensor, "B 2 n n"]
    g: Float[Tensor, "B 2 n"]
    cost: Float[Tensor, "B 2"]
    r: Float[Tensor, "B z"]
    line: Float[Tensor, "B P 3"]

    @classmethod
    def room(cls, B: int, n: int, z: int, P: int) -> "Sums":
        """To be written, for n unknowns, z rows and P places."""
        sizes = ((B, 2, n, n), (B, 2, n), (B, 2), (B, z), (B, P, 3))
        return cls(*(torch.empty(size, dtype=torch.float64) for size in sizes))

    def put(self, index: Int[Tensor, " b"], other: "Sums") -> None:
        """Write the samples of an index, in place."""
        for name in ("A", "g", "cost", "r", "line"):
            getattr(self, name)[index] = getattr(other, name)
