"""From a recording and its layout to shapes in the robot's base frame."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...mechanics.grid import on_rod
from ...mechanics.lie import Matrix, product
from ...mechanics.robot import Robot
from ...model.marker_geometry import against_chords, misturned
from ...util.errors import InputError, shown
from ...util.precision import DTYPE
from ...util.units import metres_per
from ..base_pose import BasePose
from ..shapes import Shapes
from .labels import labelled, rod_of
from .layout import Gratings, Layout, Places
from .plate import Base, base_in, check_side, named
from .recording import Recording

ON_PLATE = 5e-3  # of the rod's length: so near a marker of the plate a point is that marker
TOLD = 0.02  # of the markers in frames that have enough points: of something else that is no rod at all so many are labelled
# Rotations of the file's world that make its axis `up` the z axis.
UPRIGHT = {
    "z": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    "y": [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
    "x": [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]],
}


@dataclass(frozen=True)
class Imported:
    """shapes: what was recorded, in the base frame. pose: of the base in the file's world (metres, z up), where it is one for all
    frames. rms: distance (m) of the base plate's markers from their places.
    """

    shapes: Shapes
    pose: BasePose | None
    rms: float | None


def convert(path: Path, found: Recording, layout: Layout, robot: Robot, base: BasePose | None) -> Imported:
    """Shapes of a recording; base: the pose in the lab that ROBOT.toml states, for a layout that says nothing of the base.

    Errors: InputError naming file and remedy.
    """
    frames = found.frames
    if not frames:
        raise InputError(f"{path}: holds nothing that the layout asks for; {named(found)}")
    raw, found = found, _in_metres(path, found, layout)
    frame, pose = Base(torch.eye(3, dtype=DTYPE)[None], torch.zeros(1, 3, dtype=DTYPE)), base
    if layout.base is not None:
        frame = base_in(path, layout, layout.base, found)
        pose = None if len(frame.R) > 1 else BasePose(frame.t[0], _quaternion(frame.R)[0])
    elif base is not None:
        import roma

        frame = Base(roma.unitquat_to_rotmat(base.rotation)[None], base.position[None])
    shapes = [part for part in (_markers(path, found, layout, robot, frame), _bodies(path, found, layout, frame)) if part]
    if layout.bodies is not None:
        _check_rotations(path, raw, layout, frame)
    if layout.gratings is not None:
        shapes.append(_gratings(path, found, layout, layout.gratings))
    if (found.line is not None) != layout.centre_line:
        raise InputError(f"{path}: a file of format line and [centre_line] of {layout.path} belong together; change one of them")
    joined = _line(found.line, frame) if found.line is not None else _joined(shapes, frames)
    if not bool(on_rod(joined.s, L := robot.rod.length).all()):
        raise InputError(
            f"{layout.path}: s = {float(joined.s.max()):g} m lies outside the rod of 0 to {L:g} m; give s_mm or metres"
        )
    if (layout.markers is not None or layout.centre_line) and layout.base is not None and layout.base.at is not None:
        check_side(path, layout, joined.points, L)
    time = None if found.time is None or not np.isfinite(found.time).all() else torch.from_numpy(found.time.copy())
    return Imported(replace(joined, samples=[str(k) for k in range(frames)], time=time), pose, frame.rms)


def _in_metres(path: Path, found: Recording, layout: Layout) -> Recording:
    """Points in metres, right-handed, in a world whose z axis points up; rotations with them."""
    if not found.points and found.line is None:
        return found
    units = layout.units or found.units
    if units is None:
        raise InputError(f'{path}: does not say its unit of length; add units = "mm" (or m, cm) to {layout.path}')
    scale = metres_per(f"{path}: units", units)
    if found.units is not None and layout.units is not None and metres_per(f"{path}: units", found.units) != scale:
        warnings.warn(f"{path}: says {found.units}, but {layout.path} says {layout.units}, which is taken", stacklevel=3)
    up = np.array(UPRIGHT[layout.up])
    mirror = np.diag([1.0, 1.0, -1.0]) if layout.left_handed else np.eye(3)
    points = {name: scale * p @ (up @ mirror).T for name, p in found.points.items()}
    turn = _quaternion(torch.from_numpy(up)[None])[0]
    rotations = {}
    for name, q in found.rotations.items():
        own = torch.from_numpy(q * ([-1.0, -1.0, 1.0, 1.0] if layout.left_handed else [1.0] * 4))  # M R M, M = diag(1, 1, -1)
        rotations[name] = product(turn.expand_as(own), own).numpy()
    line = None if found.line is None else scale * found.line @ (up @ mirror).T
    return replace(found, points=points, rotations=rotations, units="m", line=line)


def _quaternion(R: Matrix) -> Float[Tensor, "F 4"]:
    import roma

    lost = R.isnan().flatten(1).any(-1)
    q = roma.rotmat_to_unitquat(torch.where(lost[:, None, None], torch.eye(3, dtype=R.dtype), R))
    return torch.where(lost[:, None], torch.nan, q)


def _into_base(p: Float[Tensor, "F N 3"], base: Base) -> Float[Tensor, "F N 3"]:
    """R^T (p - t)."""
    return ((p - base.t.unsqueeze(-2)).unsqueeze(-2) @ base.R.unsqueeze(-3)).squeeze(-2)


def _points(path: Path, found: Recording, layout: Layout, what: str, names: list[str]) -> Float[Tensor, "F N 3"]:
    if missing := [name for name in names if name not in found.points]:
        raise InputError(f"{layout.path}: {what}.names has {shown(missing[0])}, which is not in {path}; {named(found)}")
    return torch.from_numpy(np.stack([found.points[name] for name in names], 1))


def _markers(path: Path, found: Recording, layout: Layout, robot: Robot, base: Base) -> Shapes | None:
    places = layout.markers
    if places is None:
        return None
    offsets = None if places.offsets is None else places.offsets.numpy()
    if places.names is not None:
        p = _into_base(_points(path, found, layout, "markers", places.names), base)
    else:
        others = [*base.names, *(layout.bodies.names or [] if layout.bodies else [])]
        names = [name for name in found.points if name not in others]
        if not names:
            raise InputError(f"{path}: holds no points beside the base plate's; check the export, or the layout")
        seen = _points(path, found, layout, "markers", names)
        if base.plate is not None:
            on_plate = (seen.unsqueeze(-2) - base.plate).norm(dim=-1).amin(-1) < ON_PLATE * robot.rod.length
            seen = torch.where(on_plate.unsqueeze(-1), torch.nan, seen)
        every = _into_base(seen, base).numpy()
        p = torch.from_numpy(labelled(rod_of(robot, places.s.numpy(), offsets), every))
        told = np.isfinite(p[..., 0].numpy())
        enough = 2 * np.isfinite(every).all(-1).sum(-1) >= len(places.s)
        if not enough.any() or told[enough].mean() < TOLD:
            raise InputError(
                f"{path}: in hardly any of its {len(p)} frames do points lie as markers on a rod would at the s of {layout.path}; "
                "check s, units, up, left_handed and the base frame"
            )
        gone = int((~told).sum())
        if gone:
            warnings.warn(
                f"{path}: {gone} of {p[..., 0].numel()} markers are missing: no point could be told to be theirs", stacklevel=3
            )
    return Shapes(places.s, p, [""] * len(p), places.offsets)


def _line(points: Float[np.ndarray, "F M 3"], base: Base) -> Shapes:
    p = _into_base(torch.from_numpy(points), base)
    return Shapes(p.new_zeros(0), p.new_zeros(len(p), 0, 3), [""] * len(p), readings={"centre_line": p})


def _bodies(path: Path, found: Recording, layout: Layout, base: Base) -> Shapes | None:
    places: Places | None = layout.bodies
    if places is None:
        return None
    assert places.names is not None
    p = _into_base(_points(path, found, layout, "bodies", places.names), base)
    if missing := [name for name in places.names if name not in found.rotations]:
        raise InputError(
            f"{layout.path}: bodies.names has {shown(missing[0])}, which has no rotation in {path}; list it in [markers]"
        )
    q = torch.from_numpy(np.stack([found.rotations[name] for name in places.names], 1))
    back = _quaternion(base.R)[:, None] * torch.tensor([-1.0, -1.0, -1.0, 1.0], dtype=DTYPE)
    q = product(back.expand_as(q), q)
    if places.mounting is not None:
        q = product(q, (places.mounting * torch.tensor([-1.0, -1.0, -1.0, 1.0], dtype=DTYPE)).expand_as(q))
    return Shapes(places.s, p, [""] * len(p), places.offsets, readings={"orientations": q})


def _check_rotations(path: Path, raw: Recording, layout: Layout, base: Base) -> None:
    """Say so where the rotations in the file, read in another way, would go with the positions."""

    def against(change: Callable[[Tensor], Tensor]) -> float:
        rotations = {name: change(torch.from_numpy(q)).numpy() for name, q in raw.rotations.items()}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of units, which has been said
            read = _bodies(path, _in_metres(path, replace(raw, rotations=rotations), layout), layout, base)
        assert read is not None
        order = read.s.argsort()
        offsets = None if read.offsets is None else read.offsets[order]
        return against_chords(read.s[order], read.positions[:, order], read.readings["orientations"][:, order], offsets)

    if said := misturned(against):
        warnings.warn(f"{path}: {said}", stacklevel=3)


def _gratings(path: Path, found: Recording, layout: Layout, places: Gratings) -> Shapes:
    """Curvature as it stands, or from the strains of cores: e = e_0 + k_x y - k_y x, least squares."""
    listed = [*places.kx, *places.ky, *(name for row in places.cores for name in row)]
    if missing := [name for name in listed if name not in found.values]:
        raise InputError(f"{layout.path}: gratings names {shown(missing[0])}, which is not in {path}; {named(found)}")
    if places.core is None:
        k = np.stack([np.stack([found.values[name] for name in names], 1) for names in (places.kx, places.ky)], -1)
    else:
        strain = _strain(path, found, places)
        x, y = places.core.numpy().T
        solve = np.linalg.pinv(np.column_stack([np.ones_like(x), y, -x]))
        k = (strain @ solve.T)[..., 1:]
    frames = len(k)
    nowhere = torch.full((frames, len(places.s), 3), torch.nan, dtype=DTYPE)
    return Shapes(places.s, nowhere, [""] * frames, readings={"curvature": torch.from_numpy(k)})


def _strain(path: Path, found: Recording, places: Gratings) -> Float[np.ndarray, "F G C"]:
    """Of every core at every place; along a fibre it is interpolated."""
    if places.start is None:
        return places.unit * np.stack([np.stack([found.values[name] for name in row], 1) for row in places.cores], 1)
    if found.fibre is None:
        raise InputError(f"{path}: has no strain along a fibre; name its columns by gratings.cores instead of gratings.start")
    x, strain = found.fibre
    wanted = places.s.numpy()[:, None] + np.array(places.start)
    if wanted.min() < x[0] - 1e-9 or wanted.max() > x[-1] + 1e-9:
        raise InputError(f"{path}: its fibre runs from {x[0]:g} to {x[-1]:g} m; gratings.start and s ask for {wanted.max():g} m")
    return np.stack([np.interp(wanted, x, row) for row in strain])


def _joined(parts: list[Shapes], frames: int) -> Shapes:
    """One list of places in the order of s; what one part did not measure is missing there."""
    s = torch.cat([part.s for part in parts])
    order = s.argsort(stable=True)
    offsets = None
    if any(part.offsets is not None for part in parts):
        rows = [torch.zeros(len(part.s), 3, dtype=DTYPE) if part.offsets is None else part.offsets for part in parts]
        offsets = torch.cat(rows)[order]
    readings = {}
    for name in {name for part in parts for name in part.readings}:
        size = next(part.readings[name].shape[-1] for part in parts if name in part.readings)
        blank = [torch.full((frames, len(part.s), size), torch.nan, dtype=DTYPE) for part in parts]
        readings[name] = torch.cat([part.readings.get(name, b) for part, b in zip(parts, blank, strict=True)], 1)[:, order]
    return Shapes(s[order], torch.cat([part.positions for part in parts], 1)[:, order], [""] * frames, offsets, readings=readings)
