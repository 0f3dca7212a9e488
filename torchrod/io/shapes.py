"""Shapes: what a file of measurements holds, and the sensors that it becomes.

`KINDS` is the one place that knows which columns there are: a kind of measurement is an entry of it, with its columns in a CSV, its
array in an NPZ, its unit, and the sensor that takes it.
"""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum

import torch
from jaxtyping import Float
from torch import Tensor

from ..mechanics.lie import conjugate, exponential, product, rotate, unrotate
from ..model.sensors import BaseWrench, CentreLine, Curvature, Markers, Poses, Sensor
from ..util.precision import DTYPE, Float64

SAME_PLACE = 1e-6  # m: markers of two files that are one


@dataclass(frozen=True)
class Shapes(Float64):
    """What was measured of B named samples, as a file holds it; the noise is not in it, unless it is stated row by row.

    s: (P,) m. positions: (B, P, 3) m, base frame, NaN where missing. samples: their names. offsets: (P, 3) m, from the centre line
    in the section frame. tension: (B, T) N, readings of the load cells. time: (B,) s. readings: everything else by the name of its
    kind, (B, P, k) of places along the rod or (B, k) of the whole robot, NaN where missing: `position_std` (B, P, 1) m, the
    standard deviation of a coordinate of that position; `orientations` (B, P, 4), unit quaternions (x, y, z, w), base frame;
    `curvature` (B, P, 2) 1/m, section frame; `hung_at` (B, 1) m and `hung` (B, 1) kg, a weight that is known to hang there, for
    torchrod calibrate; `base_wrench` (B, 6) N and N m, base frame. `centre_line` (B, M, 3) m, base frame, is of no places: points
    on the rod of unknown arc lengths, in any order; s are then the places between which they are looked for.
    """

    s: Float[Tensor, " P"]
    positions: Float[Tensor, "B P 3"]
    samples: list[str]
    offsets: Float[Tensor, "P 3"] | None = None
    tension: Float[Tensor, "B T"] | None = None
    time: Float[Tensor, " B"] | None = None
    readings: Mapping[str, Float[Tensor, "..."]] = field(default_factory=dict)

    def __post_init__(self):
        super().__post_init__()
        object.__setattr__(self, "readings", {name: torch.as_tensor(v, dtype=DTYPE) for name, v in self.readings.items()})

    def markers(self, noise: float | Float[Tensor, " B"]) -> Markers:
        """The positions as a sensor, with the standard deviation of a coordinate (m), one for all samples or one for each; where
        the file states that of a position, it counts instead.
        """
        stated = self.readings.get("position_std")
        if stated is not None:
            usual = noise.unsqueeze(-1) if isinstance(noise, Tensor) else noise
            noise = torch.where(torch.isfinite(stated[..., 0]), stated[..., 0], usual)
        return Markers(self.s, self.positions, noise, self.offsets)

    def corrected(self, zeta: Float[Tensor, " 6"], markers: Float[Tensor, "n 5"]) -> "Shapes":
        """As they would be measured without errors that are known: of the base frame, [m, rad], and of markers, rows
        [s, x, y, z, std] (m). Errors: ValueError for a marker of which nothing is known, where something is of others.
        """
        R, readings = exponential(zeta[3:]), dict(self.readings)
        p = unrotate(R, self.positions - zeta[:3])
        if len(markers) and "centre_line" not in readings:
            off = (self.s.unsqueeze(-1) - markers[:, 0]).abs()
            if bool((off.amin(-1) > SAME_PLACE).any()):
                s = float(self.s[off.amin(-1) > SAME_PLACE][0])
                raise ValueError(
                    f"the marker at s = {s:g} m was not calibrated; calibrate with it, or leave out markers in [calibration]"
                )
            p = p - markers[off.argmin(-1), 1:4]
        if "centre_line" in readings:
            readings["centre_line"] = unrotate(R, readings["centre_line"] - zeta[:3])
        if "orientations" in readings:
            readings["orientations"] = product(conjugate(R), readings["orientations"])
        return replace(self, positions=p, readings=readings)

    @property
    def stated(self) -> list[Sensor]:
        """The sensors, whatever their noise."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return self.sensors(Noises(1.0, 1.0, (1.0, 1.0), 1.0))

    @property
    def groups(self) -> int:
        """How many groups of rows the sensors have together, as Problem.group_count."""
        return sum(int(sensor.groups.max()) + 1 for sensor in self.stated)

    def measured(self, zeta: Float[Tensor, " 6"], markers: Float[Tensor, "n 5"]) -> "Shapes":
        """The inverse of `corrected` for positions; markers of which nothing is known are measured where they are."""
        p = self.positions
        if len(markers):
            off = (self.s.unsqueeze(-1) - markers[:, 0]).abs()
            known = (off.amin(-1) <= SAME_PLACE).unsqueeze(-1)
            p = p + torch.where(known, markers[off.argmin(-1), 1:4], 0.0)
        return replace(self, positions=rotate(exponential(zeta[3:]), p) + zeta[:3])

    @property
    def points(self) -> Float[Tensor, "B N 3"]:
        """All positions that were measured (m), NaN where missing."""
        line = self.readings.get("centre_line")
        return self.positions if line is None else line

    def sensors(self, noise: "Noises") -> list[Sensor]:
        """Everything that was measured, by the sensors that take it. Errors: ValueError where a noise is needed and not stated."""
        made = [kind.sensor(self, noise) for kind in KINDS if kind.sensor is not None]
        return [sensor for sensor in made if sensor is not None]


@dataclass(frozen=True)
class Noises:
    """Standard deviations of what files do not state row by row: position (m), angle (rad), base force (N) and moment (N m),
    curvature (1/m), the arc length of a marker (m); None takes it as exact.
    """

    position: float
    angle: float
    base: tuple[float, float] | None = None
    curvature: float | None = None
    arc_length: float | None = None


class Of(Enum):
    """What a reading is of: a marker of a sample, a marker in all samples, a whole sample, or a point of a sample, which is at no
    known place.
    """

    MARKER = "marker"
    PLACE = "place"
    SAMPLE = "sample"
    POINT = "point"


@dataclass(frozen=True)
class Kind:
    """One kind of measurement in files.

    name: in Shapes.readings, and the array of an NPZ. columns: of a CSV, in the order of the array's last dimension. of: what it
    belongs to. length: whether it is a length, which the file's unit scales. sensor: what takes it, None where there is nothing to
    take; no function: another kind's sensor does.
    """

    name: str
    columns: tuple[str, ...]
    of: Of
    length: bool = False
    sensor: Callable[[Shapes, Noises], Sensor | None] | None = None


def _turned(shapes: Shapes) -> Tensor:
    """(P,): which places have an orientation in some sample."""
    q = shapes.readings.get("orientations")
    return torch.zeros(len(shapes.s), dtype=torch.bool) if q is None else torch.isfinite(q).all(-1).any(0)


def _at(shapes: Shapes, noise: Noises, places: Tensor) -> Markers:
    """The positions of some of the places."""
    own = shapes.markers(noise.position)
    if bool(places.all()):
        return own
    std = own.noise[:, places] if isinstance(own.noise, Tensor) else own.noise
    return Markers(own.s[places], own.positions[:, places], std, None if own.offsets is None else own.offsets[places])


def _markers(shapes: Shapes, noise: Noises) -> Markers | None:
    """Positions without an orientation; where nothing else was measured, of every place, seen or not."""
    places = ~_turned(shapes)
    if shapes.readings:
        places = places & torch.isfinite(shapes.positions).all(-1).any(0)
    if not bool(places.any()):
        return None
    own, std = _at(shapes, noise, places), noise.arc_length
    return own if std is None else replace(own, s_std=torch.full_like(own.s, std))


def _poses(shapes: Shapes, noise: Noises) -> Poses | None:
    places = _turned(shapes)
    if not bool(places.any()):
        return None
    own = _at(shapes, noise, places)
    q = torch.nn.functional.normalize(shapes.readings["orientations"][:, places], dim=-1)  # a file rounds
    return Poses(own.s, own.positions, q, own.noise, noise.angle, own.offsets)


def _curvature(shapes: Shapes, noise: Noises) -> Curvature | None:
    readings = shapes.readings.get("curvature")
    if readings is None:
        return None
    if noise.curvature is None:
        raise ValueError("the noise of the curvatures is not known; give --curvature-noise (1/m)")
    places = torch.isfinite(readings).all(-1).any(0)
    return Curvature(shapes.s[places], readings[:, places], noise.curvature) if bool(places.any()) else None


def _centre_line(shapes: Shapes, noise: Noises) -> CentreLine | None:
    points = shapes.readings.get("centre_line")
    return None if points is None else CentreLine(shapes.s, points, noise.position)


def _base(shapes: Shapes, noise: Noises) -> BaseWrench | None:
    readings = shapes.readings.get("base_wrench")
    if readings is None:
        return None
    if noise.base is None:
        raise ValueError("the noise of the base wrench is not known; give --base-noise FORCE MOMENT (N, N m)")
    return BaseWrench(readings, *noise.base)


KINDS = (
    Kind("positions", ("x", "y", "z"), Of.MARKER, True, _markers),
    Kind("offsets", ("rx", "ry", "rz"), Of.PLACE, True),
    Kind("position_std", ("sx",), Of.MARKER, True),
    Kind("orientations", ("qx", "qy", "qz", "qw"), Of.MARKER, False, _poses),
    Kind("curvature", ("kx", "ky"), Of.MARKER, False, _curvature),
    Kind("hung_at", ("hung_s",), Of.SAMPLE, True),
    Kind("hung", ("hung_kg",), Of.SAMPLE),
    Kind("centre_line", (), Of.POINT, True, _centre_line),  # columns x, y, z of a file without s
    Kind("base_wrench", ("base_fx", "base_fy", "base_fz", "base_mx", "base_my", "base_mz"), Of.SAMPLE, False, _base),
)
