"""Unloaded shapes: what calibration seeks, and the model h(theta) of what all markers of all samples show of it.

All shapes share one unknown,

    (1)  theta = [log rho, (log k), (o_1 / O_1 .. o_T / O_T)]        k scales K_se and K_bt, o_j (N) corrects tendon j's readings

and the state is theta alone, with the markers of ALL samples stacked into one measurement z. h(theta) is the forward solve of every
sample, p(s_i) + R(s_i) r_i at its tensions; there is no tip residual, because the forward solve is in equilibrium exactly.
O_j is the largest reading of tendon j, so that every entry of theta has unit size.

    (2)  Dividing the strain balance by k: a rod of stiffness k K under tau and rho g has the shape of one of stiffness K under
         tau / k and rho g / k.

so one batch serves every trial theta and the Jacobian's differences, whatever they move; and without tension only rho / k is seen.
The Jacobian is by central differences: with the forward solve's residual of 1e-11 rad and STEP = 1e-4 it is good to 1e-7.

    (3)  tau = max(reading + o, 0) has a kink at o = -reading, and a reading of zero puts one where the search starts. A step that
         would cross a kink ends on it; there the column of H is the slope on the side where the cost falls, and zero where it falls
         on neither: then the kink is the minimum.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..estimation import filter as ekf
from ..estimation.solve import CHUNK
from ..mechanics.lie import rotate
from ..mechanics.robot import Robot
from ..mechanics.statics import solve_shape
from ..mechanics.tendons import Tendons
from ..model.sensors import Markers
from ..util.precision import DTYPE

STEP = 1e-4  # of the central differences, in units of theta
PRIOR = 1e-2  # precision: +- 10 units about the start, which only keeps unobservable directions finite
FIRST_SAG = 0.05  # where the file has no mass: the tip of the straight rod, held across gravity, sags by this part of its length
MASS, STIFFNESS, OFFSET = "mass_per_length", "stiffness_factor", "tension_offset_"


@dataclass(frozen=True)
class Trial:
    """The model at one theta: its normal equations as a batch of 1, residuals r with weights w, and the samples that have an
    equilibrium.

    A_mean: H^T W H with the mean slope at a kink (3), the sensitivity that the covariance is made of.
    """

    normal: ekf.Normal
    A_mean: Float[Tensor, "1 n n"]
    r: Float[Tensor, "1 z"]
    w: Float[Tensor, "1 z"]
    solved: Bool[Tensor, " B"]


@dataclass(frozen=True)
class UnloadedShapes:
    """theta, and what the markers of all samples show of it. weights (B, P) 1/m^2, zero where a marker is missing."""

    robot: Robot
    markers: Markers
    tension: Float[Tensor, "B T"] | None
    weights: Float[Tensor, "B P"]
    stiffness: bool
    offsets: bool
    steps: int

    @property
    def names(self) -> tuple[str, ...]:
        """The unknowns, in the order of theta."""
        tendons = len(self.robot.tendons) if self.offsets else 0
        return (MASS, *([STIFFNESS] if self.stiffness else []), *(f"{OFFSET}{j + 1}" for j in range(tendons)))

    @property
    def logarithmic(self) -> Bool[Tensor, " n"]:
        """Which entries of theta are logarithms."""
        return torch.tensor([not name.startswith(OFFSET) for name in self.names])

    @property
    def unit(self) -> Float[Tensor, " n"]:
        """The size of one unit of theta: 1 for a logarithm, O_j (N) for an offset."""
        one = torch.ones(1 + self.stiffness, dtype=DTYPE)
        if not self.offsets or self.tension is None:
            return one
        largest = self.tension.nan_to_num(0.0).amax(0)
        return torch.cat([one, torch.where(largest > 0, largest, self.robot.rod.force_scale)])

    def before(self) -> Float[Tensor, " n"]:
        """The robot file's values."""
        offsets = [t.tension_offset for t in self.robot.tendons.tendons] if self.offsets else []
        return torch.tensor([float(self.robot.rod.mass_per_length), *([1.0] if self.stiffness else []), *offsets], dtype=DTYPE)

    def start(self) -> Float[Tensor, " n"]:
        """theta of the robot file; without a mass there, of one that lets the tip sag: rho g L^4 / (8 EI) = FIRST_SAG L."""
        before, rod = self.before(), self.robot.rod
        if before[0] == 0:
            before[0] = 8 * FIRST_SAG * rod.bending_stiffness / (rod.length**3 * float(self.robot.gravity.norm(dim=-1).max()))
        return torch.where(self.logarithmic, before.clamp(min=1e-300).log(), before / self.unit)

    def physical(self, theta: Float[Tensor, "... n"]) -> Float[Tensor, "... n"]:
        """rho (kg/m), k (-), o (N)."""
        return torch.where(self.logarithmic, theta.exp(), theta * self.unit)

    def seen(self, theta: Float[Tensor, "M n"]) -> Float[Tensor, "M B P 3"]:
        """The markers (m, base frame) of every sample under M trial thetas, by (2); NaN where there is no equilibrium."""
        index = torch.arange(len(self.markers.positions)).split(max(1, CHUNK * 4 // len(theta)))
        return torch.cat([self._seen(theta, i) for i in index], 1)

    def _seen(self, theta: Float[Tensor, "M n"], index: Tensor) -> Float[Tensor, "M b P 3"]:
        M, b, robot, value = len(theta), len(index), self.robot, self.physical(theta)
        k = value[:, 1, None] if self.stiffness else value.new_ones(M, 1)
        g = robot.gravity.expand(len(self.markers.positions), 3)[index]
        weight = (value[:, :1] / k)[..., None] * g
        tension = None
        if self.tension is not None:
            o = value[:, 1 + self.stiffness :] if self.offsets else self._known_offsets()
            tension = ((self.tension[index] + o.unsqueeze(-2)) / k.unsqueeze(-1)).flatten(0, 1)
        plain = Tendons(tuple(replace(t, tension_offset=0.0) for t in robot.tendons.tendons))
        none = robot.rod.masses[:0]
        rod = replace(robot.rod, mass_per_length=torch.ones((), dtype=DTYPE), masses=none)
        trial = Robot(rod, plain, weight.flatten(0, 1))
        points = (replace(robot, gravity=(g / k.unsqueeze(-1)).flatten(0, 1)).point_weights,) if len(robot.rod.masses) else ()
        shape, offsets = solve_shape(trial, points, tension, self.markers.s, M * b, self.steps), self.markers.offsets
        p = shape.p if offsets is None else shape.p + rotate(shape.q, offsets)
        return p.unflatten(0, (M, b))

    def _known_offsets(self) -> Float[Tensor, "1 T"]:
        return torch.tensor([[t.tension_offset for t in self.robot.tendons.tendons]], dtype=DTYPE)

    def _distance(self, theta: Float[Tensor, " n"]) -> Float[Tensor, "B n"]:
        """reading + o in units of theta, whose zeros are the kinks (3); infinite for what has none."""
        B, tension = len(self.markers.positions), self.tension
        first = torch.full((B, 1 + self.stiffness), torch.inf, dtype=DTYPE)
        if not self.offsets or tension is None:
            return first
        own = slice(1 + self.stiffness, None)
        return torch.cat([first, (tension / self.unit[own] + theta[own]).nan_to_num(torch.inf)], -1)

    def stopped_at_kinks(self, theta: Float[Tensor, " n"], step: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """theta + step, where an offset that would cross kinks stops at the first of them."""
        before = self._distance(theta)
        crossed = (before.abs() > STEP) & (before * (before + step) < 0)
        room = torch.where(crossed, before.abs(), torch.inf).amin(0)
        return theta + torch.minimum(step.abs(), room) * step.sign()

    def linearize(self, theta: Float[Tensor, " n"], mean: Float[Tensor, " n"]) -> "Trial":
        """The model at theta as one stacked measurement."""
        n = len(theta)
        shift = STEP * torch.eye(n, dtype=DTYPE)
        p = self.seen(torch.cat([theta[None], theta + shift, theta - shift]))
        solved = torch.isfinite(p).flatten(2).all(-1).all(0)
        w = (self.weights * solved.unsqueeze(-1)).repeat_interleave(3, -1).reshape(1, -1)
        z, h, up, down = (x.reshape(-1, w.shape[-1]) for x in (self.markers.positions, p[0], p[1 : n + 1], p[n + 1 :]))
        r = torch.where(w > 0, z - h, 0.0)
        ahead, back, H = (torch.where(w > 0, d, 0.0).mT / STEP for d in (up - h, h - down, 0.5 * (up - down)))
        precision = torch.full_like(theta, PRIOR)
        kinks = (self._distance(theta).abs() <= STEP).any(0)
        nothing = torch.zeros_like(precision)
        A_mean, g = ekf.information(H[None], r, w, theta[None], mean, nothing)
        A = A_mean
        if bool(kinks.any()):
            H = _towards_descent(H, ahead, back, kinks, lambda H: ekf.information(H[None], r, w, theta[None], mean, precision))
            A, g = ekf.information(H[None], r, w, theta[None], mean, nothing)
        # In equilibrium there is no tip residual: its half of the normal equations is zero.
        A, g, cost = (torch.stack([part, torch.zeros_like(part)], 1) for part in (A, g, (w * r * r).sum(-1)))
        normal = ekf.Normal(A, g, cost, (w > 0).sum(-1))
        return Trial(normal, A_mean, r, w, solved)


def _towards_descent(
    H: Float[Tensor, "z n"],
    ahead: Float[Tensor, "z n"],
    back: Float[Tensor, "z n"],
    kinks: Bool[Tensor, " n"],
    information: Callable[[Float[Tensor, "z n"]], ekf.Information],
) -> Float[Tensor, "z n"]:
    """H with the one-sided slopes of (3) in the columns of kinks.

    A column whose own entry of the joint step goes to the other side is zero too: its neighbours move first.
    """
    rises, falls = information(ahead)[1][0] > 0, information(back)[1][0] < 0
    side = rises.to(H.dtype) - (falls & ~rises).to(H.dtype)
    H = torch.where(kinks, torch.where(side > 0, ahead, torch.where(side < 0, back, 0.0)), H)
    for _ in kinks:
        A, g = information(H)
        step = ekf.solve_spd(A, g.unsqueeze(-1))[0, :, 0]
        against = kinks & (H != 0).any(0) & (step * side < 0)
        if not bool(against.any()):
            break
        H = torch.where(against, 0.0, H)
    return H
