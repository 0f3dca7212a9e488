"""Where the robot's base is in a recording: from markers on its plate, from a rigid body, or as the layout states it.

Markers at places b_i of the base frame that were seen at z_i give the pose of least sum |z_i - R b_i - t|^2 in closed form
(Kabsch; roma.rigid_points_registration), for any rotation.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...mechanics.lie import Matrix, Vector, matvec
from ...util.errors import InputError, shown
from .layout import Layout, Plate
from .recording import Recording

ALIKE = 0.02  # of the plate's size: so well its markers must fit it, and so well a mirrored plate must not
MOST_NAMED, MOST_LETTERS = 12, 40  # names in a refusal, and letters of each
MOST_TRIED = 10_000  # triples of points that lie as the first three of an unlabelled plate


@dataclass(frozen=True)
class Base:
    """R (F or 1, 3, 3) and t (F or 1, 3) m of the base frame in a recording. rms: distance (m) of the plate's markers from their
    places. names: of points that are on the plate; plate: (M, 3) m, where such points are, if they have no names.
    """

    R: Matrix
    t: Vector
    rms: float | None = None
    names: tuple[str, ...] = ()
    plate: Float[Tensor, "M 3"] | None = None


def base_in(path: Path, layout: Layout, plate: Plate, found: Recording) -> Base:
    """The base frame in a recording in metres. Errors: InputError."""
    if plate.at is None:
        return Base(*_of_body(path, plate, found), None, (plate.body,) if plate.body else ())
    names = plate.names
    if names is None:
        if plate.moving:
            raise InputError(f"{layout.path}: base.names is missing; a plate that moves is known by its markers' names")
        z = torch.from_numpy(_places_of_plate(path, plate.at, found))[None]
        R, t, off = aligned(plate.at, z)
        return Base(R, t, _checked(path, layout, plate.at, z, off), (), z[0])
    if missing := [name for name in names if name not in found.points]:
        raise InputError(f"{layout.path}: base.names has {shown(missing[0])}, which is not in {path}; {named(found)}")
    z = torch.from_numpy(np.stack([found.points[name] for name in names], 1))
    if not plate.moving:
        z = z.nanmedian(0, keepdim=True).values
    R, t, off = aligned(plate.at, z)
    if bool(R.isnan().all()):
        raise InputError(
            f"{path}: fewer than three markers of the base plate were seen together; name others in the layout's [base]"
        )
    return Base(R, t, _checked(path, layout, plate.at, z, off), tuple(names))


def _checked(path: Path, layout: Layout, at: Float[Tensor, "M 3"], z: Float[Tensor, "F M 3"], off: Float[Tensor, " F"]) -> float:
    """How far off (m, rms) a plate's markers z are. Errors: InputError for a plate that lies so only in a mirror, or not at all."""
    size, rms = float((at - at.mean(0)).norm(dim=-1).max()), float(off.nanmedian())
    if rms > ALIKE * size:
        flip = at * at.new_tensor([1.0, 1.0, -1.0])
        mirrored = float(aligned(flip, z)[2].nanmedian())
        if mirrored < 0.3 * rms and mirrored < 2 * ALIKE * size:
            raise InputError(_mirrored(path, layout))
        raise InputError(
            f"{path}: the base plate's markers lie {1e3 * rms:.3g} mm from their places; check base.names and base.at of the layout"
        )
    return rms


def _mirrored(path: Path, layout: Layout) -> str:
    said = "not left-handed, as the layout says" if layout.left_handed else "left-handed (mirrored)"
    remedy = "remove left_handed from" if layout.left_handed else "add left_handed = true to"
    return f"{path}: its coordinates are {said}; {remedy} {layout.path}, or export them with right-handed axes"


def check_side(path: Path, layout: Layout, p: Float[Tensor, "F N 3"], length: float) -> None:
    """A plate's markers in one plane fit a mirror image as well; the rod then leaves the base along -z. Errors: InputError."""
    side = p[..., 2].nanmedian(-1).values.nanmedian()
    if float(side) < -0.05 * length:
        raise InputError(
            f"{path}: the rod's markers lie below the base plate (z = {1e3 * float(side):.3g} mm), so its coordinates are "
            f"left-handed (mirrored), or base.at has an axis turned round; change left_handed in {layout.path}, or base.at"
        )


def aligned(at: Float[Tensor, "M 3"], z: Float[Tensor, "F M 3"]) -> tuple[Matrix, Vector, Float[Tensor, " F"]]:
    """R, t and the rms distance of z from R at + t; NaN for a frame of which fewer than three were seen."""
    import roma

    seen = torch.isfinite(z).all(-1)
    known = seen.sum(-1) >= 3
    weights, filled = seen.to(z.dtype), torch.where(seen.unsqueeze(-1), z, 0.0)
    weights = torch.where(known.unsqueeze(-1), weights, 1.0)
    pose = roma.rigid_points_registration(at.expand_as(z), filled, weights)
    R, t = torch.as_tensor(pose[0]), torch.as_tensor(pose[1])
    off = (matvec(R.unsqueeze(-3), at) + t.unsqueeze(-2) - z).square().sum(-1).nanmean(-1).sqrt()
    fine = known[:, None]
    return torch.where(fine.unsqueeze(-1), R, torch.nan), torch.where(fine, t, torch.nan), torch.where(known, off, torch.nan)


def _of_body(path: Path, plate: Plate, found: Recording) -> tuple[Matrix, Vector]:
    """A stated pose, in the file's world or in the frame of a rigid body."""
    import roma

    assert plate.pose is not None
    own = roma.unitquat_to_rotmat(plate.pose.rotation)[None]
    if plate.body is None:
        return own, plate.pose.position[None]
    if plate.body not in found.rotations:
        raise InputError(f"{path}: has no rigid body {shown(plate.body)} for the base; rigid bodies: {listed(found.rotations)}")
    q, p = (torch.from_numpy(of[plate.body]) for of in (found.rotations, found.points))
    turn = roma.unitquat_to_rotmat(torch.where(torch.isfinite(q), q, q.new_tensor([0.0, 0.0, 0.0, 1.0])))
    gone = ~torch.isfinite(q).all(-1)
    turn = torch.where(gone[:, None, None], torch.nan, turn)
    if not plate.moving:
        if bool(gone.all()):
            raise InputError(
                f"{path}: the rigid body {shown(plate.body)} of the base was never seen; name markers of the plate instead"
            )
        turn, p = torch.as_tensor(roma.special_procrustes(turn[~gone].mean(0)))[None], p.nanmedian(0, keepdim=True).values
    return turn @ own, matvec(turn, plate.pose.position) + p


def _alike(apart: Float[np.ndarray, "N N"], wanted: Float[np.ndarray, "M M"], slack: float) -> list[tuple[int, int, int]]:
    """Three points that are as far apart as the first three markers of the plate, every way of naming them; MOST_TRIED and one more
    at most.
    """
    near = [np.abs(apart - wanted[i, j]) <= slack for i, j in ((0, 1), (0, 2), (1, 2))]
    for of in near:
        np.fill_diagonal(of, False)
    found: list[tuple[int, int, int]] = []
    for i, j in np.argwhere(near[0]):
        found += [(int(i), int(j), int(k)) for k in np.flatnonzero(near[1][i] & near[2][j])]
        if len(found) > MOST_TRIED:
            break
    return found


def _places_of_plate(path: Path, at: Float[Tensor, "M 3"], found: Recording) -> Float[np.ndarray, "M 3"]:
    """Where the points are that lie to each other as the plate's markers do: found in the frame that shows most points, and the
    median over all frames of the points nearest to there.
    """
    names = list(found.points)
    if len(names) < len(at):
        raise InputError(f"{path}: has {len(names)} points, fewer than the base plate's {len(at)} markers; check the export")
    every = np.stack([found.points[name] for name in names], 1)
    x, y, w = (np.isfinite(every[..., i]) for i in range(3))
    frame = int((x & y & w).sum(axis=1).argmax())
    z = every[frame][(x & y & w)[frame]]
    M, places = len(at), at.numpy()
    wanted = np.linalg.norm(places[:, None] - places, axis=-1)
    apart = np.linalg.norm(z[:, None] - z, axis=-1)
    slack = ALIKE * float(wanted.max())
    triples = _alike(apart, wanted, slack)
    if len(z) < M or len(triples) > MOST_TRIED:
        raise InputError(f"{path}: its {len(z)} points cannot be told apart as the base plate's {M} markers; give base.names")
    fits = []
    for first in triples:
        chosen = list(first)
        for k in range(3, M):
            off = np.abs(apart[:, chosen] - wanted[k, :k]).max(-1)
            off[chosen] = np.inf
            chosen.append(int(off.argmin()))
        off = float(np.abs(apart[np.ix_(chosen, chosen)] - wanted).max())
        if off <= slack:
            fits.append((off, chosen))
    fits.sort()
    if not fits:
        raise InputError(
            f"{path}: no {M} of its points lie to each other as the base plate's markers do; give base.names, or check base.at"
        )
    if len(fits) > 1 and fits[1][0] < 3 * fits[0][0] + 0.1 * slack:
        raise InputError(f"{path}: the base plate's markers lie so alike that two ways of naming them fit; give base.names")
    chosen = z[fits[0][1]]
    near = np.linalg.norm(every[:, :, None] - chosen, axis=-1)
    nearest = np.where(np.isnan(near), np.inf, near).argmin(axis=1)
    places = np.take_along_axis(every, nearest[..., None], axis=1)
    there = np.linalg.norm(places - chosen, axis=-1, keepdims=True) <= slack
    return np.nanmedian(np.where(there, places, np.nan), axis=0)


def named(found: Recording) -> str:
    """The names that there are, as a refusal lists them."""
    return f"names: {listed(found.points or found.values)}"


def listed(names: Iterable[str]) -> str:
    """The first of them, or none."""
    every = [name if len(name) <= MOST_LETTERS else f"{name[:MOST_LETTERS]}..." for name in names]
    return ", ".join([*every[:MOST_NAMED], *(["..."] if len(every) > MOST_NAMED else [])]) or "none"
