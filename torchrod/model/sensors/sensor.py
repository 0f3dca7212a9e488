"""What every sensor supplies, and what it is told of the rod."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...mechanics.lie import Matrix, Vector, cross


@dataclass(frozen=True)
class RodState:
    """The rod as a sensor sees it.

    p (..., P, 3) m and q (..., P, 4) (x, y, z, w): position and orientation of the section at the sensor's arc lengths, in the
    measured frame (after the registration, where that is unknown). base_wrench (..., 6) [N, N m]: what the whole section carries at
    the base, in the robot's base frame. tip_wrench (..., 6) [N, N m]: the unknown dead wrench on the tip in the same frame, zero in
    the entries that are not unknown; tip_q (..., 4): the orientation of the last section there. strains: works out v (..., P, 3)
    (-) and u (..., P, 3) (1/m) of p' = R v, R' = R hat(u), in the section frame; what nobody asks for costs nothing.
    """

    p: Float[Tensor, "... P 3"]
    q: Float[Tensor, "... P 4"]
    base_wrench: Float[Tensor, "... 6"]
    tip_wrench: Float[Tensor, "... 6"]
    tip_q: Float[Tensor, "... 4"]
    strains: Callable[[], tuple[Vector, Vector]]


@runtime_checkable
class Sensor(Protocol):
    """One kind of measurement of B samples, with its noise.

    Rows are numbers of one sample. A row that was not read is NaN in `reading` and has weight 0.
    """

    @property
    def s(self) -> Float[Tensor, " P"]:
        """The arc lengths (m) at which the sensor needs the rod; none for one that needs the base wrench alone."""
        ...

    @property
    def rows(self) -> int:
        """Numbers of one sample."""
        ...

    @property
    def groups(self) -> Int[Tensor, " rows"]:
        """Which rows belong together, numbered from 0 upwards in the order of the rows: an outlier is a whole group."""
        ...

    def predict(self, rod: RodState) -> Float[Tensor, "... rows"]:
        """What the sensor would read, in the units of `reading`. Pointwise in the leading dimensions; any transform may map it."""
        ...

    @property
    def reading(self) -> Float[Tensor, "B rows"]:
        """What it did read; NaN where it did not. For an orientation: zero, because `predict` returns the deviation from it."""
        ...

    @property
    def weights(self) -> Float[Tensor, "B rows"]:
        """1 / variance of every row; 0 where it was not read."""
        ...

    def distances(self, rows: Float[Tensor, "B rows"]) -> Float[Tensor, "B K 3"]:
        """Those of its rows that are positions (m), three for each place; none for a sensor without."""
        ...

    def take(self, index: Int[Tensor, " b"]) -> "Sensor":
        """The samples of an index."""
        ...

    def without(self, groups: Bool[Tensor, "B G"]) -> "Sensor":
        """The same with the rows of these groups not read."""
        ...

    def moved(self, R: Matrix, t: Vector) -> "Sensor":
        """The same readings in the frame p' = R p + t (a rotation matrix, m): for a base frame that has become known."""
        ...

    def check(self) -> None:
        """Raise ValueError, one sentence with the remedy, where shapes or numbers do not belong together."""
        ...


def shape_error(sensor: object, wanted: Mapping[str, tuple[int | None, ...]]) -> str | None:
    """What does not have its shape, in one sentence; None in a shape stands for any number."""
    for name, shape in wanted.items():
        value = getattr(sensor, name)
        found = tuple(value.shape) if isinstance(value, Tensor) else None
        fits = found is None or (len(found) == len(shape) and all(w in (None, n) for w, n in zip(shape, found, strict=True)))
        if not fits:
            return f"{type(sensor).__name__}.{name} has shape {found}; here it must have {str(shape).replace('None', 'any')}"
    return None


def variance(noise: float | Float[Tensor, " B"] | Float[Tensor, "B P"], trailing: int = 1) -> float | Tensor:
    """noise^2 of rows that stand in so many dimensions: a number, (B, 1, ..), or (B, P, ..) where each place has its own."""
    if not isinstance(noise, Tensor):
        return noise**2
    return noise.reshape(*noise.shape, *[1] * (trailing + 1 - noise.ndim)) ** 2


def noise_shape(noise: float | Tensor, B: int, P: int) -> tuple[int, ...]:
    """The shape that a noise must have: one number for each sample, or one for each place of each sample."""
    return (B, P) if isinstance(noise, Tensor) and noise.ndim == 2 else (B,)


def rows_of(sensor: object, index: Int[Tensor, " b"], *names: str) -> dict[str, Tensor]:
    """The samples of an index of those fields that are tensors with a row for each sample."""
    return {name: x[index] for name in names if isinstance(x := getattr(sensor, name), Tensor)}


def as_numbers(sensor: object, *names: str) -> None:
    """Make numbers of those fields that are neither tensors nor None, in place, as a sensor is made."""
    for name in names:
        value = getattr(sensor, name)
        if value is not None and not isinstance(value, Tensor):
            object.__setattr__(sensor, name, float(value))


def normals(a: Float[Tensor, "... 3"]) -> tuple[Vector, Vector]:
    """Two unit vectors normal to unit vectors a and to one another."""
    least = torch.nn.functional.one_hot(a.abs().argmin(-1), 3).to(a.dtype)
    first = cross(a, least)
    first = first / first.norm(dim=-1, keepdim=True)
    return first, cross(a, first)


def check_units(name: str, x: Float[Tensor, "... k"] | None, what: str) -> None:
    """Refuse vectors that are not of length 1; NaN, for those that were not read, passes."""
    if x is not None and bool(((x.norm(dim=-1) - 1).abs() > 1e-3).any()):
        raise ValueError(f"{name} must be {what}; divide each by its norm")


def check_noise(name: str, noise: float | Tensor, unit: str) -> None:
    """Refuse a standard deviation that is none."""
    values = noise.flatten() if isinstance(noise, Tensor) else None
    bad = [noise] if values is None else values[~((values > 0) & torch.isfinite(values))].tolist()
    if (values is None and not 0 < noise < math.inf) or (values is not None and bad):
        raise ValueError(f"{name} is {float(bad[0]):g} {unit}; it must be positive and finite")
