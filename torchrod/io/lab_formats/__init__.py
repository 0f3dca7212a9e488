"""Files of measuring systems: one module for each, from the file to a `Recording`; `convert` makes it shapes by a layout."""

import warnings
from collections.abc import Callable
from pathlib import Path

from ...util.errors import InputError, shown
from ...util.files import reading
from . import aurora, c3d, fbgs, line, luna, motive, qualisys, trc, vicon, wide
from .convert import Imported, convert
from .layout import Layout, read_layout
from .recording import Recording

FORMATS: dict[str, Callable[[Path, bytes, Layout], Recording]] = {
    "motive": motive.read,
    "vicon": vicon.read,
    "qualisys": qualisys.read,
    "trc": trc.read,
    "c3d": c3d.read,
    "aurora": aurora.read,
    "toolbox": aurora.read_toolbox,
    "fbgs": fbgs.read,
    "luna": luna.read,
    "wide": wide.read,
    "line": line.read,
}

TIMED = ("motive", "vicon", "trc", "c3d", "aurora")  # whose files always have times
TABLES = ("wide", "line")  # whose columns have the names that somebody gave them


def read_recording(name: str, path: str | Path, layout: Layout) -> Recording:
    """A file of the measuring system of that name. Errors: InputError naming file and remedy."""
    path = Path(path)
    if name not in FORMATS:
        raise InputError(f"unknown format {shown(name)}; known: {', '.join(FORMATS)}")
    with reading(path):
        if not path.is_file():
            raise InputError(f"{path}: no such file; check the path")
        content = path.read_bytes()
    if not content:
        raise InputError(f"{path}: is empty; export it again")
    found = FORMATS[name](path, content, layout)
    _warn_of_idle(name, path, layout, found)
    return found


def _warn_of_idle(name: str, path: Path, layout: Layout, found: Recording) -> None:
    """Say of every key of the layout that has nothing to act on."""
    here = f"in {path}, a file of format {name}"
    idle = {
        "time": layout.time is not None and name not in TABLES and f"{here}, times need no name",
        "rate": layout.rate is not None and name in TIMED and f"frames {here}, have their own times",
    }
    keys = {"units": layout.units is not None, "up": layout.up != "z", "left_handed": layout.left_handed, "base": bool(layout.base)}
    nowhere = not found.points and found.line is None
    idle |= {key: given and nowhere and f"there are no positions {here}" for key, given in keys.items()}
    for key, why in idle.items():
        if why:
            warnings.warn(f"{layout.path}: {key} has no effect: {why}", stacklevel=3)


__all__ = ["FORMATS", "Imported", "Layout", "Recording", "convert", "read_layout", "read_recording"]
