"""OBSERVABILITY.json and .csv: what torchrod observability found (docs/files.md)."""

import csv
import io
from pathlib import Path

from torch import Tensor

from ..analysis.marker_placement import Placement
from ..analysis.observability import FALSE_ALARM, LOCALIZED, POWER, Observability
from ..util.files import put_text
from .json_file import plain, put_json


def _columns(seen: Observability) -> dict[str, Tensor]:
    """One entry per place; the worst direction, and the mean over directions where the name says so."""
    return {
        "location_m": seen.location,
        "detectable_N": seen.detectable.amax(-1),
        "localizable_N": seen.localizable.amax(-1),
        "magnitude_std_N": seen.magnitude_std.amax(-1),
        "magnitude_std_mean_N": seen.magnitude_std.mean(-1),
        "location_std_m": seen.location_std.amax(-1),
        "location_std_mean_m": seen.location_std.mean(-1),
    }


def write_observability_table(path: str | Path, seen: Observability) -> None:
    """One row per place as CSV; `inf` where markers do not show it, `nan` where there is no equilibrium. Errors: InputError."""
    columns = _columns(seen)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))
    put_text(path, text.getvalue())


def write_observability(
    path: str | Path,
    seen: Observability,
    markers: list[float],
    robot: str,
    noise: float,
    tension: list[float],
    registration: bool,
    placed: Placement | None,
) -> None:
    """The whole result as JSON. markers: m; noise: m; tension: N. Errors: InputError where the file cannot be written."""
    columns = {name: values.tolist() for name, values in _columns(seen).items()}
    content = {
        "robot": robot,
        "markers_m": markers,
        "noise_m": noise,
        "force_N": seen.force,
        "tension_N": tension,
        "registration": registration,
        "directions": len(seen.direction),
        "false_alarm": FALSE_ALARM,
        "power": POWER,
        "localized_share": LOCALIZED,
        "places": [
            {name: plain(value) for name, value in zip(columns, row, strict=True)} for row in zip(*columns.values(), strict=True)
        ],
        "placement": None
        if placed is None
        else {
            "from_m": placed.nearest,
            "even_m": placed.even.tolist(),
            "proposed_m": placed.s.tolist(),
            "worst_location_std_even_m": plain(placed.worst_even),
            "worst_location_std_m": plain(placed.worst),
        },
    }
    put_json(path, content)
