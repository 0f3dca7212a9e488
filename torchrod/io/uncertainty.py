"""[uncertainty] and [calibration] of ROBOT.toml: how well the robot, its base frame and its markers are known.

[uncertainty] says what is another in every sample, [uncertainty.shared] what is the same in all samples but not known: what
`torchrod calibrate` seeks. [calibration] is what it has found: values, errors about what the rest of the file says, and their
covariance.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..mechanics.robot import Robot
from ..model.uncertainty import KINDS, MOST_SHARE, RELATIVE, SHIFT, TURN, Found, Uncertainty, every_parameter
from ..model.unknowns import Registration
from ..util.errors import InputError, shown
from ..util.precision import DTYPE
from .values import as_number, as_numbers, as_rows, as_table, in_si, read_toml

FRAME, SHARED = "frame", "shared"
KEYS = {*KINDS, FRAME}
OF_A_SAMPLE = {"curvature", "curvature_length", "metric"}  # another in every sample, and nothing that is calibrated
CALIBRATION_KEYS = {"parameters", "values", "covariance", "noise", "markers"}
LENGTHS, ANGLES = {"curvature_length", "tendon_place"}, {"gravity"}
MOST_VALUE = 100.0  # of an error, in its SI unit: N, m, rad, 1/m
MARKER_ROW = 5  # s, x, y, z, std


@dataclass(frozen=True)
class Calibrated:
    """[calibration]: errors of parameters about what the file says, and what is left unknown of them.

    values: by name, in SI units. found: their covariance. noise: m, of a coordinate, as it was stated or as the residuals show;
    None where it is not said. markers: rows [s, x, y, z, std] (m), by how much the marker at s is measured off, base frame.
    """

    values: dict[str, float]
    found: Found
    noise: float | None = None
    markers: Float[Tensor, "P 5"] = field(default_factory=lambda: torch.zeros(0, MARKER_ROW, dtype=DTYPE))

    @property
    def zeta(self) -> Float[Tensor, " 6"]:
        """The error of the base frame (m, rad)."""
        return torch.tensor([self.values.get(name, 0.0) for name in (*SHIFT, *TURN)], dtype=DTYPE)

    def applied(self, robot: Robot) -> Robot:
        """The robot with its values. Errors: ValueError for one that it has not."""
        known = every_parameter(robot)
        for name, value in self.values.items():
            if name in SHIFT + TURN:
                continue
            if name not in known:
                raise ValueError(f"the robot has no {name}")
            change = known[name].change
            robot = change(robot, value) if value and change is not None else robot
        return robot


@dataclass(frozen=True)
class NearlyKnown:
    """What a file says of it; None where it says nothing.

    own, frame: what is another in every sample. shared, shared_frame: what is not known, but the same in all. calibrated: what a
    calibration has found, and left unknown, which takes the place of what was shared.
    """

    own: Uncertainty | None = None
    frame: Registration | None = None
    shared: Uncertainty | None = None
    shared_frame: Registration | None = None
    calibrated: Calibrated | None = None

    @property
    def of_a_sample(self) -> Uncertainty | None:
        """All that is not known of the robot in one sample."""
        found = None if self.calibrated is None or not self.calibrated.found.names else self.calibrated.found
        shared = self.shared if found is None else None
        if self.own is None and shared is None and found is None:
            return None
        own, shared = self.own or Uncertainty(), shared or Uncertainty()
        both = {k: math.hypot(getattr(own, k), getattr(shared, k)) for k in KINDS if k != "curvature_length"}
        length = own.curvature_length if own.curvature else shared.curvature_length
        return Uncertainty(**both, curvature_length=length, found=found)

    @property
    def frame_of_a_sample(self) -> Registration | None:
        """The same of its base frame, where that was not calibrated."""
        if self.calibrated is not None and any(name in self.calibrated.found.names for name in SHIFT):
            return self.frame
        return _wider(self.frame, self.shared_frame)


def check_parameters(uncertainty: Uncertainty | None, robot: Robot, path: str | Path) -> None:
    """Raise InputError, naming the file, where what it states cannot be of its robot."""
    if uncertainty is None:
        return
    try:
        uncertainty.parameters(robot)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def _wider(a: Registration | None, b: Registration | None) -> Registration | None:
    if a is None or b is None:
        return a or b
    shift, turn = (math.hypot(getattr(a, k) or 0.0, getattr(b, k) or 0.0) for k in ("shift_std", "turn_std"))
    return Registration(shift, turn)


def read_uncertainty(path: str | Path) -> NearlyKnown:
    """[uncertainty] and [calibration] of ROBOT.toml. Errors: InputError naming the key."""
    return uncertainty_of(Path(path), read_toml(Path(path)))


def uncertainty_of(path: Path, content: dict[str, Any]) -> NearlyKnown:
    """The same from what a ROBOT.toml says."""
    calibrated = calibrated_of(path, content)
    if "uncertainty" not in content:
        return NearlyKnown(calibrated=calibrated)
    where = f"{path}: uncertainty"
    table = as_table(where, in_si(where, content["uncertainty"], LENGTHS, ANGLES), KEYS | {SHARED})
    own = _stated(where, {key: value for key, value in table.items() if key != SHARED})
    shared = _stated(f"{where}.{SHARED}", table[SHARED], KEYS - OF_A_SAMPLE) if SHARED in table else (None, None)
    nearly = NearlyKnown(*own, *shared, calibrated)
    try:
        _ = nearly.of_a_sample
    except ValueError as error:
        raise InputError(f"{where}: together with {SHARED}, {str(error).removeprefix('Uncertainty.')}") from None
    return nearly


def _stated(where: str, content: object, known: set[str] = KEYS) -> tuple[Uncertainty | None, Registration | None]:
    table = as_table(where, in_si(where, content, LENGTHS, ANGLES), known)
    values: dict[str, Any] = {name: as_number(f"{where}.{name}", value) for name, value in table.items() if name != FRAME}
    try:
        stated = Uncertainty(**values)
    except ValueError as error:
        raise InputError(f"{where}: {str(error).removeprefix('Uncertainty.')}") from None
    frame = None
    if FRAME in table:
        shift, turn = as_numbers(f"{where}.{FRAME}", table[FRAME], 2)
        if not (shift > 0 and 0 < turn < 1):
            raise InputError(f"{where}.{FRAME} is {shown(table[FRAME])}; it must be [m, rad], both positive: 3 degrees are 0.052")
        frame = Registration(shift, turn)
    return (stated if values else None), frame


def calibrated_of(path: Path, content: dict[str, Any]) -> Calibrated | None:
    """[calibration] of what a ROBOT.toml says; None where it has none. Errors: InputError naming the key."""
    if "calibration" not in content:
        return None
    where = f"{path}: calibration"
    table = as_table(where, content["calibration"], CALIBRATION_KEYS)
    names = table.get("parameters", [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{where}.parameters is {shown(names)}; it must be a list of names, as torchrod calibrate writes them")
    values = as_numbers(f"{where}.values", table.get("values", []), len(names))
    rows = table.get("covariance", [])
    if not isinstance(rows, list) or len(rows) != len(names):
        raise InputError(f"{where}.covariance must have {len(names)} rows, one for each of parameters")
    covariance = [as_numbers(f"{where}.covariance[{i}]", row, len(names)) for i, row in enumerate(rows)]
    try:
        found = Found(tuple(names), torch.tensor(covariance, dtype=DTYPE).reshape(len(names), len(names)))
    except ValueError as error:
        raise InputError(f"{where}: {str(error).replace('Found.', '')}; calibrate again") from None
    for name, value in zip(names, values, strict=True):
        if name in TURN and abs(value) > math.pi:
            raise InputError(f"{where}.values: {name} is {value:g} rad; it must be from -pi to pi")
        if abs(value) > MOST_VALUE:
            raise InputError(f"{where}.values: {name} is {value:g}; torchrod calibrate writes nothing like it, calibrate again")
    for name, variance in zip(names, found.covariance.diagonal().tolist(), strict=True):
        if name.split("_")[0] in RELATIVE and "offset" not in name and variance > MOST_SHARE**2:
            raise InputError(f"{where}.covariance: {name} has a standard deviation above {MOST_SHARE:.0%}; calibrate again")
    noise = as_number(f"{where}.noise", table["noise"], positive=True) if "noise" in table else None
    if noise is not None and not 1e-9 <= noise <= 1:
        raise InputError(f"{where}.noise is {noise:g} m; it must be from 1e-9 to 1")
    markers = as_rows(f"{where}.markers", table["markers"], MARKER_ROW) if table.get("markers") else []
    rows = torch.tensor(markers, dtype=DTYPE).reshape(-1, MARKER_ROW)
    if bool((rows[:, 4] < 0).any()):
        raise InputError(f"{where}.markers: the last number of a row is a standard deviation (m), at least 0")
    return Calibrated(dict(zip(names, values, strict=True)), found, noise, rows)


def calibration_text(calibrated: Calibrated) -> str:
    """[calibration] as TOML."""

    def numbers(values: list[float]) -> str:
        return "[" + ", ".join(f"{value:.10g}" for value in values) + "]"

    names = calibrated.found.names
    lines = [
        "[calibration]  # by torchrod calibrate: errors about what is said above, in SI units, and their covariance",
        f"parameters = [{', '.join(f'{name!r}'.replace(chr(39), chr(34)) for name in names)}]",
        f"values = {numbers([calibrated.values[name] for name in names])}",
        "covariance = [",
        *(f"  {numbers(row)}," for row in calibrated.found.covariance.tolist()),
        "]",
    ]
    if calibrated.noise is not None:
        lines.append(f"noise = {calibrated.noise:.6g}  # m, of a marker's coordinate: as stated, or as the residuals show")
    if len(calibrated.markers):
        lines += ["markers = [  # s, by how much the marker there is measured off (x, y, z), standard deviation; m"]
        lines += [*(f"  {numbers(row)}," for row in calibrated.markers.tolist()), "]"]
    return "\n".join(lines) + "\n"
