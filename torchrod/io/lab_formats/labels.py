"""Which point is which marker, where the file does not say: the rod tells.

In the first frame the points are assigned to the places where markers would be on many bent rods (arcs in all directions, and the
robot unloaded), each assignment is refined by the clamped curve

    (1)  p(s) = s e3 + a_2 s^2 + a_3 s^3 + a_4 s^4

fitted to it, and the one that places most markers best is taken. From then on every marker is sought where it was, and (1) finds
those that come back. Assignments are optimal for all markers together (scipy.optimize.linear_sum_assignment). A point that is
farther from its place than half the distance between markers, or from its neighbour than the rod is long between them, is not
taken: that marker is missing, not wrong. A first frame takes a tenth of a second; where PATIENCE of them have failed, the next
are tried ever more rarely, so that a file of something else ends soon, and a rod that was lost is missed at most twice as long.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from ...mechanics.robot import Robot
from ...mechanics.statics import solve_shape
from ...util.precision import DTYPE
from ...util.status import Status

BENDS = (0.5, 1.0, 1.75, 2.5, 3.5, 4.5)  # rad over the length, of the rods that are tried
DIRECTIONS = 12
ROUNDS = 6
NOISE = 0.5  # of half the distance between markers, that noise may add to their distances
STRETCH = 1.02  # markers may be this much farther apart than the rod is long between them
CHORD, SHORT = 0.75, 0.35  # of the arc between markers is their distance at least, where it is at most so much of the length
LOST = 0.6  # of the markers that were there: with fewer a frame is begun anew
ABOUT = 0.3  # of the length: so far from the markers of a rod that is tried they may be
PATIENCE = 8  # frames
CRUMPLED = 10.0  # markers that a labelling is worth less where distances are not those along the rod, squared and summed

Places = Float[np.ndarray, "P 3"]


@dataclass(frozen=True)
class Rod:
    """Markers at s (P,) m, offset by r (P, 3) m; guesses: where they would be on many rods. gate: m."""

    s: Float[np.ndarray, " P"]
    r: Places
    guesses: list[Places]
    gate: float


def rod_of(robot: Robot, s: Float[np.ndarray, " P"], r: Places | None) -> Rod:
    """The rods that are tried in the first frame."""
    L, stalks = robot.rod.length, np.zeros((len(s), 3)) if r is None else r
    guesses = []
    pull = torch.zeros(1, len(robot.tendons), dtype=DTYPE) if len(robot.tendons) else None
    rest = solve_shape(robot, (), pull, torch.from_numpy(np.sort(s)), 1)
    if int(rest.status[0]) == int(Status.CONVERGED):
        back = np.argsort(np.argsort(s, kind="stable"), kind="stable")
        p = rest.p[0].numpy()[back]
        guesses.append(p + _stalks(np.gradient(p, axis=0) if len(s) > 1 else np.array([[0.0, 0, 1]]), stalks))
    for bend, k in product(BENDS, range(DIRECTIONS)):
        u, way = bend / L, np.array([np.cos(2 * np.pi * k / DIRECTIONS), np.sin(2 * np.pi * k / DIRECTIONS)])
        p = np.column_stack([np.outer((1 - np.cos(u * s)) / u, way), np.sin(u * s) / u])
        t = np.column_stack([np.outer(np.sin(u * s), way), np.cos(u * s)])
        guesses.append(p + _stalks(t, stalks))
    apart = np.linalg.norm(guesses[0][:, None] - guesses[0][None], axis=-1) + np.where(np.eye(len(s)) > 0, np.inf, 0.0)
    return Rod(s, stalks, guesses, max(0.5 * min(float(apart.min()), 0.2 * L), 1e-3 * L))


def _stalks(t: Places, r: Places) -> Places:
    """r turned with the section, by the smallest rotation of e3 to the tangent."""
    if not r.any():
        return np.zeros_like(r)
    t = t / np.linalg.norm(t, axis=-1, keepdims=True).clip(1e-12)
    v = np.column_stack([-t[:, 1], t[:, 0], np.zeros(len(t))])
    w = np.cross(v, r)
    return r + w + np.cross(v, w) / (1 + t[:, 2:]).clip(1e-3)


def _curve(rod: Rod, at: Int[np.ndarray, " n"], z: Places) -> Places:
    """The places of all markers on (1), fitted to those that were seen."""
    L, stalks = rod.s.max(), rod.r
    x = rod.s / L
    powers = np.column_stack([x**k for k in range(2, min(5, 2 + len(at)))])
    p = np.zeros((len(x), 3))
    for _ in range(2 if rod.r.any() else 1):
        rest = (z - stalks[at]) / L - np.outer(x[at], [0, 0, 1])
        a = np.linalg.lstsq(np.vstack([powers[at], 1e-3 * np.eye(powers.shape[1])]), np.pad(rest, ((0, powers.shape[1]), (0, 0))))[
            0
        ]
        p = L * (np.outer(x, [0, 0, 1]) + powers @ a)
        slope = np.column_stack([k * x ** (k - 1) for k in range(2, 2 + powers.shape[1])])
        stalks = _stalks(np.array([0.0, 0, 1]) + slope @ a, rod.r)
    return p + stalks


def _assigned(places: Places, points: Float[np.ndarray, "N 3"], gate: float) -> Int[np.ndarray, " P"]:
    """For each place the point that is there, or -1; together the nearest."""
    d = np.linalg.norm(places[:, None] - points[None], axis=-1)
    rows, columns = linear_sum_assignment(np.minimum(d, gate) ** 2)  # what is farther costs the same wherever it is
    found = np.full(len(places), -1)
    near = d[rows, columns] <= gate
    found[rows[near]] = columns[near]
    return found


def _possible(rod: Rod, found: Int[np.ndarray, " P"], points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " P"]:
    """Without the markers that no rod of this length has there."""
    found = found.copy()
    reach = np.linalg.norm(rod.r, axis=-1)
    while True:
        at = np.flatnonzero(found >= 0)
        p = points[found[at]]
        apart = np.linalg.norm(p[:, None] - p[None], axis=-1)
        most = STRETCH * np.abs(rod.s[at][:, None] - rod.s[at]) + reach[at][:, None] + reach[at] + NOISE * rod.gate
        bad = (apart > most).sum(-1)
        along = np.diff(rod.s[at], prepend=0.0)
        chord = np.linalg.norm(np.diff(p, axis=0, prepend=0.0), axis=-1)
        slack = reach[at] + np.append(0.0, reach[at][:-1]) + NOISE * rod.gate
        near = (chord < CHORD * along - slack) & (along < SHORT * rod.s.max())
        bad = bad + near + np.append(near[1:], False)
        bad = bad + (np.linalg.norm(p, axis=-1) > STRETCH * rod.s[at] + reach[at] + 0.5 * rod.gate)
        if not bad.any():
            return found
        found[at[int(bad.argmax())]] = -1


def _begun(rod: Rod, points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " P"]:
    """The labels of a frame of which nothing is known."""
    best, least = np.full(len(rod.s), -1), (0.0, np.inf)
    for guess in rod.guesses:
        places, gate, found = guess, max(rod.gate, ABOUT * rod.s.max()), np.full(len(rod.s), -1)
        for k in range(ROUNDS):
            again = _assigned(places, points, gate)
            if k and (again == found).all() and gate == rod.gate:
                break
            found, gate = again, max(rod.gate, (4.0 if k < 2 else 2.0 if k < 3 else 1.0) * rod.gate)
            at = np.flatnonzero(found >= 0)
            if not len(at):
                break
            places = _curve(rod, at, points[found[at]])
        at = np.flatnonzero(found >= 0)
        off = np.linalg.norm(places[at] - points[found[at]], axis=-1) if len(at) else np.array([np.inf])
        found = np.where(np.isin(np.arange(len(found)), at[off <= rod.gate]), found, -1) if len(at) else found
        found = _possible(rod, found, points)
        at = np.flatnonzero(found >= 0)
        along = np.diff(rod.s[at], prepend=0.0).clip(1e-3 * rod.s.max())
        short = 1 - np.linalg.norm(np.diff(points[found[at]], axis=0, prepend=0.0), axis=-1) / along  # of a rod that hardly bends 0
        score = (CRUMPLED * float(np.square(short).sum()) - len(at), float(np.square(off).mean()))
        if score < least:
            best, least = found, score
    return best if 2 * (best >= 0).sum() >= len(best) else np.full(len(best), -1)  # of fewer a wrong rod can be made


def labelled(rod: Rod, frames: Float[np.ndarray, "F N 3"]) -> Float[np.ndarray, "F P 3"]:
    """The markers of every frame, in the base frame, NaN where none of its points is the marker."""
    P, lost = len(rod.s), np.full(len(rod.s), -1)
    result = np.full((len(frames), P, 3), np.nan)
    reach = STRETCH * rod.s.max() + np.linalg.norm(rod.r, axis=-1).max() + rod.gate
    places: Places | None = None
    known = np.zeros(P, dtype=bool)
    moving = np.zeros((P, 3))  # from the frame before to this one
    failed, again = 0, 0  # how many frames more than not were no rod; from which frame on another may be tried as the first
    for k, frame in enumerate(frames):
        points = frame[np.isfinite(frame).all(-1)]
        if not len(points):
            continue
        found = lost if places is None else _possible(rod, _assigned(places + moving, points, rod.gate), points)
        if (found >= 0).sum() < max(1.0, LOST * known.sum()) or not known.any():
            if k < again or 2 * (np.linalg.norm(points, axis=-1) <= reach).sum() < P:
                continue
            found = _begun(rod, points)
        at = np.flatnonzero(found >= 0)
        before = places
        places = _curve(rod, at, points[found[at]]) if len(at) else None
        if places is not None:
            at = at[np.linalg.norm(places[at] - points[found[at]], axis=-1) <= 2 * rod.gate]  # the others belong to no such curve
            result[k, at] = places[at] = points[found[at]]
        moving = np.zeros((P, 3)) if before is None or places is None else places - before
        known = np.isin(np.arange(P), at)
        failed = max(0, failed - 1) if len(at) else failed + 1
        again = k + 2 ** max(0, failed - PATIENCE)
    return result
