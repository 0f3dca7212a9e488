"""Checks of arguments that several commands share. Each refusal is one sentence with the remedy."""

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

from jsonargparse import Namespace

from ..util.errors import InputError
from ..util.files import writing

if TYPE_CHECKING:  # torchrod --help imports no torch
    from ..io import Calibrated, Shapes

FIGURE_SUFFIXES = (".png", ".pdf", ".svg")
INPUTS = ("robot", "shapes", "result", "spec", "warm_start", "file", "layout", "tensions")  # options that name files to be read,
OUTPUTS = ("out", "plot", "json", "csv")  # and those that name files to be written
NOISE = 1e-3  # m, of a marker's coordinate, where nothing better is known
MOST_STEPS = 100_000  # along a rod
COARSEST = 0.25  # of the length: with more noise no shape shows


def as_calibrated(path: str, shapes: "Shapes", calibrated: "Calibrated | None") -> "Shapes":
    """Shapes in the base frame that was calibrated, and less what its markers are off. Errors: InputError."""
    if calibrated is None:
        return shapes
    try:
        return shapes.corrected(calibrated.zeta, calibrated.markers)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def positive(name: str, value: float) -> None:
    """Refuse what is not a positive number."""
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"{name} is {value}; it must be a positive number")


def _same_file(one: str, other: str) -> bool:
    """Whether two names lead to one file: through links, hard ones too, and before there is a file."""
    try:
        return Path(one).samefile(other)
    except (OSError, ValueError):
        return os.path.realpath(one) == os.path.realpath(other)


def apart(options: Namespace) -> None:
    """Refuse an output that would replace an input, or another output. Errors: InputError."""
    given = {name: options.get(name) for name in (*INPUTS, *OUTPUTS)}
    paths = [(name, value) for name, value in given.items() if isinstance(value, str) and "\0" not in value]
    if ("warm_start", given["warm_start"]) in paths:
        paths.insert(0, ("warm_start", str(Path(str(given["warm_start"])).with_suffix(".json"))))  # its card
    for i, (name, path) in enumerate(paths):
        for earlier, other in paths[:i] if name in OUTPUTS else ():
            if _same_file(path, other) and not _device(path):
                what = f"--{earlier} is to be written there" if earlier in OUTPUTS else "it is what is read"
                raise InputError(f"--{name} {path}: {what}, and would be lost; give another name")


def _device(path: str) -> bool:
    """Something that is there and takes more than one output, as /dev/null does."""
    try:
        return Path(path).exists() and not Path(path).is_file() and not Path(path).is_dir()
    except OSError:
        return False


def writable(path: str | None, suffixes: tuple[str, ...]) -> None:
    """Refuse before the work, not after it."""
    if path is None:
        return
    if Path(path).suffix not in suffixes:
        raise InputError(f"{path}: cannot write this kind of file; let its name end in {' or '.join(suffixes)}")
    with writing(path):
        if not Path(os.path.realpath(path)).parent.is_dir():
            raise InputError(f"{path}: its folder does not exist; create it first")
        if Path(path).is_dir():
            raise InputError(f"{path}: is a folder; give a file name")


def noise_or_auto(value: str, length: float) -> float | None:
    """A standard deviation of the markers (m) on a rod of this length (m); None for auto."""
    if value == "auto":
        return None
    try:
        number = float(value)
    except ValueError:
        raise InputError(f"--noise is {value}; it must be auto or a standard deviation in metres") from None
    noise_std(number)
    in_metres("--noise", number, length)
    return number


def in_metres(name: str, value: float, length: float) -> None:
    """Refuse a standard deviation (m) that is large beside the rod's length (m): it is in another unit."""
    if value > COARSEST * length:
        raise InputError(f"{name} is {value:g} m on a rod of {length:g} m; it is in metres: 1 mm is 1e-3")


def noise_std(value: float) -> None:
    """Refuse a standard deviation of the markers that no tracker has."""
    if not 1e-9 <= value <= 1:
        raise InputError(f"--noise is {value}; it must be a standard deviation in metres, from 1e-9 to 1")
