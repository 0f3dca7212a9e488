"""What can be wrong with markers before any mechanics: their unit, their frame, their order. Asked of fits that explain nothing."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..mechanics.lie import rotate
from .sensors import Markers

UNITS = {1e6: "micrometres", 1e3: "millimetres", 1e2: "centimetres", 39.37: "inches"}
ALIKE = 1.5  # a ratio is that of a unit within this factor
FAR, SMALL = 3.0, 0.3  # of the length between the markers along the rod: in another unit, or not a rod
SHORT = 0.01  # of the rod: where all markers lie nearer to its base, arc lengths and rod are in different units
OFF = 0.1  # rod lengths: a marker that is so much farther from the origin than along the rod is in another frame
NEAR_BASE = 0.3  # of the length: the markers that say which way the rod leaves the base
AXES = [(sign, axis, f"{'+' if sign > 0 else '-'}{'xyz'[axis]}") for axis in range(3) for sign in (1.0, -1.0)]
STRAIGHT = 0.85  # chord over arc of the rod up to a marker: one bent more may have turned by 60 degrees since the base
AGAINST, ALONG = 0.2, 0.1  # `against_chords` of orientations that contradict positions; of others that do not, beside it
MISTAKES: dict[str, Callable[[Tensor], Tensor]] = {  # in quaternions x, y, z, w, each with what mends it
    "with w first": lambda q: q[..., [1, 2, 3, 0]],
    "as the inverse rotation": lambda q: q * q.new_tensor([-1.0, -1.0, -1.0, 1.0]),
    "as the inverse rotation with w first": lambda q: q[..., [1, 2, 3, 0]] * q.new_tensor([-1.0, -1.0, -1.0, 1.0]),
}
ASIDE = 0.87  # cosine of 30 degrees: so near an axis, the shape follows that one


def unit_hint(ratio: float) -> str:
    """A question, where markers are this many times farther apart in space than along the rod."""
    if 1 / ALIKE < ratio < ALIKE:
        return "the unit fits, so give them in the robot's base frame, whose origin is where the rod leaves the base"
    unit = next((name for factor, name in UNITS.items() if factor / ALIKE < ratio < factor * ALIKE), "another unit or frame")
    return f"are they in {unit}? give metres in the robot's base frame"


def _scale(z: Float[Tensor, "P 3"], s: Float[Tensor, " P"], length: float) -> float:
    """How many times farther apart neighbouring markers are in space than along the rod: 1 in metres, in whatever frame.

    The middle one of all neighbours: a marker that is off does not count. Without neighbours, their distance in rod lengths.
    """
    along = s.diff()
    steps = (z.diff(dim=0).norm(dim=-1) / along)[along > 0]
    return float(steps.median()) if len(steps) else float(z.abs().max()) / length


def at_origin(markers: Markers) -> Bool[Tensor, "B P"]:
    """Markers away from the base at exactly (0, 0, 0): what some programs write for one that they have not seen."""
    return (markers.positions == 0).all(-1) & (markers.s > 0)


def too_far(markers: Markers, length: float) -> str:
    """What to say of a file of which even the nearest sample (its middle marker) is FAR rod lengths (m) off; mostly nothing."""
    distance = torch.where(markers.present, markers.positions.abs().amax(-1), torch.nan)  # coordinates may be too large for a sum
    reach = distance.nanmedian(-1).values.nan_to_num(torch.inf)
    if not len(reach) or not FAR * length < float(reach.min()) < math.inf:
        return ""
    nearest = int(reach.argmin())
    seen = markers.present[nearest]
    hint = unit_hint(_scale(markers.positions[nearest][seen], markers.s[seen], length))
    return f"positions reach {float(reach.min()):.3g} m on a rod of {length:g} m; {hint}"


def too_short(s: Float[Tensor, " P"], length: float) -> str:
    """What to say of arc lengths (m) that all lie next to the base; mostly nothing."""
    if not len(s) or float(s.max()) >= SHORT * length:
        return ""
    return (
        f"the markers end at s = {float(s.max()):.3g} m of a rod of {length:g} m, where no load shows; "
        "are the file and the robot's length in the same unit? give metres"
    )


def misplaced(markers: Markers, sample: int, length: float) -> str:
    """What is wrong with the unit, frame or order of one sample's markers on a rod of this length (m); mostly nothing."""
    markers = markers.take(torch.tensor([sample]))
    seen = markers.present[0]
    z, s = markers.positions[0][seen], markers.s[seen]
    if not len(s):
        return "No marker was seen: every position is empty or NaN."
    if len(s) == 1:
        return "Only one marker was seen: a contact needs at least two; for a tip force, try --contacts 0 --unknown-tip force."
    zero = at_origin(markers)[0].nonzero().flatten()
    if len(zero):
        places = _named(zero.tolist(), markers.s)
        return f"{places} at exactly (0, 0, 0), which some programs write for a missing one: leave the cells empty, or NaN."
    slack = OFF * length if markers.offsets is None else OFF * length + float(markers.offsets.norm(dim=-1).max())
    size, scale = float(z.abs().max()), _scale(z, s, length)
    spans, along = float(z.diff(dim=0).norm(dim=-1).sum()), float(s[-1] - s[0])
    if scale > FAR and size > FAR * length:
        return f"Positions reach {size:.3g} m on a rod of {length:g} m: {unit_hint(scale)}."
    if along > 0 and scale > min(UNITS) / ALIKE:
        return f"Markers {spans:.3g} m apart in space lie {along:.2g} m apart along the rod: give the arc lengths s in metres."
    if along > 0 and scale < SMALL and spans + slack < along and any(1 / ALIKE < scale * unit < ALIKE for unit in UNITS):
        return (
            f"Markers {along:.3g} m apart along the rod lie {spans:.2g} m apart in space: "
            "give positions in metres, and check the arc lengths s."
        )
    return _strayed(z, seen, markers.s, length) or _turned(z, s, length, slack)


def _named(which: list[int], s: Float[Tensor, " P"]) -> str:
    names = ", ".join(f"{i + 1} (s = {1e3 * float(s[i]):.4g} mm)" for i in which)
    return f"Marker{'s' * (len(which) > 1)} {names}"


def _strayed(z: Float[Tensor, "p 3"], seen: Bool[Tensor, " P"], s: Float[Tensor, " P"], length: float) -> str:
    """The markers that are no part of a rod of this length, where the others are."""
    off = (z - z.median(dim=0).values).abs().amax(-1)
    stray = (off > FAR * length).nonzero().flatten()
    if not 0 < 2 * len(stray) < len(z):
        return ""
    which = seen.nonzero().flatten()[stray].tolist()
    return (
        f"{_named(which, s)}: up to {float(off.max()):.3g} m from the others, on a rod of {length:g} m; "
        "leave the cells empty, or try --robust."
    )


def _turned(z: Float[Tensor, "P 3"], s: Float[Tensor, " P"], length: float, slack: float) -> str:
    """What is wrong with the order along the rod, or the frame."""
    far = z.norm(dim=-1)
    if bool((far > s + slack).any()) and bool((far <= length - s + slack).all()):
        return "The marker of largest s is the nearest to the base: count s from the base to the tip."
    if float((far - s)[:2].min()) > slack:  # of two: one alone may be an outlier
        return (
            f"The marker at s = {float(s[0]):.3g} m lies {float(far[0]):.3g} m from the origin: "
            "give positions in the robot's base frame, whose origin is where the rod leaves the base."
        )
    return _leaves(z, s, length)


def _leaves(z: Float[Tensor, "P 3"], s: Float[Tensor, " P"], length: float) -> str:
    """The axis along which the markers nearest the base leave it, where it is not +z; nothing where the rod has turned by then."""
    near = z[(s <= NEAR_BASE * length) & (s > 0) & (z.norm(dim=-1) > STRAIGHT * s)]
    if not len(near):
        return ""
    way = near.sum(0)
    if not float(way.norm()) > 0 or not math.isfinite(float(way.norm())):
        return ""
    way = way / way.norm()
    for sign, axis, name in AXES:
        if name != "+z" and float(sign * way[axis]) > ASIDE:
            return f"The shape leaves the base along {name}, but the rod leaves it along +z: turn the base frame."
    return ""


def against_chords(
    s: Float[Tensor, " P"], p: Float[Tensor, "B P 3"], q: Float[Tensor, "B P 4"], r: Float[Tensor, "P 3"] | None = None
) -> float:
    """How far orientations (x, y, z, w) contradict positions (m, offset by r from the centre line): the mean of 1 - cos of the
    angle between the chord from place to place, the base included, and the mean tangent of its ends. 0 where nothing was read.
    """
    centre = p if r is None else p - rotate(q, r.expand_as(p))
    tangent = rotate(q, q.new_tensor([0.0, 0.0, 1.0]).expand_as(p))
    if len(s) and float(s[0]) > 0:
        centre = torch.cat([torch.zeros_like(centre[:, :1]), centre], 1)
        tangent = torch.cat([tangent.new_tensor([0.0, 0.0, 1.0]).expand_as(tangent[:, :1]), tangent], 1)
    chord, middle = centre.diff(dim=1), tangent[:, 1:] + tangent[:, :-1]
    against = 1 - torch.nn.functional.cosine_similarity(chord, middle, dim=-1)
    return float(against.nanmean().nan_to_num(0.0))


def misturned(against: Callable[[Callable[[Tensor], Tensor]], float]) -> str:
    """What is wrong with orientations, by `against_chords` of them after a change; mostly nothing."""
    given = against(lambda q: q)
    if given < AGAINST:
        return ""
    mended = {name: against(change) for name, change in MISTAKES.items()}
    best = min(mended, key=mended.__getitem__)
    if mended[best] > ALONG * given:
        return ""
    turned, left = (math.degrees(math.acos(max(-1.0, 1 - v))) for v in (given, mended[best]))
    return (
        f"the orientations do not go with the positions along the rod ({turned:.0f} degrees off), but read {best} they would "
        f"({left:.0f} degrees): check their order, which is x, y, z, w, and that they turn the section into the base frame"
    )
