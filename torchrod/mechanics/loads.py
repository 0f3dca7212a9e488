"""External loads. Every family supplies the integrals of its load in closed form, so that the arc-length step never samples a load.

A load in the section frame enters the statics only through G(s) = int_0^s f, its second integral G2(s) = int_0^s G, and
Gm(s) = int_0^s l of a moment density l. A load that keeps its direction in the base frame enters through what is applied beyond
s: Wn(s) = int_s^L f, Wm(s). A narrow Gaussian, or a point force, is therefore carried exactly by any number of steps.

Shapes: s and `inside` are (..., S, 3), the three stages of S steps; parameters are (..., K) or (..., K, .); integrals are
(..., S, 3, 3). `inside` is a point strictly inside the step that s belongs to: it decides on which side of a jump s lies.
SI units. Source: the paper's (9)-(13); docs/model.md.
"""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..util.precision import Float64
from .lie import Vector

ArcLength = Float[Tensor, "..."]


@dataclass(frozen=True)
class LoadIntegrals:
    """G, G2, Gm (section frame; N, N m, N m) and Wn, Wm (base frame; N, N m); None where a family has no such part."""

    G: Vector | None = None
    G2: Vector | None = None
    Gm: Vector | None = None
    Wn: Vector | None = None
    Wm: Vector | None = None

    def __add__(self, other: "LoadIntegrals") -> "LoadIntegrals":
        def plus(a: Vector | None, b: Vector | None) -> Vector | None:
            return b if a is None else a if b is None else a + b

        return LoadIntegrals(
            plus(self.G, other.G),
            plus(self.G2, other.G2),
            plus(self.Gm, other.Gm),
            plus(self.Wn, other.Wn),
            plus(self.Wm, other.Wm),
        )


@runtime_checkable
class Load(Protocol):
    """What a load family must supply."""

    def integrals(self, s: ArcLength, inside: ArcLength) -> LoadIntegrals:
        """The integrals at s; inside = +inf asks for the whole load, tip included."""
        ...

    def breakpoints(self) -> Float[Tensor, "... K"] | None:
        """Arc lengths (m) at which the integrals jump: they become step boundaries, and may depend on the batch."""
        ...

    def density(self, s: Float[Tensor, " S"]) -> Float[Tensor, "... S 3"] | None:
        """f(s) (N/m), section frame; None for a load that has no density."""
        ...


def total(loads: tuple[Load, ...], s: ArcLength, inside: ArcLength) -> LoadIntegrals:
    """The sum over loads."""
    result = LoadIntegrals()
    for load in loads:
        result = result + load.integrals(s, inside)
    return result


def _check_length(length: float) -> None:
    if not (math.isfinite(length) and length > 0):
        raise ValueError(f"length is {length} m; it must be positive and finite")


def taken(loads: tuple[Load, ...], index: Int[Tensor, " b"]) -> tuple[Load, ...] | None:
    """The loads of the samples of an index; None where a load of the user's own does not say how it is divided (`take`)."""
    parts = [getattr(load, "take", None) for load in loads]
    return None if any(take is None for take in parts) else tuple(take(index) for take in parts if take is not None)


def _rows(x: Tensor, own: int, index: Int[Tensor, " b"]) -> Tensor:
    """The samples of an index of a parameter with `own` dimensions of its own; a parameter of all samples stays as it is."""
    return x if x.ndim <= own or len(x) == 1 else x[index]


def _in_section(f: Float[Tensor, "... xy"]) -> Vector:
    """(f_x, f_y, 0), the paper's loads are normal to the rod (9); of three components what they are."""
    return torch.nn.functional.pad(f, (0, 3 - f.shape[-1]))


def _per_stage(parameter: Tensor, trailing: int) -> Tensor:
    """Insert the two dimensions (steps, stages) before the last `trailing` dimensions of a parameter."""
    return parameter.unsqueeze(-1 - trailing).unsqueeze(-1 - trailing)


@dataclass(frozen=True)
class GaussianLoads(Float64):
    """f(s) = sum_k a_k exp(-c_k (s - mu_k)^2), the paper's (10), with 2 c = 1 / sigma^2.

    a: (..., K, 2), N/m, section frame x and y; or (..., K, 3), with drag along the rod. mu: (..., K), m. c: (..., K), 1/m^2.
    """

    a: Float[Tensor, "... K xy"]
    mu: Float[Tensor, "... K"]
    c: Float[Tensor, "... K"]

    def integrals(self, s: ArcLength, inside: ArcLength) -> LoadIntegrals:
        """int exp(-c x^2) = sqrt(pi / c) / 2 erf(sqrt(c) x), and once more: x erf(x) + exp(-x^2) / sqrt(pi)."""
        root = _per_stage(self.c, 1).sqrt()
        x, x0 = root * (s.unsqueeze(-1) - _per_stage(self.mu, 1)), -root * _per_stage(self.mu, 1)
        area = math.sqrt(math.pi) / 2 / root

        def twice(x: Tensor) -> Tensor:
            return x * torch.erf(x) + torch.exp(-x * x) / math.sqrt(math.pi)

        once = area * (torch.erf(x) - torch.erf(x0))
        again = area / root * (twice(x) - twice(x0) - (x - x0) * torch.erf(x0))
        a = _per_stage(self.a, 2)
        return LoadIntegrals(G=_in_section((a * once.unsqueeze(-1)).sum(-2)), G2=_in_section((a * again.unsqueeze(-1)).sum(-2)))

    def breakpoints(self) -> None:
        """None: a Gaussian has no jump."""

    def take(self, index: Int[Tensor, " b"]) -> "GaussianLoads":
        """The samples of an index."""
        return GaussianLoads(_rows(self.a, 2, index), _rows(self.mu, 1, index), _rows(self.c, 1, index))

    def density(self, s: Float[Tensor, " S"]) -> Float[Tensor, "... S 3"]:
        """f(s), (10)."""
        shape = torch.exp(-self.c.unsqueeze(-2) * (s.unsqueeze(-1) - self.mu.unsqueeze(-2)) ** 2)
        return _in_section((self.a.unsqueeze(-3) * shape.unsqueeze(-1)).sum(-2))

    def net_force(self) -> Float[Tensor, "... K xy"]:
        """The paper's (13): a sqrt(pi / c), N, as if the whole Gaussian lay on the rod."""
        return self.a * (math.pi / self.c).sqrt().unsqueeze(-1)


def on_rod_fraction(mu: Float[Tensor, "... K"], c: Float[Tensor, "... K"], length: float) -> Float[Tensor, "... K"]:
    """The part of each Gaussian that lies in [0, L], which (13) leaves out: (erf(sqrt(c) (L - mu)) + erf(sqrt(c) mu)) / 2."""
    return 0.5 * (torch.erf(c.sqrt() * (length - mu)) + torch.erf(c.sqrt() * mu))


@dataclass(frozen=True)
class PointForces(Float64):
    """Point forces (Dirac loads) in the section frame. force: (..., K, 3), N. s: (..., K), m, on the rod, the tip included."""

    force: Float[Tensor, "... K 3"]
    s: Float[Tensor, "... K"]

    def integrals(self, s: ArcLength, inside: ArcLength) -> LoadIntegrals:
        """G is a step of height F at s_k, G2 a ramp."""
        at = _per_stage(self.s, 1)
        beyond = (inside.unsqueeze(-1) > at.detach()).to(s.dtype)
        force = _per_stage(self.force, 2)
        ramp = beyond * (s.unsqueeze(-1) - at)
        return LoadIntegrals(G=(force * beyond.unsqueeze(-1)).sum(-2), G2=(force * ramp.unsqueeze(-1)).sum(-2))

    def breakpoints(self) -> Float[Tensor, "... K"]:
        """The points of application: step boundaries that move with s_k, so derivatives in s_k are exact."""
        return self.s

    def take(self, index: Int[Tensor, " b"]) -> "PointForces":
        """The samples of an index."""
        return PointForces(_rows(self.force, 2, index), _rows(self.s, 1, index))

    def density(self, s: Float[Tensor, " S"]) -> None:
        """None: a point force has no density."""


@dataclass(frozen=True)
class PointWrenches(Float64):
    """Known forces (N) and moments (N m), (..., K, 3), at s (K,) m.

    frame "local" turns with the section, "base" keeps its direction. Errors: ValueError for another frame.
    """

    force: Float[Tensor, "... K 3"]
    moment: Float[Tensor, "... K 3"]
    s: Float[Tensor, " K"]
    frame: str = "base"

    def __post_init__(self):
        super().__post_init__()
        if self.frame not in ("base", "local"):
            raise ValueError(f'frame is {self.frame!r}; it must be "base" or "local"')

    def integrals(self, s: ArcLength, inside: ArcLength) -> LoadIntegrals:
        """Steps: of what lies before s for a local wrench, of what lies beyond s for one in the base frame."""
        force, moment = _per_stage(self.force, 2), _per_stage(self.moment, 2)
        before = (inside.unsqueeze(-1) > self.s).to(s.dtype).unsqueeze(-1)
        if self.frame == "base":
            return LoadIntegrals(Wn=(force * (1 - before)).sum(-2), Wm=(moment * (1 - before)).sum(-2))
        ramp = before * (s.unsqueeze(-1) - self.s).unsqueeze(-1)
        return LoadIntegrals(G=(force * before).sum(-2), G2=(force * ramp).sum(-2), Gm=(moment * before).sum(-2))

    def breakpoints(self) -> Float[Tensor, " K"]:
        """The points of application."""
        return self.s

    def take(self, index: Int[Tensor, " b"]) -> "PointWrenches":
        """The samples of an index."""
        return PointWrenches(_rows(self.force, 2, index), _rows(self.moment, 2, index), self.s, self.frame)

    def density(self, s: Float[Tensor, " S"]) -> None:
        """None: a point wrench has no density."""


@dataclass(frozen=True)
class FourierLoads(Float64):
    """f(s) = a_0 + sum_k a_k cos(2 pi k s / L) + b_k sin(2 pi k s / L), k = 1..K periods on the rod.

    cosine: (..., 2, K + 1) with a_0 first; sine: (..., 2, K); N/m, section frame x and y. length: L (m). Errors: ValueError for a
    length that is not positive.
    """

    cosine: Float[Tensor, "... 2 K1"]
    sine: Float[Tensor, "... 2 K"]
    length: float

    def __post_init__(self):
        super().__post_init__()
        _check_length(self.length)

    def _waves(self, s: ArcLength) -> tuple[Tensor, Tensor, Tensor]:
        w = 2 * math.pi / self.length * torch.arange(1, self.sine.shape[-1] + 1, dtype=s.dtype)
        return w, torch.sin(w * s.unsqueeze(-1)), torch.cos(w * s.unsqueeze(-1))

    def integrals(self, s: ArcLength, inside: ArcLength) -> LoadIntegrals:
        """Sines and cosines integrate to each other; the constant to s and s^2 / 2."""
        w, sin, cos = self._waves(s)
        x = s.unsqueeze(-1)
        once_c, once_s = torch.cat([x, sin / w], -1), (1 - cos) / w
        again_c, again_s = torch.cat([0.5 * x * x, (1 - cos) / w**2], -1), x / w - sin / w**2
        cosine, sine = _per_stage(self.cosine, 2), _per_stage(self.sine, 2)

        def combine(c: Tensor, b: Tensor) -> Vector:
            return _in_section((cosine * c.unsqueeze(-2)).sum(-1) + (sine * b.unsqueeze(-2)).sum(-1))

        return LoadIntegrals(G=combine(once_c, once_s), G2=combine(again_c, again_s))

    def breakpoints(self) -> None:
        """None: a Fourier load has no jump."""

    def take(self, index: Int[Tensor, " b"]) -> "FourierLoads":
        """The samples of an index."""
        return FourierLoads(_rows(self.cosine, 2, index), _rows(self.sine, 2, index), self.length)

    def density(self, s: Float[Tensor, " S"]) -> Float[Tensor, "... S 3"]:
        """f(s)."""
        _, sin, cos = self._waves(s)
        ones = torch.cat([torch.ones_like(s).unsqueeze(-1), cos], -1)
        f = (self.cosine.unsqueeze(-3) * ones.unsqueeze(-2)).sum(-1) + (self.sine.unsqueeze(-3) * sin.unsqueeze(-2)).sum(-1)
        return _in_section(f)


@dataclass(frozen=True)
class PolynomialLoads(Float64):
    """f(s) = sum_k a_k (s / L)^k, k = 0..K - 1. coefficients: (..., 2, K), N/m, section frame x and y. length: L (m).

    Errors: ValueError for a length that is not positive.
    """

    coefficients: Float[Tensor, "... 2 K"]
    length: float

    def __post_init__(self):
        super().__post_init__()
        _check_length(self.length)

    def _powers(self, s: ArcLength, shift: int) -> Tensor:
        return (s.unsqueeze(-1) / self.length) ** (torch.arange(self.coefficients.shape[-1], dtype=s.dtype) + shift)

    def integrals(self, s: ArcLength, inside: ArcLength) -> LoadIntegrals:
        """(s / L)^k integrates to L (s / L)^(k+1) / (k + 1), and once more."""
        k = torch.arange(self.coefficients.shape[-1], dtype=s.dtype)
        a = _per_stage(self.coefficients, 2)
        once = self.length * self._powers(s, 1) / (k + 1)
        again = self.length**2 * self._powers(s, 2) / ((k + 1) * (k + 2))
        return LoadIntegrals(G=_in_section((a * once.unsqueeze(-2)).sum(-1)), G2=_in_section((a * again.unsqueeze(-2)).sum(-1)))

    def breakpoints(self) -> None:
        """None: a polynomial load has no jump."""

    def take(self, index: Int[Tensor, " b"]) -> "PolynomialLoads":
        """The samples of an index."""
        return PolynomialLoads(_rows(self.coefficients, 2, index), self.length)

    def density(self, s: Float[Tensor, " S"]) -> Float[Tensor, "... S 3"]:
        """f(s)."""
        return _in_section((self.coefficients.unsqueeze(-3) * self._powers(s, 0).unsqueeze(-2)).sum(-1))
