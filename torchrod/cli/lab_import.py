"""torchrod import: a file of a measuring system to shapes."""

import warnings
from dataclasses import replace
from pathlib import Path

import torch
from jsonargparse import Namespace

from ..io import read_base_pose, read_robot, write_shapes
from ..io.lab_formats import Imported, convert, read_layout, read_recording
from ..io.shape_file import with_tensions
from ..util.errors import InputError
from .arguments import writable

FAR, FAR_FROM_BASE = 1.1, 0.05  # times the arc length, and of the longest one, that noise and stretch account for


def lab_import(options: Namespace) -> None:
    """torchrod import."""
    writable(options.out, (".csv", ".npz"))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*nothing hangs")  # of no import's concern
        robot = read_robot(options.robot)
    layout = read_layout(options.layout)
    recording = read_recording(options.format, options.file, layout)
    try:
        found = convert(Path(options.file), recording, layout, robot, read_base_pose(options.robot))
    except InputError:  # names its own file
        raise
    except ValueError as error:
        raise InputError(f"{options.file}: {error}") from None
    if not len(found.shapes.samples):
        raise InputError(f"{options.file}: holds no frames; export it again")
    _warn_of_distance(options.file, found)
    if options.tensions is not None:
        found = replace(found, shapes=with_tensions(Path(options.file), found.shapes, robot, options.tensions))
    write_shapes(options.out, found.shapes)
    print(_report(options.out, found))  # noqa: T201


def _warn_of_distance(file: str, found: Imported) -> None:
    """No place of a rod is farther from its base than the rod is long up to there: such positions are not in the base frame."""
    shapes = found.shapes
    if not len(shapes.s):  # of a centre line: read_shapes looks at it
        return
    reach = shapes.s if shapes.offsets is None else shapes.s + shapes.offsets.norm(dim=-1)
    far = shapes.positions.norm(dim=-1) > FAR * reach + FAR_FROM_BASE * float(shapes.s.max())
    if 2 * int(far.sum()) > int(torch.isfinite(shapes.positions).all(-1).sum()):
        remedy = "state the base frame, [base] in the layout or in ROBOT.toml, and check units and arc lengths"
        said = f"{file}: {int(far.sum())} of {far.numel()} places are farther from the base than the rod reaches; {remedy}"
        warnings.warn(said, stacklevel=2)


def _report(out: str, found: Imported) -> str:
    shapes = found.shapes
    read = torch.isfinite(shapes.points).all(-1)
    for values in shapes.readings.values():
        read = read | torch.isfinite(values).all(-1)
    gone = f", {int((~read).sum())} of {read.numel()} readings missing" if bool((~read).any()) else ""
    places = f"{len(shapes.s)} places along the rod" if len(shapes.s) else f"up to {read.shape[1]} points on the rod"
    lines = [f"{out}: {len(shapes.samples)} samples of {places}{gone}"]
    if found.rms is not None:
        lines.append(f"markers of the base plate: {1e3 * found.rms:.3g} mm from their places")
    if found.pose is not None:
        position, rotation = ([round(v, 9) for v in value.tolist()] for value in (found.pose.position, found.pose.rotation))
        lines.append(f"the base in the file's world, for ROBOT.toml: [base] position = {position}, rotation = {rotation}")
    return "\n".join(lines)
