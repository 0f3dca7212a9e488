"""A calibrated ROBOT.toml: the text of the old one with only the calibrated values changed; comments and order are kept.

The text is edited line by line, for robots written as [rod], [[rod.sections]] and [[tendons]] tables with one key per line.
Whatever else TOML allows is recognized afterwards: the new text is read back by `robot_of` and compared, so that a file that says
something else is never written.
"""

import re
import tomllib
import warnings
from dataclasses import fields
from pathlib import Path

import torch

from ..mechanics.robot import Robot
from ..util.errors import InputError
from ..util.files import put_text, reading
from .robot_file import robot_of
from .uncertainty import Calibrated, calibration_text

HEADER = re.compile(r"^[ \t]*\[{1,2}[ \t]*([\w.-]+)[ \t]*\]{1,2}[ \t]*(?:#.*)?$")
NUMBER = re.compile(r"(?<![\w.+-])[+-]?\d[\d_]*(?:\.\d[\d_]*)?(?:[eE][+-]?\d[\d_]*)?(?![\w.])")
STIFFNESS_KEYS = ("youngs_modulus", "shear_modulus", "K_se", "K_bt")
DIGITS = 10  # written of a value: far below what any calibration knows
SAME = 1e-8  # relative: the values read back are the calibrated ones


def _plain(value: float) -> str:
    return f"{value:.{DIGITS}g}"


def _sections(lines: list[str], name: str) -> list[range]:
    """Line numbers of the bodies of every table of this name."""
    headers = [(i, match[1]) for i, line in enumerate(lines) if (match := HEADER.match(line.rstrip("\r\n")))]
    ends = [i for i, _ in headers[1:]] + [len(lines)]
    return [range(i + 1, end) for (i, found), end in zip(headers, ends, strict=False) if found == name]


def _key_lines(lines: list[str], section: range, key: str) -> range:
    """The lines of a key and its value, which goes on until its brackets are closed; empty where the table has no such key."""
    for first in section:
        if re.match(rf"^[ \t]*{key}[ \t]*=", lines[first]):
            depth = 0
            for last in range(first, section.stop):
                code = lines[last].split("#")[0]
                depth += code.count("[") - code.count("]")
                if depth <= 0:
                    return range(first, last + 1)
    return range(section.stop, section.stop)


def _with_numbers(lines: list[str], where: range, change) -> None:
    """Every number of a value replaced, comments untouched."""
    for i in where:
        code, hash_, comment = lines[i].partition("#")
        head, equals, value = code.partition("=") if i == where.start else ("", "", code)
        lines[i] = (
            head + equals + NUMBER.sub(lambda match: _plain(change(float(match[0].replace("_", "")))), value) + hash_ + comment
        )


def _put(lines: list[str], section: range, key: str, value: float) -> None:
    """Change a number, or add the key after the last line of the table that says something."""
    found = _key_lines(lines, section, key)
    if found:
        _with_numbers(lines, found, lambda _: value)
        return
    said = [i for i in section if lines[i].split("#")[0].strip()] or [section.start - 1]
    end = "\r\n" if lines[said[0]].endswith("\r\n") else "\n"
    if not lines[said[-1]].endswith("\n"):
        lines[said[-1]] += end
    indent = re.match(r"[ \t]*", lines[said[0]])
    lines.insert(said[-1] + 1, f"{indent[0] if indent else ''}{key} = {_plain(value)}{end}")


def calibrated_text(
    text: str, mass_per_length: float, stiffness_factor: float, offsets: tuple[float, ...] | None, mass_factor: float | None = None
) -> str:
    """ROBOT.toml's text with the mass per length (kg/m), its stiffnesses times a factor, and tension offsets (N) where given.

    mass_factor: instead of a mass per length, by what those of [rod] and of its sections are multiplied.
    """
    lines = text.splitlines(keepends=True)
    # From the end of the file to its start, so that the line numbers ahead of an added line stay true.
    rods = _sections(lines, "rod")
    edits = [(section, None) for section in rods + _sections(lines, "rod.sections")]
    if offsets is not None:
        edits += list(zip(_sections(lines, "tendons"), offsets, strict=False))
    for section, offset in sorted(edits, key=lambda edit: -edit[0].start):
        if offset is not None:
            _put(lines, section, "tension_offset", offset)
            continue
        if stiffness_factor != 1:
            for key in STIFFNESS_KEYS:
                _with_numbers(lines, _key_lines(lines, section, key), lambda value: stiffness_factor * value)
        if mass_factor is not None:
            _with_numbers(lines, _key_lines(lines, section, "mass_per_length"), lambda value: mass_factor * value)
        elif section in rods:
            _put(lines, section, "mass_per_length", mass_per_length)
    return "".join(lines)


def _with_table(text: str, table: str) -> str:
    """The text with [calibration] at its end, and without the one that it had."""
    lines = text.splitlines(keepends=True)
    for section in reversed(_sections(lines, "calibration")):
        del lines[section.start - 1 : section.stop]
    kept = "".join(lines).rstrip()
    end = "\r\n" if "\r\n" in kept else "\n"
    return kept + 2 * end + table.replace("\n", end)


def _same(a: Robot, b: Robot) -> bool:
    """Whether two robots are the same to SAME."""

    def close(x: torch.Tensor, y: torch.Tensor) -> bool:
        return x.shape == y.shape and torch.allclose(x, y, rtol=SAME, atol=SAME * float(y.abs().max()) if y.numel() else 0)

    rods = [
        (getattr(a.rod, key), getattr(b.rod, key)) for key in ("K_se", "K_bt", "mass_per_length", "reference_curvature", "masses")
    ]
    if (a.rod.pieces is None) != (b.rod.pieces is None):
        return False
    if a.rod.pieces is not None and b.rod.pieces is not None:
        rods += [(getattr(a.rod.pieces, f.name), getattr(b.rod.pieces, f.name)) for f in fields(a.rod.pieces)]
    tendons = len(a.tendons) == len(b.tendons) and all(
        (t.ends_at, t.discs) == (u.ends_at, u.discs)
        and close(torch.tensor(t.routing), torch.tensor(u.routing))
        and abs(t.friction * t.motion - u.friction * u.motion) <= SAME
        and abs(t.tension_gain - u.tension_gain) <= SAME
        and abs(t.tension_offset - u.tension_offset) <= SAME * abs(t.tension_offset) + 1e-300
        for t, u in zip(a.tendons.tendons, b.tendons.tendons, strict=True)
    )
    return a.rod.length == b.rod.length and tendons and all(close(x, y) for x, y in [*rods, (a.gravity, b.gravity)])


def write_calibrated(
    path: str | Path,
    source: str | Path,
    robot: Robot,
    stiffness_factor: float = 1.0,
    tension_offset: bool = False,
    calibrated: Calibrated | None = None,
) -> None:
    """Write `source` with the calibrated values of `robot`, as a whole or not at all, once it reads back as that robot.

    calibrated: [calibration], which takes the place of one that is there: what of `robot` has no place of its own in the text.
    Errors: InputError where the text cannot be edited (the file stays as it was) or the file cannot be written.
    """
    # Bytes, because reading as text would turn the line ends of another system into this one's.
    with reading(source):
        text = Path(source).read_bytes().decode("utf-8")
    offsets = tuple(t.tension_offset for t in robot.tendons.tendons) if tension_offset else None
    mass = float(robot.rod.mass_per_length)
    before = float(_read(text).rod.mass_per_length) if robot.rod.pieces is not None else 0.0
    text = calibrated_text(text, mass, stiffness_factor, offsets, mass / before if before else None)
    if calibrated is not None:
        text = _with_table(text, calibration_text(calibrated))
    if not _reads_as(text, robot):
        tables = "[rod], [[rod.sections]] and [[tendons]]"
        raise InputError(f"{path}: not written; {source} must be plain tables, {tables} with one key = value per line")
    put_text(path, text)


def _read(text: str) -> Robot:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the source has raised them already
        return robot_of(Path(), tomllib.loads(text))


def _reads_as(text: str, robot: Robot) -> bool:
    try:
        return _same(robot, _read(text))
    except ValueError:  # not TOML, or not a robot (InputError)
        return False
