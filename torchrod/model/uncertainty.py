"""What is only nearly known of a robot: its parameters with standard deviations, unknowns of every sample with these as priors.

A robot is never quite as its file says. Where a fit takes it as exact, what its error does to the shape passes for a load; with the
error unknown, within what is known of it, intervals hold (docs/trust.md). The errors are L theta, theta ~ N(0, 1), L a root of
their covariance: diagonal, but where a calibration has found errors that are correlated. The model is that of the robot which is
off by them (model.deviations).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..mechanics.lie import Vector, exponential, hat, rotate
from ..mechanics.robot import Robot
from ..mechanics.rod import Rod
from ..mechanics.tendons import Tendon, Tendons
from ..util.precision import DTYPE, Float64

MOST_SHARE = 0.5  # of a number whose error is relative: with more, one standard deviation leaves next to nothing of it
KNOTS = 10  # pieces of the length over which an error of the curvature is one, where no length is stated
RELATIVE = ("stiffness", "mass", "tension")  # errors that are shares of a number
OVAL, GRAVITY = ("oval_1", "oval_2"), ("gravity_1", "gravity_2")
LEAST = 0.3  # a share of a stiffness, below which it falls ever more slowly
TURN_SERIES = 1e-4  # rad^2: below it sin and cos by their series
OF_TENDONS = ("tension", "tension_offset", "friction", "tendon_place")
SHIFT, TURN = (tuple(f"frame_{kind}{axis}" for axis in "xyz") for kind in ("", "turn_"))  # entries of a Warp
STRAIN = tuple(f"metric_{axes}" for axes in ("xx", "yy", "zz", "yz", "xz", "xy"))
NONE = 1e-12  # of a standard deviation: what is left of a direction that is none
Change = Callable[[Robot, float], Robot]


@dataclass(frozen=True)
class Parameter:
    """One number of a robot: name, the SI unit of its error, its standard deviation, what an error does to the robot."""

    name: str
    unit: str
    std: float
    change: Change | None = None

    @property
    def seen(self) -> bool:
        """Whether it is an error of what is measured, an entry of a `Warp`, and not of the robot."""
        return self.change is None

    @property
    def relative(self) -> bool:
        """Whether its error is a share of a number that is positive."""
        return self.name.split("_")[0] in RELATIVE and "offset" not in self.name


@dataclass(frozen=True)
class Warp(Float64):
    """How positions are measured: exp(turn) (I + E) p + shift, of p where they are, base frame.

    shift (3,) m and turn (3,) rad: of the base frame. strain (6,): xx, yy, zz, yz, xz, xy of the symmetric E, by which the metric
    of cameras is off. Of all samples, or each of its own.
    """

    shift: Float[Tensor, "*B 3"]
    turn: Float[Tensor, "*B 3"]
    strain: Float[Tensor, "*B 6"]

    @classmethod
    def of(cls, entries: Mapping[str, float]) -> "Warp":
        """From errors by their names; those that are none of its own are left aside."""
        shift, turn, strain = ([entries.get(name, 0.0) for name in names] for names in (SHIFT, TURN, STRAIN))
        return cls(*(torch.tensor(values, dtype=DTYPE) for values in (shift, turn, strain)))

    @property
    def _stretch(self) -> Float[Tensor, "*B 3 3"]:
        xx, yy, zz, yz, xz, xy = self.strain.unbind(-1)
        E = torch.stack([torch.stack(row, -1) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))], -2)
        return torch.eye(3, dtype=DTYPE) + E

    @property
    def matrix(self) -> Float[Tensor, "*B 3 3"]:
        """R (I + E), which multiplies p."""
        return rotate(exponential(self.turn).unsqueeze(-2), self._stretch.mT).mT

    def __call__(self, p: Float[Tensor, "... P 3"]) -> Float[Tensor, "... P 3"]:
        """Measured, of where they are."""
        return rotate(exponential(self.turn).unsqueeze(-2), p @ self._stretch.mT) + self.shift.unsqueeze(-2)

    def slopes(self, p: Float[Tensor, "... P 3"]) -> Float[Tensor, "... P 3 12"]:
        """How what is measured of p moves with shift, turn and strain: I, -hat(R (I + E) p) J, R E_k p; J: R's left Jacobian."""
        q = exponential(self.turn).unsqueeze(-2)
        stretched = rotate(q, p @ self._stretch.mT)
        w = hat(self.turn)
        angle = (self.turn * self.turn).sum(-1)[..., None, None]
        small = angle < TURN_SERIES
        phi = torch.where(small, 1.0, angle).sqrt()
        a = torch.where(small, 0.5 - angle / 24, (1 - phi.cos()) / phi**2)
        b = torch.where(small, 1 / 6 - angle / 120, (phi - phi.sin()) / phi**3)
        J = torch.eye(3, dtype=DTYPE) + a * w + b * (w @ w)
        x, y, z = (torch.nn.functional.one_hot(torch.tensor(k), 3).to(DTYPE) * p[..., k : k + 1] for k in range(3))

        def swapped(i: int, j: int) -> Tensor:
            unit = torch.eye(3, dtype=DTYPE)
            return p[..., j : j + 1] * unit[i] + p[..., i : i + 1] * unit[j]

        strained = [rotate(q, v) for v in (x, y, z, swapped(1, 2), swapped(0, 2), swapped(0, 1))]
        shift = torch.eye(3, dtype=DTYPE).expand(*p.shape, 3)
        return torch.cat([shift, -hat(stretched) @ J.unsqueeze(-3), torch.stack(strained, -1)], -1)

    def undone(self, p: Float[Tensor, "... P 3"]) -> Float[Tensor, "... P 3"]:
        """Where they are, of what was measured."""
        back = rotate(exponential(-self.turn).unsqueeze(-2), p - self.shift.unsqueeze(-2))
        return torch.linalg.solve(self._stretch, back.mT).mT


@dataclass(frozen=True)
class Found(Float64):
    """What a calibration leaves unknown: the covariance of the errors of parameters, by their names, in their units."""

    names: tuple[str, ...]
    covariance: Float[Tensor, "k k"]

    def __post_init__(self):
        super().__post_init__()
        C, k = self.covariance, len(self.names)
        if len(set(self.names)) < k:
            raise ValueError("Found.names names a parameter twice")
        if C.shape != (k, k) or not bool(torch.isfinite(C).all()) or not torch.allclose(C, C.mT, rtol=1e-6, atol=0):
            raise ValueError(f"Found.covariance must be a symmetric matrix with {k} rows of finite numbers, one for each name")
        if k and float(torch.linalg.eigvalsh(_correlation(C)).min()) < -1e-6:
            raise ValueError("Found.covariance is no covariance: it has a negative eigenvalue")


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations of a robot's parameters, each about what its file says; 0: exact.

    stiffness, mass: relative, of the whole rod (without what hangs on it at points). tension: relative, of every tendon's reading.
    friction: of every tendon's motion times mu. set: 1/m, a curvature of the whole unloaded rod, about x and about y. curvature:
    1/m, one that changes along the rod within curvature_length (m; None: a tenth of the rod): the catch-all for discs, glue, tubing
    and backlash. gravity: rad, its direction. tension_offset: N, of every reading. tendon_place: m, of every tendon in the section,
    along x and along y. metric: relative, a symmetric strain of measured positions, as of cameras whose scale is off. oval:
    relative, by how much the rod is stiffer in bending about one axis than about the one across, whichever they are, from their
    mean. found: what a calibration has left unknown, errors of the robot that come on top of the others. Errors: ValueError for
    what is no standard deviation.
    """

    stiffness: float = 0.0
    mass: float = 0.0
    tension: float = 0.0
    friction: float = 0.0
    set: float = 0.0
    curvature: float = 0.0
    curvature_length: float | None = None
    gravity: float = 0.0
    tension_offset: float = 0.0
    tendon_place: float = 0.0
    metric: float = 0.0
    oval: float = 0.0
    found: Found | None = None

    def __post_init__(self):
        for name in KINDS:
            value = getattr(self, name)
            least = value is not None and (value > 0 if name == "curvature_length" else value >= 0)
            if value is not None and not (least and value < math.inf):
                raise ValueError(f"Uncertainty.{name} is {value}; it must be a finite standard deviation, at least 0")
        for name in (*RELATIVE, "metric", "oval"):
            if (share := getattr(self, name)) > MOST_SHARE:
                raise ValueError(f"Uncertainty.{name} is {share}; it is a share, 0.05 for 5 %, and may be at most {MOST_SHARE}")

    def prepared(self, robot: Robot) -> Robot:
        """The robot with rows of its reference curvature where `curvature` bends it, so that robots compared have one grid."""
        if not self.curvature:
            return robot
        return replace(robot, rod=replace(robot.rod, reference_curvature=_with_rows(robot.rod, self._knots(robot.rod))))

    def parameters(self, robot: Robot) -> tuple[Parameter, ...]:
        """What is unknown of a robot; that of tendons where it has some, mass and gravity where it has weight.

        Errors: ValueError where a calibration has found a parameter that the robot has not, or where a strip has less than `oval`.
        """
        stated = {p.name: p for p in self._of(robot, {name: getattr(self, name) for name in KINDS}) if p.std}
        if self.oval and self.oval >= (soft := robot.rod.softer_side):
            raise ValueError(f"Uncertainty.oval is {self.oval}, more than the rod's softer side has, {soft:.2g} EI; state less")
        if self.found is None:
            return tuple(stated.values())
        every = every_parameter(robot)
        if missing := [name for name in self.found.names if name not in every]:
            raise ValueError(f"the robot has no {missing[0]}, which was calibrated; calibrate it again")
        names = list(dict.fromkeys([*stated, *self.found.names]))
        std = {name: stated[name].std if name in stated else 0.0 for name in names}
        own = dict(zip(self.found.names, self.found.covariance.diagonal().tolist(), strict=True))
        every |= stated
        return tuple(replace(every[name], std=math.sqrt(std[name] ** 2 + own.get(name, 0.0))) for name in names)

    def root(self, robot: Robot) -> Float[Tensor, "k k"]:
        """L with L L^T the covariance of the errors of `parameters`: errors are L xi, xi ~ N(0, 1) what is unknown of a sample."""
        listed = self.parameters(robot)
        std = torch.tensor([p.std for p in listed], dtype=DTYPE)
        if self.found is None or not listed:
            return torch.diag(std)
        at = torch.tensor([[p.name for p in listed].index(name) for name in self.found.names], dtype=torch.int64)
        C = torch.diag(std**2)
        C[at.unsqueeze(-1), at] += self.found.covariance - torch.diag(self.found.covariance.diagonal())
        return std.unsqueeze(-1) * torch.linalg.cholesky(_correlation(C) + NONE * torch.eye(len(C), dtype=DTYPE))

    def found_at(self, robot: Robot, errors: Mapping[str, float]) -> tuple[Robot, Warp]:
        """The robot with errors by their names, as a fit has found them, and how it is measured; names of others are left aside."""
        sides, turn = (torch.tensor([errors.get(name, 0.0) for name in names], dtype=DTYPE) for names in (OVAL, GRAVITY))
        most, off = robot.rod.softer_side, robot
        for parameter in self.parameters(robot):
            error = errors.get(parameter.name, 0.0)
            if error and parameter.change is not None and parameter.name not in (*OVAL, *GRAVITY):
                off = parameter.change(off, error)
        if bool(sides.any()):  # those of a pair act at once
            off = _ovals(off, *within(sides, most)[0].tolist())
        return replace(off, gravity=turned_gravity(off.gravity, turn)[0]) if bool(turn.any()) else off, Warp.of(errors)

    def _of(self, robot: Robot, std: dict[str, float]) -> list[Parameter]:
        """All that a robot has, with these standard deviations of their kinds."""
        heavy = not robot.weightless
        found = [Parameter("mass", "1", std["mass"], _mass)] if heavy and bool(robot.rod.mass_per_length > 0) else []
        found.append(Parameter("stiffness", "1", std["stiffness"], _stiffness))
        found += [Parameter(f"oval_{k + 1}", "1", std["oval"], _oval(k)) for k in range(2)]
        for j in range(len(robot.tendons)):
            found += [
                Parameter(f"tension_{j + 1}", "1", std["tension"], _tension(j)),
                Parameter(f"tension_offset_{j + 1}", "N", std["tension_offset"], _tension_offset(j)),
                Parameter(f"friction_{j + 1}", "1", std["friction"], _friction(j)),
                *(Parameter(f"tendon_{x}_{j + 1}", "m", std["tendon_place"], _tendon_place(j, k)) for k, x in enumerate("xy")),
            ]
        found += [Parameter(f"gravity_{k + 1}", "rad", std["gravity"], _gravity(k)) for k in range(2)] if heavy else []
        for axis, name in enumerate("xy"):
            found.append(Parameter(f"set_{name}", "1/m", std["set"], _curvature(axis, None)))
            knots = self._knots(robot.rod) if std["curvature"] else []
            for k in range(len(knots)):
                found.append(Parameter(f"curvature_{name}_{k + 1}", "1/m", std["curvature"], _curvature(axis, (knots, k))))
        return found + [Parameter(name, "1", std["metric"]) for name in STRAIN]

    def _knots(self, rod: Rod) -> list[float]:
        count = max(1, round(rod.length / (self.curvature_length or rod.length / KNOTS)))
        return torch.linspace(0, rod.length, count + 1, dtype=DTYPE).tolist()


KINDS = tuple(field.name for field in fields(Uncertainty) if field.name != "found")


def every_parameter(robot: Robot) -> dict[str, Parameter]:
    """By its name, all that can be the same in all samples, the base frame's error included; of unit standard deviations."""
    found = Uncertainty()._of(robot, dict.fromkeys(KINDS, 1.0) | {"curvature": 0.0})
    return {p.name: p for p in found if not p.seen} | {
        name: Parameter(name, "m" if name in SHIFT else "rad", 1.0) for name in (*SHIFT, *TURN)
    }


def _correlation(C: Float[Tensor, "k k"]) -> Float[Tensor, "k k"]:
    d = C.diagonal().clamp(min=1e-300).sqrt()
    return C / d / d.unsqueeze(-1)


def positive(share: Float[Tensor, "..."]) -> tuple[Float[Tensor, "..."], Float[Tensor, "..."]]:
    """A share x of a stiffness, which stays positive: l^2 / (2 l - x) below l = LEAST, where it goes on smoothly; its slope."""
    room = (2 * LEAST - share).clamp(min=LEAST)
    low = share < LEAST
    return torch.where(low, LEAST**2 / room, share), torch.where(low, LEAST**2 / room**2, 1.0)


def within(sides: Float[Tensor, "... 2"], most: float) -> tuple[Float[Tensor, "... 2"], Float[Tensor, "... 2 2"]]:
    """Two errors x of a section that is oval, whose size stays below `most`; their slopes.

    What is left of the softer side, the share 1 - b with b = |x| / most, is `positive`.
    """
    size = (sides * sides).sum(-1, keepdim=True) / most**2
    far = size > (1 - LEAST) ** 2
    b = torch.where(far, size, 1.0).sqrt()
    left, slope = positive(1 - b)
    f, df = torch.where(far, (1 - left) / b, 1.0), torch.where(far, (slope - (1 - left) / b) / b**2, 0.0)
    bent = (df / most**2).unsqueeze(-1) * sides.unsqueeze(-1) * sides.unsqueeze(-2)
    return sides * f, f.unsqueeze(-1) * torch.eye(2, dtype=sides.dtype) + bent


def turned_gravity(g: Vector, turn: Float[Tensor, "... 2"]) -> tuple[Vector, Float[Tensor, "... 3 2"]]:
    """Gravity turned by |turn| (rad), towards two axes a that are normal to it and to each other; its slopes.

    g' = cos |e| g + |g| sin |e| / |e| (e_1 a_1 + e_2 a_2)
    """
    # Of sizes to a half of the largest, so that directions that are nearly alike have the same axes.
    coarse = (2 * g.abs() / g.abs().amax(-1, keepdim=True)).round()
    least = torch.nn.functional.one_hot(coarse.argmin(-1), 3).to(g.dtype)
    size, first = g.norm(dim=-1, keepdim=True), torch.linalg.cross(g, least)
    first = first * (size / first.norm(dim=-1, keepdim=True))
    axes = torch.stack([first, torch.linalg.cross(g, first) / size], -1)
    angle = (turn * turn).sum(-1, keepdim=True)
    small = angle < TURN_SERIES
    phi = torch.where(small, 1.0, angle).sqrt()
    cos = torch.where(small, 1 - angle / 2 + angle * angle / 24, phi.cos())
    sinc = torch.where(small, 1 - angle / 6 + angle * angle / 120, phi.sin() / phi)
    dsinc = torch.where(small, angle / 30 - 1 / 3, (phi.cos() - phi.sin() / phi) / phi**2)  # per turn
    towards = (axes * turn.unsqueeze(-2)).sum(-1)
    slopes = sinc.unsqueeze(-1) * axes + (dsinc * towards - sinc * g).unsqueeze(-1) * turn.unsqueeze(-2)
    return cos * g + sinc * towards, slopes


def _stiffness(robot: Robot, error: float) -> Robot:
    rod, share = robot.rod, float(positive(torch.tensor(1 + error, dtype=DTYPE))[0])
    return replace(robot, rod=replace(rod, K_se=share * rod.K_se, K_bt=share * rod.K_bt))


def _oval(k: int) -> Change:
    return lambda robot, error: _ovals(robot, *((error, 0.0) if k == 0 else (0.0, error)))


def _ovals(robot: Robot, first: float, second: float) -> Robot:
    """Stiffer in bending about one axis of the section than about the one across: about x than y, and halfway between."""
    rod, sides = robot.rod, torch.tensor([[first, second, 0.0], [second, -first, 0.0], [0.0, 0.0, 0.0]], dtype=DTYPE)
    return replace(robot, rod=replace(rod, K_bt=rod.K_bt + rod.bending_stiffness * sides))


def _mass(robot: Robot, error: float) -> Robot:
    return replace(robot, rod=replace(robot.rod, mass_per_length=(1 + error) * robot.rod.mass_per_length))


def _of_tendon(j: int, changed: Callable[[Tendon, float], Tendon]) -> Change:
    def change(robot: Robot, error: float) -> Robot:
        tendons = list(robot.tendons.tendons)
        tendons[j] = changed(tendons[j], error)
        return replace(robot, tendons=Tendons(tuple(tendons)))

    return change


def _tension(j: int) -> Change:
    return _of_tendon(j, lambda own, error: replace(own, tension_gain=(1 + error) * own.tension_gain))


def _tension_offset(j: int) -> Change:
    return _of_tendon(j, lambda own, error: replace(own, tension_offset=own.tension_offset + error))


def _friction(j: int) -> Change:
    return _of_tendon(j, lambda own, error: replace(own, friction=own.friction * own.motion + error, motion=1.0))


def _tendon_place(j: int, axis: int) -> Change:
    def moved(own: Tendon, error: float) -> Tendon:
        shift = (error, 0.0) if axis == 0 else (0.0, error)
        return replace(own, routing=tuple((s, x + shift[0], y + shift[1]) for s, x, y in own.routing))

    return _of_tendon(j, moved)


def _gravity(k: int) -> Change:
    def change(robot: Robot, error: float) -> Robot:
        turn = torch.tensor([error, 0.0] if k == 0 else [0.0, error], dtype=DTYPE)
        return replace(robot, gravity=turned_gravity(robot.gravity, turn)[0])

    return change


def _curvature(axis: int, bump: tuple[list[float], int] | None) -> Change:
    """About an axis of the section, everywhere or, as a hat between its neighbours, at one of the knots."""

    def change(robot: Robot, error: float) -> Robot:
        rows = robot.rod.reference_curvature.clone()
        if bump is None:
            rows[:, 1 + axis] += error
        else:
            knots, k = torch.tensor(bump[0], dtype=DTYPE), bump[1]
            hat = torch.zeros_like(knots).index_fill(0, torch.tensor([k]), 1.0)
            rows[:, 1 + axis] += error * _interpolated(rows[:, 0], knots, hat)
        return replace(robot, rod=replace(robot.rod, reference_curvature=rows))

    return change


def _interpolated(s: Float[Tensor, " n"], at: Float[Tensor, " k"], values: Float[Tensor, " k"]) -> Float[Tensor, " n"]:
    """Linear between places that increase, constant beyond."""
    i = torch.searchsorted(at.contiguous(), s.contiguous()).clamp(1, len(at) - 1)
    share = ((s - at[i - 1]) / (at[i] - at[i - 1])).clamp(0, 1)
    return values[i - 1] + share * (values[i] - values[i - 1])


def _with_rows(rod: Rod, places: list[float]) -> Float[Tensor, "rows 4"]:
    """The reference curvature with a row at each of the places, jumps kept."""
    rows, every = rod.reference_curvature, torch.tensor(places, dtype=DTYPE)
    if len(rows) == 1:  # the same everywhere, whatever place it stands at
        return torch.cat([every.unsqueeze(-1), rows[:, 1:].expand(len(every), 3)], -1)
    new = every[(rows[:, 0].unsqueeze(-1) - every).abs().amin(0) > 1e-9 * rod.length]
    rows = torch.cat([rows, torch.cat([new.unsqueeze(-1), rod.curvature_at(new, new)], -1)])
    return rows[rows[:, 0].argsort(stable=True)]
