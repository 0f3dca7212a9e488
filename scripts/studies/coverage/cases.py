"""What pushes the rod: kinds of loads, and random members of each, made on four times the steps of the fit."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

import torchrod as tr
from studies.reproduction.cases import steel_rod

STEPS, MARKERS = 160, 20


@dataclass(frozen=True)
class Kind:
    """Point forces, and perhaps a dead load at the tip.

    contacts: so many; noise: of the length; force, place: ranges in force scales and lengths. apart: the least and the most
    distance of neighbours, in lengths. way: "any", each its own; "same"; "opposed", each to the other side of the one before. tip:
    "force" or "moment" in any direction, "pressed" along the rod, or "wrench", a force and a moment, of `size` force and moment
    scales. unknown: what is unknown at the tip.
    """

    name: str
    contacts: int
    noise: float
    force: tuple[float, float] = (0.5, 2.0)
    place: tuple[float, float] = (0.25, 1.0)
    apart: tuple[float, float] = (0.0, 1.0)
    way: str = "any"
    tip: str = "none"
    size: tuple[float, float] = (0.0, 0.0)
    unknown: str = "none"


def _pressed(least: float, most: float) -> Kind:
    name = f"push beside {least:g} to {most:g} scales that press the tip, unknown"
    return Kind(name, 1, 1e-3, (0.2, 0.8), tip="pressed", size=(least, most), unknown="force")


TOLD = {
    "one": Kind("one push, 0.25 % noise", 1, 2.5e-3),
    "one-exact": Kind("one push, 0.1 % noise", 1, 1e-3),
    "weak": Kind("weak push near the base, 0.25 % noise", 1, 2.5e-3, (0.1, 0.4), (0.05, 0.3)),
    "two": Kind("two pushes 15 % apart or more", 2, 1e-3, place=(0.2, 1.0), apart=(0.15, 1.0)),
    "close": Kind("two pushes 5 to 10 % apart, the same way", 2, 1e-3, place=(0.3, 1.0), apart=(0.05, 0.1), way="same"),
    "opposed": Kind("two pushes 5 to 10 % apart, opposed", 2, 1e-3, place=(0.3, 1.0), apart=(0.05, 0.1), way="opposed"),
    "three": Kind("three pushes 15 % apart or more", 3, 1e-3, apart=(0.15, 1.0)),
    "moment": Kind("nothing but a moment at the tip, wrench unknown", 0, 1e-3, tip="moment", size=(0.1, 0.5), unknown="wrench"),
    "wrench": Kind("a force and a moment at the tip, wrench unknown", 0, 1e-3, tip="wrench", size=(0.1, 0.5), unknown="wrench"),
    "pressed": _pressed(0.1, 0.55),
    "buckled": _pressed(0.8, 1.5),
    "tip": Kind(
        "push beside a force at the tip, force unknown", 1, 1e-3, (0.3, 1.0), tip="force", size=(0.1, 0.5), unknown="force"
    ),
    "hidden": Kind(
        "push beside force and moment at the tip, unknown", 1, 1e-3, (0.3, 1.0), tip="wrench", size=(0.1, 0.5), unknown="wrench"
    ),
}
COUNTED = {
    "nothing": Kind("nothing", 0, 1e-3),
    "one": TOLD["one-exact"],
    "two": TOLD["two"],
    "close": TOLD["close"],
    "opposed": TOLD["opposed"],
    "three": TOLD["three"],
    "four": Kind("four pushes 15 % apart or more", 4, 1e-3, apart=(0.15, 1.0)),
    "tip": Kind("nothing but a force at the tip", 0, 1e-3, tip="force", size=(0.3, 1.0)),
}


@dataclass(frozen=True)
class Truth:
    """size, at (B, K) N, m, in the order along the rod; tip (B, 6) [N, N m]; resultant, whole
    (B,) N: of the pushes, and with the force at the tip."""

    size: Tensor
    at: Tensor
    tip: Tensor
    resultant: Tensor
    whole: Tensor


def _uniform(low: float, high: float, random: torch.Generator, *shape: int) -> Tensor:
    return low + (high - low) * torch.rand(*shape, generator=random, dtype=torch.float64)


def _places(kind: Kind, cases: int, random: torch.Generator) -> Tensor:
    """(B, K) in lengths, rising."""
    found = torch.zeros(0, kind.contacts, dtype=torch.float64)
    while len(found) < cases:
        tried = _uniform(*kind.place, random, 100 * cases, kind.contacts).sort(-1).values
        gap = tried.diff(dim=-1)
        found = torch.cat([found, tried[((gap >= kind.apart[0]) & (gap <= kind.apart[1])).all(-1)]])
    return found[:cases]


def _at_tip(kind: Kind, cases: int, random: torch.Generator) -> Tensor:
    """(B, 6) in force and moment scales."""
    tip, size = torch.zeros(cases, 6, dtype=torch.float64), _uniform(*kind.size, random, cases, 1)
    if kind.tip == "pressed":
        tip[:, 2:3] = -size
    for name, at in (("force", slice(0, 3)), ("moment", slice(3, 6))):
        if kind.tip in (name, "wrench"):
            way = torch.randn(cases, 3, generator=random, dtype=torch.float64)
            tip[:, at] = size * way / way.norm(dim=-1, keepdim=True)
    return tip


def posed(kind: Kind, cases: int, seed: int = 0) -> tuple[tr.Problem, Truth]:
    """Members of a kind."""
    random, robot, K = torch.Generator().manual_seed(seed), steel_rod(), kind.contacts
    rod = robot.rod
    at, size = rod.length * _places(kind, cases, random), rod.force_scale * _uniform(*kind.force, random, cases, K)
    turn = _uniform(0, 2 * math.pi, random, cases, K)
    if kind.way != "any":
        turn = turn[:, :1] + (math.pi if kind.way == "opposed" else 0.0) * torch.arange(K)
    F = torch.stack([size * turn.cos(), size * turn.sin(), 0 * size], -1)
    unit = torch.tensor([rod.force_scale] * 3 + [rod.moment_scale] * 3, dtype=torch.float64)
    tip = unit * _at_tip(kind, cases, random)
    there = tr.PointWrenches(tip[:, None, :3], tip[:, None, 3:], torch.tensor([rod.length], dtype=torch.float64))
    s = torch.linspace(rod.length / MARKERS, rod.length, MARKERS, dtype=torch.float64)
    shape = tr.solve_shape(robot, (tr.PointForces(F, at), there) if K else (there,), None, s, cases, STEPS)
    noise = kind.noise * rod.length
    unknowns = tr.Unknowns(tr.GaussianCoordinates(K, rod.length, rod.force_scale), kind.unknown)
    readings = shape.p + noise * torch.randn(shape.p.shape, generator=random, dtype=torch.float64)
    force = shape.base_wrench[:, :3]
    truth = Truth(size, at, tip, (force - tip[:, :3]).norm(dim=-1), force.norm(dim=-1))
    return tr.Problem(robot, unknowns, [tr.Markers(s, readings, noise)]), truth
