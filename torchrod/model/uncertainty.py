"""What is only nearly known of a robot: its parameters with standard deviations, unknowns of every sample with these as priors.

A robot is never quite as its file says. Where a fit takes it as exact, what its error does to the shape passes for a load; with the
error unknown, within what is known of it, intervals hold (docs/trust.md). The model is a parabola in each error,

    (1)  h(x, theta) = h(x, 0) + sum_k theta_k (h_k+ - h_k-) / 2 + theta_k^2 (h_k+ + h_k- - 2 h(x, 0)) / 2,    theta_k ~ N(0, 1)

through h(x, 0) and h_k+-, of a robot whose parameter k is off by one standard deviation upwards and downwards; the errors of two
parameters act side by side. dh/dx follows by the same parabola. Of a stiffness that may be off by more than WIDE the slope of a
parabola is off by WIDE^2, which markers take for knowledge of it: it has a quartic, through FAR deviations (or NEAR) as well, and
two of them have mixed terms up to theta_i^2 theta_j^2, through robots that are off by both. Where a calibration has found errors
that are correlated, theta_k moves all of them along a column of a root of their covariance, by a parabola.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from ..mechanics.lie import hat
from ..mechanics.robot import Robot
from ..mechanics.rod import Rod
from ..mechanics.tendons import Tendon, Tendons
from ..util.precision import DTYPE, Float64

MOST_SHARE = 0.5  # of a number whose error is relative: with more, one standard deviation leaves next to nothing of it
KNOTS = 10  # pieces of the length over which an error of the curvature is one, where no length is stated
RELATIVE = ("stiffness", "mass", "tension")  # errors that are shares of a number
OF_TENDONS = ("tension", "tension_offset", "friction", "tendon_place")
SHIFT, TURN = (tuple(f"frame_{kind}{axis}" for axis in "xyz") for kind in ("", "turn_"))  # entries of a Warp
STRAIN = tuple(f"metric_{axes}" for axes in ("xx", "yy", "zz", "yz", "xz", "xy"))
MOST_MIXED = 4  # stiffnesses, of which all pairs have a mixed term
WIDE, OF_STIFFNESS = 0.04, ("stiffness", "oval")  # a share, and whose
FAR, NEAR = 2.0, 0.5  # deviations: where a quartic goes through beside one, if that leaves half of the stiffness or not
CORNER = 1.5  # deviations, of both of a pair that goes FAR
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
    of cameras is off.
    """

    shift: Float[Tensor, " 3"]
    turn: Float[Tensor, " 3"]
    strain: Float[Tensor, " 6"]

    @classmethod
    def of(cls, entries: dict[str, float]) -> "Warp":
        """From errors by their names; those that are none of its own are left aside."""
        shift, turn, strain = ([entries.get(name, 0.0) for name in names] for names in (SHIFT, TURN, STRAIN))
        return cls(*(torch.tensor(values, dtype=DTYPE) for values in (shift, turn, strain)))

    @cached_property
    def matrix(self) -> Float[Tensor, "3 3"]:
        """What multiplies p."""
        xx, yy, zz, yz, xz, xy = self.strain
        E = torch.stack([torch.stack(row) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))])
        R = torch.linalg.matrix_exp(hat(self.turn))
        return R @ (torch.eye(3, dtype=DTYPE) + E)

    def __call__(self, p: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3"]:
        """Measured, of where they are."""
        return p @ self.matrix.mT + self.shift

    def undone(self, p: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3"]:
        """Where they are, of what was measured."""
        return torch.linalg.solve(self.matrix, (p - self.shift).unsqueeze(-1)).squeeze(-1)


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

    def wide(self, robot: Robot) -> tuple[float, ...]:
        """How many deviations off the quartic of every unknown xi goes through, 0 where a parabola does: FAR of a section that is
        oval, of which any direction of the two errors is as likely. Errors that a calibration has mixed keep their parabola, along
        which a shape that nothing explains runs far.
        """
        if self.found is not None:
            return (0.0,) * len(self.parameters(robot))
        found = []
        for p in self.parameters(robot):
            kind = p.name.split("_")[0]
            far = FAR if kind == "oval" and FAR * p.std <= MOST_SHARE * robot.rod.softer_side else NEAR
            found.append(far if kind in OF_STIFFNESS and p.std > WIDE else 0.0)
        return tuple(found)

    def nearby(self, robot: Robot) -> list[tuple[Robot, Warp | None]]:
        """Robots off by one of every unknown xi, upwards and downwards, in turn, and farther where that is wide; then by both of
        every `mixed` pair; and how they are measured.
        """
        columns, wide = self.root(robot).mT, self.wide(robot)
        shares = [(k, share) for k, far in enumerate(wide) for share in ((1.0, -1.0, far, -far) if far else (1.0, -1.0))]
        every = [share * columns[k] for k, share in shares]
        every += [a * columns[i] + b * columns[j] for i, j in mixed(wide) for a, b in _corners(wide, i, j)]
        return [self._off_by(robot, errors.tolist()) for errors in every]

    def _off_by(self, robot: Robot, errors: list[float]) -> tuple[Robot, Warp | None]:
        """The robot with errors of all its parameters, and how it is measured."""
        listed = self.parameters(robot)
        seen = {p.name: error for p, error in zip(listed, errors, strict=True) if p.seen and error}
        for parameter, error in zip(listed, errors, strict=True):
            robot = parameter.change(robot, error) if error and parameter.change is not None else robot
        return robot, Warp.of(seen) if seen else None

    def found_at(self, robot: Robot, errors: Mapping[str, float]) -> tuple[Robot, Warp]:
        """The robot with errors by their names, as a fit has found them, and how it is measured; names of others are left aside."""
        for parameter in self.parameters(robot):
            error = errors.get(parameter.name, 0.0)
            robot = parameter.change(robot, error) if error and parameter.change is not None else robot
        return robot, Warp.of(dict(errors))

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


def _stiffness(robot: Robot, error: float) -> Robot:
    rod = robot.rod
    return replace(robot, rod=replace(rod, K_se=(1 + error) * rod.K_se, K_bt=(1 + error) * rod.K_bt))


def _oval(k: int) -> Change:
    """Stiffer in bending about one axis of the section than about the one across: about x than y (k = 0), or halfway between."""
    shape = torch.tensor(
        [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 0.0]] if k == 0 else [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0] * 3]
    )

    def change(robot: Robot, error: float) -> Robot:
        rod = robot.rod
        return replace(robot, rod=replace(rod, K_bt=rod.K_bt + error * rod.bending_stiffness * shape.to(DTYPE)))

    return change


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
    """Turned about one of two axes normal to it."""

    def change(robot: Robot, error: float) -> Robot:
        g = robot.gravity
        # Of sizes to a half of the largest, so that a small turn does not choose another axis.
        coarse = (2 * g.abs() / g.abs().amax(-1, keepdim=True)).round()
        least = torch.nn.functional.one_hot(coarse.argmin(-1), 3).to(g.dtype)
        first = torch.linalg.cross(g, least)
        first = first * (g.norm(dim=-1, keepdim=True) / first.norm(dim=-1, keepdim=True))
        across = first if k == 0 else torch.linalg.cross(g, first) / g.norm(dim=-1, keepdim=True)
        return replace(robot, gravity=math.cos(error) * g + math.sin(error) * across)

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


def near_zero(
    at_zero: Float[Tensor, "B z *m"], off: Iterable[Float[Tensor, "B z *m"]], theta: Float[Tensor, "B k"], wide: Sequence[float]
) -> tuple[Float[Tensor, "B z *m"], list[Float[Tensor, "B z *m"]]]:
    """(1), and its derivatives by each theta, from the values at zero and at what `nearby` has of each, in turn."""
    others, value, slopes, parts = iter(off), at_zero.clone(), [], []
    each = [t.reshape(-1, *[1] * (at_zero.ndim - 1)) for t in theta.unbind(-1)]
    for t, far in zip(each, wide, strict=True):
        up, down = next(others), next(others)
        odd, even = 0.5 * (up - down), 0.5 * (up + down) - at_zero
        cubic, quartic, slope = 0.0, 0.0, odd
        if far:
            up, down = next(others), next(others)
            cubic = (0.5 * (up - down) / far - odd) / (far**2 - 1)
            quartic = ((0.5 * (up + down) - at_zero) / far**2 - even) / (far**2 - 1)
            odd, even = odd - cubic, even - quartic
            value.addcmul_(t**3, cubic).addcmul_(t**4, quartic)
            slope = odd + 3 * t**2 * cubic + 4 * t**3 * quartic
        value.addcmul_(t, odd).addcmul_(t**2, even)
        slopes.append(slope + 2 * t * even)
        parts.append((odd, even, cubic, quartic))
    for i, j in mixed(wide):
        a, b, c = each[i], each[j], _corners(wide, i, j)[0][0]
        pp, pm, mp, mm = (next(others) for _ in range(4))
        (odd_i, even_i), (odd_j, even_j) = (
            (odd * c + cubic * c**3, even * c**2 + quartic * c**4) for odd, even, cubic, quartic in (parts[i], parts[j])
        )
        ab, aab = 0.25 * (pp - pm - mp + mm) / c**2, (0.25 * (pp - pm + mp - mm) - odd_j) / c**3
        abb, aabb = (0.25 * (pp + pm - mp - mm) - odd_i) / c**3, (0.25 * (pp + pm + mp + mm) - at_zero - even_i - even_j) / c**4
        value.addcmul_(a * b, ab + a * aab + b * abb + (a * b) * aabb)
        slopes[i].addcmul_(b, ab + 2 * a * aab + b * abb + 2 * (a * b) * aabb)
        slopes[j].addcmul_(a, ab + a * aab + 2 * b * abb + 2 * (a * b) * aabb)
    return value, slopes


def _corners(wide: Sequence[float], i: int, j: int) -> list[tuple[float, float]]:
    """By how many deviations both of a pair are off at its four robots: it has all terms up to theta_i^2 theta_j^2."""
    c = CORNER if min(wide[i], wide[j]) == FAR else 1.0
    return [(c, c), (c, -c), (-c, c), (-c, -c)]


def mixed(wide: Sequence[float]) -> list[tuple[int, int]]:
    """Pairs of wide ones; none where there are more than MOST_MIXED of these."""
    at = [k for k, far in enumerate(wide) if far]
    return list(itertools.combinations(at, 2)) if len(at) <= MOST_MIXED else []
