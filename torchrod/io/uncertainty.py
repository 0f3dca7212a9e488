"""[uncertainty] of ROBOT.toml: how well the robot, and its base frame, are known."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..model.uncertainty import KINDS, Uncertainty
from ..model.unknowns import Registration
from ..util.errors import InputError, shown
from .values import as_number, as_numbers, as_table, in_si, read_toml

FRAME = "frame"
KEYS = {*KINDS, FRAME}


@dataclass(frozen=True)
class NearlyKnown:
    """What a file says of it: standard deviations of the robot's parameters and of its base frame; None where it says nothing."""

    robot: Uncertainty | None = None
    frame: Registration | None = None


def read_uncertainty(path: str | Path) -> NearlyKnown:
    """[uncertainty] of ROBOT.toml. Errors: InputError naming the key."""
    return uncertainty_of(Path(path), read_toml(Path(path)))


def uncertainty_of(path: Path, content: dict[str, Any]) -> NearlyKnown:
    """The same from what a ROBOT.toml says."""
    if "uncertainty" not in content:
        return NearlyKnown()
    where = f"{path}: uncertainty"
    table = as_table(where, in_si(where, content["uncertainty"], {"curvature_length"}, {"gravity"}), KEYS)
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
    return NearlyKnown(stated if values else None, frame)
