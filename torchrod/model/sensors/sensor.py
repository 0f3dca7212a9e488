"""What every sensor supplies, and what it is told of the rod."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...mechanics.lie import Matrix, Vector


@dataclass(frozen=True)
class RodState:
    """The rod as a sensor sees it.

    p (..., P, 3) m and q (..., P, 4) (x, y, z, w): position and orientation of the section at the sensor's arc lengths, in the
    measured frame (after the registration, where that is unknown). base_wrench (..., 6) [N, N m]: what the whole section carries at
    the base, in the robot's base frame.
    """

    p: Float[Tensor, "... P 3"]
    q: Float[Tensor, "... P 4"]
    base_wrench: Float[Tensor, "... 6"]


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


def variance(noise: float | Float[Tensor, " B"] | Float[Tensor, "B P"]) -> float | Float[Tensor, "B P"]:
    """noise^2, of all places of a sample or of each."""
    return noise.unsqueeze(-1) ** 2 if isinstance(noise, Tensor) and noise.ndim == 1 else noise**2


def noise_shape(noise: float | Tensor, B: int, P: int) -> tuple[int, ...]:
    """The shape that a noise must have: one number for each sample, or one for each place of each sample."""
    return (B, P) if isinstance(noise, Tensor) and noise.ndim == 2 else (B,)


def check_noise(name: str, noise: float | Tensor, unit: str) -> None:
    """Refuse a standard deviation that is none."""
    values = noise.flatten() if isinstance(noise, Tensor) else None
    bad = [noise] if values is None else values[~((values > 0) & torch.isfinite(values))].tolist()
    if (values is None and not 0 < noise < math.inf) or (values is not None and bad):
        raise ValueError(f"{name} is {float(bad[0]):g} {unit}; it must be positive and finite")
