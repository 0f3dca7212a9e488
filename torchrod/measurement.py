"""The measurement: markers on the rod, and the model h(x) of what they show.

    x = [gamma, zeta, alpha]   ->   h(x) = [p_1 .. p_P, c]

gamma are the loads (torchrod.coordinates), zeta an optional registration twist, alpha the base wrench, c the tip residual (17).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .coordinates import LoadCoordinates
from .grid import DEFAULT_STEPS
from .lie import move, rotate
from .robot import Robot
from .statics import Shape, shape_from_base

TIP_FORCE_STD = 1e-3  # in force scales: 1 mN on the paper's rod
TIP_MOMENT_STD = 5e-4  # in moment scales: 0.1 mN m on the paper's rod
TURN_SCALE = 0.1  # rad, one unit of a registration angle; a unit of translation is this part of the rod's length


@dataclass(frozen=True)
class Markers:
    """Measured markers of B samples.

    s: (P,) m, arc lengths. positions: (B, P, 3) m, base frame, NaN where a marker is missing. offsets: (P, 3) m, from the centre
    line in the section frame, so that the marker sits at p(s) + R(s) r. tension: (B, T) N for a tendon robot.
    """

    s: Float[Tensor, " P"]
    positions: Float[Tensor, "B P 3"]
    offsets: Float[Tensor, "P 3"] | None = None
    tension: Float[Tensor, "B T"] | None = None

    @property
    def present(self) -> Bool[Tensor, "B P"]:
        """Which markers were seen."""
        return torch.isfinite(self.positions).all(-1)

    def take(self, index: Int[Tensor, " b"]) -> "Markers":
        """The samples of an index."""
        return Markers(self.s, self.positions[index], self.offsets, None if self.tension is None else self.tension[index])


@dataclass(frozen=True)
class Model:
    """h(x) for one robot, one parameterization and one marker layout.

    scaled: alpha in the rod's force and moment scales and zeta in tenths of L and of a radian; otherwise in SI (the paper's).
    """

    robot: Robot
    coordinates: LoadCoordinates
    registration: bool = False
    scaled: bool = True
    steps: int = DEFAULT_STEPS

    @property
    def size(self) -> int:
        """The length of x."""
        return self.coordinates.size + 6 * self.registration + 6

    def _scale_of(self, x: Tensor, first: float, second: float) -> Tensor:
        return x.new_tensor([first] * 3 + [second] * 3) if self.scaled else x.new_ones(6)

    def split(
        self, x: Float[Tensor, "... n"]
    ) -> tuple[Float[Tensor, "... g"], Float[Tensor, "... 6"] | None, Float[Tensor, "... 6"]]:
        """gamma, zeta [m, rad] (None without registration) and alpha [N, N m]."""
        gamma, zeta, alpha = x.tensor_split([self.coordinates.size, self.size - 6], -1)
        rod = self.robot.rod
        zeta = zeta * self._scale_of(x, TURN_SCALE * rod.length, TURN_SCALE) if self.registration else None
        return gamma, zeta, alpha * self._scale_of(x, rod.force_scale, rod.moment_scale)

    def join(self, gamma: Float[Tensor, "B g"], alpha: Float[Tensor, "B 6"]) -> Float[Tensor, "B n"]:
        """x from loads and a base wrench (N, N m), with no registration error."""
        zeta = alpha.new_zeros(alpha.shape[0], 6 * self.registration)
        return torch.cat([gamma, zeta, alpha / self._scale_of(alpha, self.robot.rod.force_scale, self.robot.rod.moment_scale)], -1)

    def shape(self, x: Float[Tensor, "... n"], markers: Markers) -> Shape:
        """The rod at the markers' arc lengths, in its own base frame."""
        gamma, _, alpha = self.split(x)
        return shape_from_base(self.robot, self.coordinates.loads(gamma), alpha, markers.tension, markers.s, self.steps)

    def h(self, x: Float[Tensor, "... n"], markers: Markers) -> Float[Tensor, "... z"]:
        """[p_1 .. p_P (m), c (N, N m)], (..., 3 P + 6): marker positions in the measured frame, then the tip residual."""
        shape = self.shape(x, markers)
        p = shape.p if markers.offsets is None else shape.p + rotate(shape.q, markers.offsets)
        _, zeta, _ = self.split(x)
        if zeta is not None:
            p = move(zeta, p)
        return torch.cat([p.flatten(-2), shape.tip_residual], -1)

    def tip_weights(self, like: Tensor) -> Float[Tensor, " 6"]:
        """1 / variance of the tip residual c (1/N^2, 1/(N m)^2): stiff, so that (17) holds to a milli-force-scale."""
        rod = self.robot.rod
        return like.new_tensor([TIP_FORCE_STD * rod.force_scale] * 3 + [TIP_MOMENT_STD * rod.moment_scale] * 3) ** -2

    def weights(self, markers: Markers, noise: float) -> Float[Tensor, "B z"]:
        """The diagonal of W: 1 / noise^2 for a marker that was seen, 0 for a missing one, then the tip residual's."""
        tip = self.tip_weights(markers.s)
        seen = markers.present.to(tip.dtype).repeat_interleave(3, -1)
        return torch.cat([seen / noise**2, tip.expand(len(seen), 6)], -1)

    def prior(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Mean and precision of every entry of x: the loads' own; weak on zeta, none on alpha, which the tip residual holds."""
        mean, precision = self.coordinates.prior()
        extra = mean.new_zeros(6 * self.registration + 6)
        held = torch.cat([extra[:-6] + 1e-4, extra[-6:]])
        return torch.cat([mean, extra]), torch.cat([precision, held])
