"""What is only nearly known of a robot: its parameters with standard deviations, unknowns of every sample with these as priors.

A robot is never quite as its file says. Where a fit takes it as exact, what its error does to the shape passes for a load; with the
error unknown, within what is known of it, intervals hold (docs/trust.md). The model is a parabola in each error,

    (1)  h(x, theta) = h(x, 0) + sum_k theta_k (h_k+ - h_k-) / 2 + theta_k^2 (h_k+ + h_k- - 2 h(x, 0)) / 2,    theta_k ~ N(0, 1)

through h(x, 0) and h_k+-, of a robot whose parameter k is off by one standard deviation upwards and downwards; the errors of two
parameters act side by side. dh/dx follows by the same parabola.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..mechanics.robot import Robot
from ..mechanics.rod import Rod
from ..mechanics.tendons import Tendons
from ..util.precision import DTYPE

MOST_SHARE = 0.5  # of a number whose error is relative: with more, one standard deviation leaves next to nothing of it
KNOTS = 10  # pieces of the length over which an error of the curvature is one, where no length is stated
Tension = Float[Tensor, "B T"] | None
Change = Callable[[Robot, Tension, float], tuple[Robot, Tension]]


@dataclass(frozen=True)
class Parameter:
    """One number of a robot: name, the SI unit of its error, its standard deviation, what an error does to robot and tension."""

    name: str
    unit: str
    std: float
    change: Change


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations of a robot's parameters, each about what its file says; 0: exact.

    stiffness, mass: relative, of the whole rod. tension: relative, of every tendon's reading. friction: of every tendon's motion
    times mu. set: 1/m, a curvature of the whole unloaded rod, about x and about y. curvature: 1/m, one that changes along the rod
    within curvature_length (m; None: a tenth of the rod): the catch-all for discs, glue, tubing and backlash. gravity: rad, its
    direction. Errors: ValueError for what is no standard deviation.
    """

    stiffness: float = 0.0
    mass: float = 0.0
    tension: float = 0.0
    friction: float = 0.0
    set: float = 0.0
    curvature: float = 0.0
    curvature_length: float | None = None
    gravity: float = 0.0

    def __post_init__(self):
        for field in fields(self):
            value = getattr(self, field.name)
            least = value is not None and (value > 0 if field.name == "curvature_length" else value >= 0)
            if value is not None and not (least and value < math.inf):
                raise ValueError(f"Uncertainty.{field.name} is {value}; it must be a finite standard deviation, at least 0")
        for name in ("stiffness", "mass", "tension"):
            if (share := getattr(self, name)) > MOST_SHARE:
                raise ValueError(f"Uncertainty.{name} is {share}; it is a share, 0.05 for 5 %, and may be at most {MOST_SHARE}")

    def prepared(self, robot: Robot) -> Robot:
        """The robot with rows of its reference curvature where `curvature` bends it, so that robots compared have one grid."""
        if not self.curvature:
            return robot
        return replace(robot, rod=replace(robot.rod, reference_curvature=_with_rows(robot.rod, self._knots(robot.rod))))

    def parameters(self, robot: Robot) -> tuple[Parameter, ...]:
        """What is unknown of a robot; friction and tension where it has tendons, mass and gravity where it has weight."""
        found = []
        if self.stiffness:
            found.append(Parameter("stiffness", "1", self.stiffness, _stiffness))
        if self.mass and not robot.weightless:
            found.append(Parameter("mass", "1", self.mass, _mass))
        for j in range(len(robot.tendons)):
            if self.tension:
                found.append(Parameter(f"tension_{j + 1}", "1", self.tension, _tension(j)))
            if self.friction:
                found.append(Parameter(f"friction_{j + 1}", "1", self.friction, _friction(j)))
        if self.gravity and not robot.weightless:
            found += [Parameter(f"gravity_{k + 1}", "rad", self.gravity, _gravity(k)) for k in range(2)]
        for axis, name in enumerate("xy"):
            if self.set:
                found.append(Parameter(f"set_{name}", "1/m", self.set, _curvature(axis, None)))
            if self.curvature:
                knots = self._knots(robot.rod)
                for k in range(len(knots)):
                    found.append(Parameter(f"curvature_{name}_{k + 1}", "1/m", self.curvature, _curvature(axis, (knots, k))))
        return tuple(found)

    def _knots(self, rod: Rod) -> list[float]:
        count = max(1, round(rod.length / (self.curvature_length or rod.length / KNOTS)))
        return torch.linspace(0, rod.length, count + 1, dtype=DTYPE).tolist()


def _stiffness(robot: Robot, tension: Tension, error: float) -> tuple[Robot, Tension]:
    rod = robot.rod
    return replace(robot, rod=replace(rod, K_se=(1 + error) * rod.K_se, K_bt=(1 + error) * rod.K_bt)), tension


def _mass(robot: Robot, tension: Tension, error: float) -> tuple[Robot, Tension]:
    return replace(robot, gravity=(1 + error) * robot.gravity), tension


def _tension(j: int) -> Change:
    def change(robot: Robot, tension: Tension, error: float) -> tuple[Robot, Tension]:
        if tension is None:
            return robot, None
        factor = torch.ones(tension.shape[-1], dtype=DTYPE)
        factor[j] += error
        return robot, tension * factor

    return change


def _friction(j: int) -> Change:
    def change(robot: Robot, tension: Tension, error: float) -> tuple[Robot, Tension]:
        tendons = list(robot.tendons.tendons)
        own = tendons[j]
        tendons[j] = replace(own, friction=own.friction * own.motion + error, motion=1.0)
        return replace(robot, tendons=Tendons(tuple(tendons))), tension

    return change


def _gravity(k: int) -> Change:
    """Turned about one of two axes normal to it."""

    def change(robot: Robot, tension: Tension, error: float) -> tuple[Robot, Tension]:
        g = robot.gravity
        least = torch.nn.functional.one_hot(g.abs().argmin(-1), 3).to(g.dtype)
        first = torch.linalg.cross(g, least)
        first = first * (g.norm(dim=-1, keepdim=True) / first.norm(dim=-1, keepdim=True))
        across = first if k == 0 else torch.linalg.cross(g, first) / g.norm(dim=-1, keepdim=True)
        return replace(robot, gravity=math.cos(error) * g + math.sin(error) * across), tension

    return change


def _curvature(axis: int, bump: tuple[list[float], int] | None) -> Change:
    """About an axis of the section, everywhere or, as a hat between its neighbours, at one of the knots."""

    def change(robot: Robot, tension: Tension, error: float) -> tuple[Robot, Tension]:
        rows = robot.rod.reference_curvature.clone()
        if bump is None:
            rows[:, 1 + axis] += error
        else:
            knots, k = torch.tensor(bump[0], dtype=DTYPE), bump[1]
            hat = torch.zeros_like(knots).index_fill(0, torch.tensor([k]), 1.0)
            rows[:, 1 + axis] += error * _interpolated(rows[:, 0], knots, hat)
        return replace(robot, rod=replace(robot.rod, reference_curvature=rows)), tension

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


def parabola(
    at_zero: Float[Tensor, "... z"], off: Float[Tensor, "... z k2"], theta: Float[Tensor, "... k"]
) -> tuple[Float[Tensor, "... z"], Float[Tensor, "... z k"]]:
    """(1), and its derivative by theta, from the values at zero and at one standard deviation to either side, in turn."""
    up, down, theta = off[..., ::2], off[..., 1::2], theta.unsqueeze(-2)
    slope, curve = 0.5 * (up - down), 0.5 * (up + down) - at_zero.unsqueeze(-1)
    return at_zero + (theta * slope + theta**2 * curve).sum(-1), slope + 2 * theta * curve
