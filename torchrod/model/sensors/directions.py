"""Directions: the axis of sensors on the rod, with or without their position, such as electromagnetic coils (5-DoF)."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...mechanics.lie import Matrix, Vector, cross, logarithm, matvec, rotate
from ...util.precision import Float64
from .sensor import RodState, as_numbers, check_noise, check_units, normals, rows_of, shape_error, variance

OPPOSITE = 1e-12  # 1 + cosine: below it two directions are opposite, and the way from one to the other could be any


@dataclass(frozen=True)
class Directions(Float64):
    """Measured axes of P sensors on B samples, R(s) a, and, where they are read, their positions p(s) + R(s) r.

    s: (P,) m. directions: (B, P, 3), unit vectors in the base frame, NaN where missing. angle_noise (rad): standard deviation of
    each of the two angles by which a direction is off. axes: (P, 3), a, the sensors' axes in the section frame; None: all are the
    tangent's, e3. positions: (B, P, 3) m, base frame, NaN where missing, or None; noise (m): standard deviation of a coordinate;
    offsets: (P, 3) m, r in the section frame. Noises are one number or one for each sample (B,).

    Two rows for each direction: the rotation vector (rad) from what was read to R(s) a, in two axes normal to what was read, so
    that their reading is 0; three for each position. Errors: ValueError of `check`.
    """

    s: Float[Tensor, " P"]
    directions: Float[Tensor, "B P 3"]
    angle_noise: float | Float[Tensor, " B"]
    axes: Float[Tensor, "P 3"] | None = None
    positions: Float[Tensor, "B P 3"] | None = None
    noise: float | Float[Tensor, " B"] | None = None
    offsets: Float[Tensor, "P 3"] | None = None

    def __post_init__(self):
        super().__post_init__()
        as_numbers(self, "angle_noise", "noise")

    @property
    def _each(self) -> int:
        """Rows for each sensor."""
        return 2 if self.positions is None else 5

    @property
    def rows(self) -> int:
        """Two for each sensor, five with its position."""
        return self._each * len(self.s)

    @property
    def groups(self) -> Int[Tensor, " rows"]:
        """A sensor's rows."""
        return torch.arange(len(self.s)).repeat_interleave(self._each)

    @property
    def present(self) -> Bool[Tensor, "B P 2"]:
        """Whether the position and the direction of each sensor were read."""
        turned = torch.isfinite(self.directions).all(-1)
        placed = torch.zeros_like(turned) if self.positions is None else torch.isfinite(self.positions).all(-1)
        return torch.stack([placed, turned], -1)

    def predict(self, rod: RodState) -> Float[Tensor, "... rows"]:
        """[p(s) + R(s) r, the angles from what was read to R(s) a] for each sensor."""
        a = rotate(rod.q, rod.q.new_tensor([0.0, 0.0, 1.0]) if self.axes is None else self.axes)
        read = torch.where(torch.isfinite(self.directions), self.directions, self.directions.new_tensor([0.0, 0.0, 1.0]))
        way = torch.cat([cross(read, a), 1 + (read * a).sum(-1, keepdim=True)], -1)
        turn = logarithm(way / (way * way).sum(-1, keepdim=True).clamp(min=OPPOSITE).sqrt())
        angles = torch.stack([(turn * normal).sum(-1) for normal in normals(read)], -1)
        if self.positions is None:
            return angles.flatten(-2)
        p = rod.p if self.offsets is None else rod.p + rotate(rod.q, self.offsets)
        return torch.cat([p, angles], -1).flatten(-2)

    @property
    def reading(self) -> Float[Tensor, "B rows"]:
        """The positions (m), and zero for every direction that was read."""
        turn = torch.where(self.present[..., 1:], 0.0, torch.nan).expand(-1, -1, 2)
        return (turn if self.positions is None else torch.cat([self.positions, turn], -1)).flatten(1)

    @property
    def weights(self) -> Float[Tensor, "B rows"]:
        """1 / noise^2 and 1 / angle_noise^2."""
        placed, turned = self.present.to(self.s.dtype).unbind(-1)
        w = (turned / variance(self.angle_noise)).unsqueeze(-1).expand(-1, -1, 2)
        if self.positions is None or self.noise is None:
            return w.flatten(1)
        return torch.cat([(placed / variance(self.noise)).unsqueeze(-1).expand(-1, -1, 3), w], -1).flatten(1)

    def distances(self, rows: Float[Tensor, "B rows"]) -> Float[Tensor, "B K 3"]:
        """Those of the positions."""
        return rows.new_empty(len(rows), 0, 3) if self.positions is None else rows.unflatten(-1, (-1, 5))[..., :3]

    def take(self, index: Int[Tensor, " b"]) -> "Directions":
        """The samples of an index."""
        return replace(self, **rows_of(self, index, "directions", "angle_noise", "positions", "noise"))

    def without(self, groups: Bool[Tensor, "B G"]) -> "Directions":
        """The sensors of these groups not read."""
        gone = groups.unsqueeze(-1)
        placed = None if self.positions is None else self.positions.masked_fill(gone, torch.nan)
        return replace(self, directions=self.directions.masked_fill(gone, torch.nan), positions=placed)

    def moved(self, R: Matrix, t: Vector) -> "Directions":
        """The directions and positions in the frame p' = R p + t."""
        placed = None if self.positions is None else matvec(R, self.positions) + t
        return replace(self, directions=matvec(R, self.directions), positions=placed)

    def check(self) -> None:
        """Shapes that belong together, unit vectors, noises, a noise where there are positions."""
        P, B = self.s.numel(), len(self.directions)
        wanted = {"s": (P,), "directions": (B, P, 3), "angle_noise": (B,), "axes": (P, 3), "positions": (B, P, 3), "noise": (B,)}
        if said := shape_error(self, wanted | {"offsets": (P, 3)}):
            raise ValueError(f"{said} with {P} arc lengths and {B} samples")
        if not P or not B:
            raise ValueError("there are no directions; give at least one sample with one sensor")
        check_units("Directions.directions", self.directions, "unit vectors")
        check_units("Directions.axes", self.axes, "unit vectors")
        check_noise("Directions.angle_noise", self.angle_noise, "rad")
        if (self.positions is None) != (self.noise is None):
            raise ValueError("Directions takes positions and their noise (m) together; give both or neither")
        if self.noise is not None:
            check_noise("Directions.noise", self.noise, "m")
