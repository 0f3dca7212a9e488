"""Files of measuring systems: one module for each, from the file to a `Recording`; `convert` makes it shapes by a layout."""

from collections.abc import Callable
from pathlib import Path

from ...util.errors import InputError, shown
from ...util.files import reading
from . import aurora, c3d, fbgs, luna, motive, qualisys, trc, vicon, wide
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
}


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
    return FORMATS[name](path, content, layout)


__all__ = ["FORMATS", "Imported", "Layout", "Recording", "convert", "read_layout", "read_recording"]
