"""What can be wrong with markers before any mechanics: their unit, their frame, their order. Asked of fits that explain nothing."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from .measurement import Markers

UNITS = {1e3: "millimetres", 1e2: "centimetres"}
FAR, SMALL = 3.0, 0.3  # of the length between the markers along the rod: in another unit, or not a rod
OFF = 0.1  # rod lengths: a marker that is so much farther from the origin than along the rod is in another frame
NEAR_BASE = 0.3  # of the length: the markers that say which way the rod leaves the base
AXES = [(sign, axis, f"{'+' if sign > 0 else '-'}{'xyz'[axis]}") for axis in range(3) for sign in (1.0, -1.0)]
ASIDE = 0.87  # cosine of 30 degrees: so near an axis, the shape follows that one


def unit_hint(ratio: float) -> str:
    """A question, where lengths are this many times too large."""
    unit = next((name for factor, name in UNITS.items() if factor / FAR < ratio < factor * FAR), "another unit or frame")
    return f"are they in {unit}? give metres in the robot's base frame"


def misplaced(markers: Markers, sample: int, length: float) -> str:
    """What is wrong with the unit, frame or order of one sample's markers on a rod of this length (m); mostly nothing."""
    seen = markers.present[sample]
    z, s = markers.positions[sample][seen], markers.s[seen]
    if not len(s):
        return "No marker was seen: every position is empty or NaN."
    if len(s) == 1:
        return "Only one marker was seen: a contact needs at least two."
    slack = OFF * length if markers.offsets is None else OFF * length + float(markers.offsets.norm(dim=-1).max())
    size = float(z.abs().max())
    spans, along = float(z.diff(dim=0).norm(dim=-1).sum()), float(s[-1] - s[0])
    ratio = spans / along if along > 0 else size / length
    if ratio > FAR and size > FAR * length:
        return f"Positions reach {size:.3g} m on a rod of {length:g} m: {unit_hint(ratio)}."
    if along > 0 and float((z.diff(dim=0).norm(dim=-1) / s.diff()).median()) > min(UNITS) / FAR:
        return f"Markers {spans:.3g} m apart in space lie {along:.2g} m apart along the rod: give the arc lengths s in metres."
    if along > 0 and ratio < SMALL and spans + slack < along:
        return (
            f"Markers {along:.3g} m apart along the rod lie {spans:.2g} m apart in space: "
            "give positions in metres, and check the arc lengths s."
        )
    far = z.norm(dim=-1)
    if bool((far > s + slack).any()) and bool((far <= length - s + slack).all()):
        return "The marker of largest s is the nearest to the base: count s from the base to the tip."
    if float(far[0] - s[0]) > slack:
        return (
            f"The marker at s = {float(s[0]):.3g} m lies {float(far[0]):.3g} m from the origin: "
            "give positions in the robot's base frame, whose origin is where the rod leaves the base."
        )
    return _leaves(z, s, length)


def _leaves(z: Float[Tensor, "P 3"], s: Float[Tensor, " P"], length: float) -> str:
    """The axis along which the markers nearest the base leave it, where it is not +z."""
    near = z[(s <= NEAR_BASE * length) & (s > 0)] if bool(((s <= NEAR_BASE * length) & (s > 0)).any()) else z[:1]
    way = near.sum(0)
    if not float(way.norm()) > 0 or not math.isfinite(float(way.norm())):
        return ""
    way = way / way.norm()
    for sign, axis, name in AXES:
        if name != "+z" and float(sign * way[axis]) > ASIDE:
            return f"The shape leaves the base along {name}, but the rod leaves it along +z: turn the base frame."
    return ""


def nearest_reach(positions: Float[Tensor, "B P 3"], length: float) -> float:
    """How far the markers of the sample that is nearest lie from the base, in rod lengths (its median marker); 0 without any."""
    reach = positions.abs().amax(-1).nanmedian(-1).values / length
    reach = reach[~torch.isnan(reach)]
    return float(reach.min()) if len(reach) else 0.0
