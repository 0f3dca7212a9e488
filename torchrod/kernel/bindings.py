"""The compiled library as Python sees it: its structures, how tensors become them, and a function for each of its own.

The C++ is the definition of the structures. Each is mirrored here once, under its own name with a C in front and with the same
names of fields in the same order; when the library is loaded, its own account of them (layout.h) is compared with `layout`.
"""

import ctypes
import functools
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..util.threads import kernel_threads
from . import build

GROUPS = 4  # of lanes that are worth a thread
MOST_TENDONS = 16
STATE = 13  # of a section: p, q and the wrench of mechanics.section (1)
OUT = 4  # outputs of a perceptron's layer that are summed at a time
OFF = "parameters", "stiffness", "curvature", "hanging", "pulls", "frictions", "places"  # counts of how robots are off
FAMILIES = {"none": 0, "gaussian": 1, "paper": 2, "point": 3, "linear": 4}
_I, _D, _P = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class CTable(ctypes.Structure):
    """A tensor that the batch shares (stride 0) or that has one row per sample."""

    _fields_ = [("data", _P), ("stride", _I)]


class CPlaces(ctypes.Structure):
    """The same of integers."""

    _fields_ = CTable._fields_


class CDeviations(ctypes.Structure):
    """How the robot of every sample is off."""

    _fields_ = [
        *((n, _I) for n in OFF),
        *((n, CTable) for n in ("kappa", "dkappa", "K_off", "u_off", "hangs", "pulling")),
    ]


class CKnown(ctypes.Structure):
    """The robot on its grid."""

    _fields_ = [
        *((n, _I) for n in ("steps", "tendons", "newton", "diagonal", "varying")),
        *((n, CTable) for n in ("K_se", "K_bt", "K_se_inverse", "K_bt_inverse")),
        *((n, CTable) for n in ("h", "Gm", "Wn", "Wm", "u_star", "L", "dr", "tau", "ddr", "chord")),
        ("friction", _P),
        ("at", CPlaces),
        ("outputs", _I),
        ("off", CDeviations),
    ]


class CLoads(ctypes.Structure):
    """The family of the loads, and what it knows beforehand."""

    _fields_ = [
        *((n, _I) for n in ("family", "count", "per_load", "size", "axial")),
        *((n, _D) for n in ("length", "force_scale", "eps", "beta1", "beta2", "friction", "faint")),
        *((n, _P) for n in ("locations", "basis")),
        *((n, CTable) for n in ("s", "inside")),
        ("node", CPlaces),
    ]


class CTask(ctypes.Structure):
    """What is fitted."""

    _fields_ = [
        ("known", CKnown),
        ("loads", CLoads),
        *((n, _I) for n in ("size", "tip", "tensions", "registration")),
        *((n, _D) for n in ("force_unit", "moment_unit", "length_unit", "angle_unit", "tension_unit", "slack", "leak", "robust")),
        ("offsets", _P),
        *((n, CTable) for n in ("active", "weight")),
        *((n, _P) for n in ("positions", "w")),
    ]


class CFilter(ctypes.Structure):
    """Prior, limits and state of the filter."""

    _fields_ = [
        *((n, CTable) for n in ("mean", "precision")),
        ("Q", _P),
        *((n, _D) for n in ("step", "decrement", "share", "settled", "gain")),
        ("exact", _I),
        *((n, _P) for n in ("x", "Sigma", "before", "cap", "reach", "Sigma0", "done")),
    ]


class CSums(ctypes.Structure):
    """Where the normal equations are written."""

    _fields_ = [(n, _P) for n in ("A", "g", "cost", "C", "r", "line")]


class CCourse(ctypes.Structure):
    """All iterations of a fit."""

    _fields_ = [
        *((n, _P) for n in ("coarse", "fine", "rough", "filter", "out")),
        ("most", _I),
        *((n, _P) for n in ("near", "converged", "iterations")),
    ]


class CMarch(ctypes.Structure):
    """A march with tangents."""

    _fields_ = [
        ("known", CKnown),
        *((n, _I) for n in ("batch", "tangents", "load_tangents", "reverse")),
        *((n, _P) for n in ("y0", "dy0", "local", "dlocal", "out", "dout")),
    ]


class CPerceptron(ctypes.Structure):
    """The layers of a perceptron."""

    _fields_ = [("depth", _I), ("sizes", _P), ("weights", _P)]


STRUCTURES = (CTable, CPlaces, CDeviations, CKnown, CLoads, CTask, CFilter, CSums, CCourse, CMarch, CPerceptron)
CONSTANTS = {"MOST_TENDONS": MOST_TENDONS, "STATE": STATE, "OUT": OUT} | FAMILIES
FUNCTIONS: dict[str, tuple[type, ...]] = {
    "torchrod_march": (_P, _I),
    "torchrod_normal": (_P, _P, _I, _P, _I),
    "torchrod_measure": (_P, _P, _I, _I, _P, _P, _I),
    "torchrod_posterior": (_P, _P, _P, _P, _I, _I, _I, _I, _P, _P, _I),
    "torchrod_iterate": (_P, _P, _P, _P, _I, _I),
    "torchrod_filter": (_P, _P, _I, _I),
    "torchrod_balance": (_P, _P, _P, _I, _I, _D, _P, _P, _P, _I),
    "torchrod_perceptron": (_P, _P, _I, _P, _I),
    "torchrod_cost": (_P, _P, _P, _P, _I, _P, _I),
}


def layout() -> str:
    """What the library has to say of itself (layout.h): its structures, constants and functions, a line each.

    A field is name:offset:size and its kind, an argument its kind: i an integer, d a number, p a pointer, s a structure.
    """
    kinds = {_I: "i", _D: "d", _P: "p"}

    def fields(S: type[ctypes.Structure]) -> str:
        found = [(name, getattr(S, name), kinds.get(kind, "s")) for name, kind, *_ in S._fields_]
        return "".join(f" {name}:{at.offset}:{at.size}{kind}" for name, at, kind in found)

    structures = [f"{S.__name__[1:]} {ctypes.sizeof(S)}{fields(S)}" for S in STRUCTURES]
    constants = [f"{name} {value}" for name, value in CONSTANTS.items()]
    functions = [f"{name} {''.join(kinds[kind] for kind in kinds_of)}" for name, kinds_of in FUNCTIONS.items()]
    return "\n".join([*structures, *constants, *functions, ""])


def fault(library: ctypes.CDLL) -> str | None:
    """What differs between the library and this file; None: nothing. Declares its functions."""
    try:
        library.torchrod_layout.restype = ctypes.c_char_p
        library.torchrod_lanes.restype = _I
        for name, kinds in FUNCTIONS.items():
            function = getattr(library, name)
            function.argtypes, function.restype = kinds, None
    except AttributeError as error:
        return f"the library lacks a function ({error})"
    ours, theirs = layout().splitlines(), library.torchrod_layout().decode().splitlines()
    differ = [line.split()[0] for line in (*ours, *theirs) if line not in ours or line not in theirs]
    if ours != theirs:
        return f"the library and bindings.py disagree on {', '.join(dict.fromkeys(differ)) or 'an order'}"
    return None


@functools.lru_cache(maxsize=1)
def _say_once(reason: str) -> None:
    warnings.warn(f"no compiled kernel ({reason}); the torch path, hundreds of times slower, is used", stacklevel=3)


def found() -> ctypes.CDLL | str:
    """The library, or why there is none. It is built where it is not there, which takes about 20 s once per machine."""
    return "TORCHROD_FAST=0" if build.off() else build.find(fault)


def library() -> ctypes.CDLL | None:
    """The compiled library; None where there is none, after one warning that says why unless TORCHROD_FAST=0 does.

    Waits for a build where that is necessary: which path serves never depends on the clock.
    """
    if build.off():
        return None
    there = build.find(fault)
    if isinstance(there, str):
        _say_once(there)
        return None
    return there


def available() -> bool:
    """Whether the kernel serves."""
    return library() is not None


# Tensors that may have a row per sample, and their dimensions when they have none.
SHARED_DIMENSIONS = {
    **{"K_se": 4, "K_bt": 4, "K_se_inverse": 4, "K_bt_inverse": 4},
    **{"h": 1, "Gm": 3, "Wn": 3, "Wm": 3, "u_star": 3, "L": 5, "dr": 4, "ddr": 4, "chord": 4, "tau": 3},
    **{"kappa": 1, "dkappa": 2, "K_off": 4, "u_off": 4, "hangs": 3, "pulling": 3},
    **{"at": 1, "s": 2, "inside": 2, "node": 1, "weight": 1, "active": 3, "mean": 1, "precision": 1},
}
# What the kernel reads and writes at an address: double, but for these.
_DOUBLE, _INT64, _FLAGS = (torch.float64,), (torch.int64,), (torch.bool, torch.uint8)
_TYPES = {
    **dict.fromkeys(("at", "node", "sizes", "iterations", "live"), _INT64),
    **dict.fromkeys(("done", "near", "converged"), _FLAGS),
    **dict.fromkeys(("weights", "features", "hidden"), (torch.float32,)),
}


def _pointer(x: Tensor | None, name: str) -> int | None:
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


def _table(x: Tensor | None, name: str, kind: type = CTable) -> Any:
    rows = x is not None and x.ndim > SHARED_DIMENSIONS[name]
    return kind(_pointer(x, name), x[0].numel() if x is not None and rows and len(x) else 0)


def _fill(structure: Any, tensors: Mapping[str, Tensor | None], numbers: Mapping[str, float | int]) -> None:
    """Set every field of a structure, and of those within it, by name. The tensors must outlive its use."""
    for name, kind, *_ in structure._fields_:
        if kind in (CTable, CPlaces):
            setattr(structure, name, _table(tensors.get(name), name, kind))
        elif kind is _P:
            setattr(structure, name, _pointer(tensors.get(name), name))
        elif issubclass(kind, ctypes.Structure):
            _fill(getattr(structure, name), tensors, numbers)
        else:
            value = numbers.get(name, 0) if name in OFF else numbers[name]
            setattr(structure, name, value if kind is _D else int(value))


_spent = [0.0]


def seconds() -> float:
    """How long this process has spent in the kernel so far, marches apart."""
    return _spent[0]


def _threads(samples: int, lanes: int) -> int:
    """As many as there are, but none for less than GROUPS groups of lanes."""
    return max(1, min(kernel_threads(), samples // (GROUPS * lanes)))


def _run(function: str, samples: int, *arguments: object) -> None:
    """Call the library, on as many threads as the samples are worth, and count the time."""
    lib = library()
    assert lib is not None
    begun = time.perf_counter()
    getattr(lib, function)(*arguments, _threads(samples, lib.torchrod_lanes()))
    _spent[0] += time.perf_counter() - begun


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
    y0: Float[Tensor, "B c"],
    dy0: Float[Tensor, "B c n"],
    reverse: bool,
) -> tuple[Float[Tensor, "B P c"], Float[Tensor, "B P c n"]]:
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
    width = y0.shape[1]
    out, dout = y0.new_empty(B, P, width), y0.new_empty(B, P, width, n)
    tensors |= {"y0": y0.contiguous(), "dy0": dy0.contiguous(), "out": out, "dout": dout}
    counts = {"batch": B, "tangents": n, "load_tangents": 0 if dlocal is None else dlocal.shape[-1], "reverse": int(reverse)}
    call = CMarch()
    _fill(call, tensors, numbers | counts)
    lib.torchrod_march(ctypes.byref(call), _threads(B, lib.torchrod_lanes()))
    return out, dout


@dataclass(frozen=True)
class FitTables:
    """All that the fit of a chunk knows beforehand: struct Task, the tensors that it points into, and P, the number of markers."""

    structure: CTask
    markers: int
    held: dict[str, Tensor | None] = field(repr=False)

    @classmethod
    def of(cls, tensors: dict[str, Tensor | None], counts: dict[str, int], numbers: dict[str, float]) -> "FitTables":
        """From the names of the fields, of Known and Loads as well; gamma: the field `size` of Loads."""
        held = {name: None if x is None or not x.numel() else x.contiguous() for name, x in tensors.items()}
        task = CTask()
        _fill(task, held, counts | numbers)
        task.loads.size = counts["gamma"]  # which has the same name within its own structure as x has in the whole
        return cls(task, counts["outputs"] - 1, held)

    def with_rows(self, positions: Float[Tensor, "B P 3"] | None, w: Float[Tensor, "B z"] | None, nu: float) -> "FitTables":
        """The same robot with the rows of other samples, where nothing else has a row per sample: a copy of the structure."""
        rows = {name: None if x is None else x.contiguous() for name, x in (("positions", positions), ("w", w))}
        copy = CTask.from_buffer_copy(self.structure)
        copy.positions, copy.w, copy.robust = (_pointer(rows["positions"], "positions"), _pointer(rows["w"], "w"), nu)
        return FitTables(copy, self.markers, self.held | rows)

    def off_by(
        self, kappa: Float[Tensor, "B m"], dkappa: Float[Tensor, "B m k"] | None, weight: Float[Tensor, "B 3"] | None
    ) -> "FitTables":
        """The same of robots that are off by kappa (model.deviations), which moves so with the parameters: a copy of the structure.

        weight: of the rod per metre (N/m), where it is not that of the tables.
        """
        rows = {"kappa": kappa.contiguous(), "dkappa": None if dkappa is None else dkappa.contiguous()}
        copy = CTask.from_buffer_copy(self.structure)
        for name, x in rows.items():
            setattr(copy.known.off, name, _table(x, name))
        if weight is not None:
            rows["weight"] = weight.contiguous()
            copy.weight = _table(rows["weight"], "weight")
        return FitTables(copy, self.markers, self.held | rows)


@dataclass(frozen=True)
class Sums:
    """The normal equations of samples, markers and tip residual apart, dc/dx, the residuals and the centre line (m)."""

    A: Float[Tensor, "B 2 n n"]
    g: Float[Tensor, "B 2 n"]
    cost: Float[Tensor, "B 2"]
    C: Float[Tensor, "B 6 n"]
    r: Float[Tensor, "B z"]
    line: Float[Tensor, "B P 3"]

    @classmethod
    def room(cls, B: int, n: int, z: int, P: int) -> "Sums":
        """To be written, for n unknowns, z rows and P places."""
        sizes = ((B, 2, n, n), (B, 2, n), (B, 2), (B, 6, n), (B, z), (B, P, 3))
        return cls(*(torch.empty(size, dtype=torch.float64) for size in sizes))

    def put(self, index: Int[Tensor, " b"], other: "Sums") -> None:
        """Write the samples of an index, in place."""
        for name in ("A", "g", "cost", "C", "r", "line"):
            getattr(self, name)[index] = getattr(other, name)

    @property
    def structure(self) -> CSums:
        """struct Sums, which points into the tensors."""
        sums = CSums()
        _fill(sums, vars(self), {})
        return sums


# Of the prior: one for all samples, or a row for each.
Prior = Float[Tensor, " n"] | Float[Tensor, "B n"]


def _prior(mean: Prior, precision: Prior) -> tuple[Tensor, Tensor, CTable, CTable]:
    """Both contiguous, to be held while the structures are in use, and their structures."""
    mean, precision = mean.contiguous(), precision.contiguous()
    return mean, precision, _table(mean, "mean"), _table(precision, "precision")


def normal_equations_now(x: Float[Tensor, "B n"], task: CTask, P: int) -> Sums:
    """The sums at x."""
    (B, n), x = x.shape, x.contiguous()
    found = Sums.room(B, n, 3 * P + 6, P)
    _run("torchrod_normal", B, ctypes.byref(task), _pointer(x, "x"), B, ctypes.byref(found.structure))
    return found


def measured_now(
    x: Float[Tensor, "B n"], task: CTask, P: int, slopes: bool, width: int = 0
) -> tuple[Float[Tensor, "B z"], Float[Tensor, "B z n"] | None]:
    """h(x) and, where slopes are wanted, dh/dx; with a `width`, instead of the markers' rows, the section's state of as many
    numbers (STATE, then Theta of every tendon where they rub) at each place and at the tip.
    """
    (B, n), x = x.shape, x.contiguous()
    Z = (width * (P + 1) if width else 3 * P) + 6
    h, H = x.new_empty(B, Z), x.new_empty(B, Z, n) if slopes else None
    _run("torchrod_measure", B, ctypes.byref(task), _pointer(x, "x"), B, int(width > 0), _pointer(h, "h"), _pointer(H, "H"))
    return h, H


def cost_now(x: Float[Tensor, "B n"], mean: Prior, precision: Prior, task: CTask) -> Float[Tensor, " B"]:
    """The cost at x, the prior's (mean and precision) included."""
    x, cost, (*_held, m, p) = x.contiguous(), x.new_empty(len(x)), _prior(mean, precision)
    prior = (ctypes.byref(m), ctypes.byref(p))
    _run("torchrod_cost", len(x), ctypes.byref(task), _pointer(x, "x"), *prior, len(x), _pointer(cost, "cost"))
    return cost


def posterior_now(
    sums: Sums, x: Float[Tensor, "B n"], mean: Prior, precision: Prior, exact: bool
) -> tuple[Float[Tensor, "B n n"], Float[Tensor, " B"]]:
    """From the sums at x: estimation.filter.Normal.posterior, the covariance and the cost."""
    (B, n), x, (*_held, m, p) = x.shape, x.contiguous(), _prior(mean, precision)
    covariance, cost = x.new_empty(B, n, n), x.new_empty(B)
    given = (ctypes.byref(sums.structure), _pointer(x, "x"), ctypes.byref(m), ctypes.byref(p), n, sums.r.shape[-1], int(exact), B)
    _run("torchrod_posterior", B, *given, _pointer(covariance, "covariance"), _pointer(cost, "cost"))
    return covariance, cost


def balance_now(
    x: Float[Tensor, "B n"], q_tip: Float[Tensor, "B 4"] | None, increments: int, tolerance: float, task: CTask, P: int
) -> tuple[Float[Tensor, "B 6"], Float[Tensor, " B"], Float[Tensor, "B P 3"]]:
    """The base wrench (N, N m) in equilibrium with the loads of x, how far the base is from its clamp (rad), the centre line (m).

    mechanics.statics.solve_shape without its damping: what has not settled to the tolerance (rad) must be solved by that.
    """
    B, x = len(x), x.contiguous()
    q_tip = None if q_tip is None else q_tip.contiguous()
    wrench, missed, line = x.new_empty(B, 6), x.new_empty(B), x.new_empty(B, P + 1, 3)
    given = (ctypes.byref(task), _pointer(x, "x"), _pointer(q_tip, "q_tip"), increments, B, tolerance)
    _run("torchrod_balance", B, *given, _pointer(wrench, "wrench"), _pointer(missed, "missed"), _pointer(line, "line"))
    return wrench, missed, line[:, :P]


class Iteration:
    """Iterations of the filter on one chunk, in place: estimation.filter.advance at the normal equations of x.

    state: the fields of estimation.filter.Iterate. filtering: Sigma0 (B, n, n), Q (n), mean and precision of the
    prior, (n) or (B, n). limits: those of estimation.filter.Limits by name. sums: written for the samples that are done.
    """

    def __init__(self, state: dict[str, Tensor], filtering: dict[str, Tensor], limits: dict[str, float | int], sums: Sums):
        prior = {name: filtering[name].contiguous() for name in ("mean", "precision")}
        self._held = (state, filtering, prior, sums)  # the structures hold bare addresses
        self.filter, self.sums = CFilter(), sums.structure
        _fill(self.filter, state | filtering | prior, limits)

    def __call__(self, tables: FitTables, live: Int[Tensor, " b"]) -> None:
        """One iteration of the samples `live`."""
        b, live = len(live), live.contiguous()
        pointers = [ctypes.byref(x) for x in (tables.structure, self.filter, self.sums)]
        _run("torchrod_iterate", b, *pointers, _pointer(live, "live"), b)


def iterate_all(
    rough: tuple[Iteration, FitTables],
    fine: tuple[Iteration, FitTables],
    live: Int[Tensor, " b"],
    near: Bool[Tensor, " B"],
    most: int,
) -> tuple[Bool[Tensor, " B"], Int[Tensor, " B"]]:
    """Iterations of the samples `live`, at most so many each: the rough ones until a sample is near, then the fine ones.

    Returns which have converged, and how many iterations each has had. near changes in place.
    """
    converged, iterations = torch.zeros_like(near), torch.zeros(len(near), dtype=torch.int64)
    course, live = CCourse(), live.contiguous()
    _fill(course, {"near": near, "converged": converged, "iterations": iterations}, {"most": most})
    parts = {"coarse": rough[1].structure, "fine": fine[1].structure, "rough": rough[0].filter, "filter": fine[0].filter}
    for name, structure in (parts | {"out": fine[0].sums}).items():
        setattr(course, name, ctypes.addressof(structure))
    _run("torchrod_filter", len(live), ctypes.byref(course), _pointer(live, "live"), len(live))
    return converged, iterations


def _packed(layer: torch.nn.Linear, into: int) -> Float[Tensor, " m"]:
    """Bias and weights as mlp.h has them, filled up with zeros to `into` inputs and a multiple of OUT outputs."""
    w = torch.cat([layer.bias.detach().unsqueeze(-1), layer.weight.detach()], -1)
    w = torch.nn.functional.pad(w, (0, into + 1 - w.shape[1], 0, -len(w) % OUT))
    return w.unflatten(0, (-1, OUT)).mT.reshape(-1)


class Perceptron:
    """Layers y = GELU(W x + b), in single precision: mlp.h. Each sample's numbers are its own, whatever its batch."""

    def __init__(self, layers: list[torch.nn.Linear]):
        sizes = [layers[0].in_features, *(layer.out_features + -layer.out_features % OUT for layer in layers)]
        parts = [_packed(layer, into) for layer, into in zip(layers, sizes, strict=False)]
        self._held = {"sizes": torch.tensor(sizes), "weights": torch.cat(parts).float()}
        self._structure, self._padded, self.outputs = CPerceptron(), sizes[-1], layers[-1].out_features
        _fill(self._structure, self._held, {"depth": len(layers)})

    def __call__(self, x: Float[Tensor, "B i"]) -> Float[Tensor, "B o"]:
        """The last layer's output, in the precision of the input."""
        given = x.float().contiguous()
        y = given.new_empty(len(x), self._padded)
        addresses = _pointer(given, "features"), _pointer(y, "hidden")
        _run("torchrod_perceptron", len(x), ctypes.byref(self._structure), addresses[0], len(x), addresses[1])
        return y[:, : self.outputs].to(x.dtype)
