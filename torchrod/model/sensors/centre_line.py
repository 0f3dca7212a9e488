"""Centre lines: points on the rod of which nobody knows the arc length, as they come from segmented images or scans."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...mechanics.lie import Matrix, Vector, matvec, rotate
from ...util.precision import Float64
from .sensor import RodState, as_numbers, check_noise, normals, rows_of, shape_error

NEWTON_STEPS = 4  # to the nearest place within a piece of the curve
ORDER_POINTS = 12  # by which the order is judged: far apart beside their noise
ORDER_SLACK = 1.25  # of the rod's length: a path through ordered points, from the base on, that is longer is none


@dataclass(frozen=True)
class CentreLine(Float64):
    """Measured points on the rod's centre line, M on each of B samples: their distance from the nearest place of the curve,

        (I - t t^T) (p(s*) - z),   two rows for each point, in axes normal to the tangent t at s*, whose reading is 0

    s: (K,) m, increasing: among these places, and between them on a cubic through positions and tangents, the nearest s* is looked
    for, anew at every evaluation and held fixed while it is differentiated. They run from one end of what can have been seen to the
    other; torch.linspace(0, L, 81) as a rule, and more where the rod winds. positions: (B, M, 3) m, base frame, NaN where missing.
    noise: standard deviation of a coordinate (m), one number or one for each sample (B,). ordered: whether the points run from the
    base to the tip, so that s* never falls; a rod that comes near itself needs that. ends: whether the first point is at s[0] and
    the last at s[-1]; such a point has a third row, along the tangent. A point beyond an end that is not known to be one counts
    across the rod only. Errors: ValueError of `check`.
    """

    s: Float[Tensor, " K"]
    positions: Float[Tensor, "B M 3"]
    noise: float | Float[Tensor, " B"]
    ordered: bool = False
    ends: tuple[bool, bool] = (False, False)

    def __post_init__(self):
        super().__post_init__()
        as_numbers(self, "noise")

    @property
    def present(self) -> Bool[Tensor, "B M"]:
        """Which points were seen."""
        return torch.isfinite(self.positions).all(-1)

    @property
    def _points(self) -> int:
        return self.positions.shape[1]

    @property
    def _at_ends(self) -> Bool[Tensor, " M"]:
        """The points that are known to be an end."""
        at = torch.zeros(self._points, dtype=torch.bool)
        at[:1], at[-1:] = self.ends[0], at[-1:] | self.ends[1]
        return at

    @property
    def rows(self) -> int:
        """Three for each point; the third is read at known ends only."""
        return 3 * self._points

    @property
    def groups(self) -> Int[Tensor, " rows"]:
        """A point's rows."""
        return torch.arange(self._points).repeat_interleave(3)

    def predict(self, rod: RodState) -> Float[Tensor, "... rows"]:
        """The distance (m) in two axes normal to the tangent, and along it."""
        z = self.positions.nan_to_num(0.0)
        m = rotate(rod.q, rod.q.new_tensor([0.0, 0.0, 1.0]))
        piece, x = self._nearest(z, rod.p.detach(), m.detach())
        h = self.s.diff()[piece].unsqueeze(-1)
        (a, b), (da, db) = _ends(rod.p, piece), _ends(m, piece)
        place, slope = _cubic(x.unsqueeze(-1), a, b, h * da, h * db)
        t = slope.detach()
        t = t / t.norm(dim=-1, keepdim=True)
        off = place - z
        return torch.stack([(off * axis).sum(-1) for axis in (*normals(t), t)], -1).flatten(-2)

    def _nearest(
        self, z: Float[Tensor, "... M 3"], p: Float[Tensor, "... K 3"], m: Float[Tensor, "... K 3"]
    ) -> tuple[Int[Tensor, "... M"], Float[Tensor, "... M"]]:
        """Which piece of the curve every point is nearest to, and where on it, from 0 to 1."""
        square = p.square().sum(-1).unsqueeze(-2) - 2 * z @ p.mT  # of the distances, less |z|^2, which all places share
        k = self._in_order(square) if self.ordered else square.argmin(-1)
        k = torch.where(self._at_ends & (torch.arange(self._points) == 0), 0, k)
        k = torch.where(self._at_ends & (torch.arange(self._points) > 0), len(self.s) - 1, k)
        onward = ((z - _at(p, k)) * _at(m, k)).sum(-1) > 0
        piece = torch.where(onward, k, k - 1).clamp(0, len(self.s) - 2)
        h = self.s.diff()[piece].unsqueeze(-1)
        (a, b), (da, db) = _ends(p, piece), _ends(m, piece)
        x = (k - piece).to(p.dtype)
        for _ in range(NEWTON_STEPS):
            place, slope = _cubic(x.unsqueeze(-1), a, b, h * da, h * db)
            x = (x + ((z - place) * slope).sum(-1) / slope.square().sum(-1)).clamp(0, 1)
        return piece, torch.where(self._at_ends, (k - piece).to(p.dtype), x)

    def _in_order(self, square: Float[Tensor, "... M K"]) -> Int[Tensor, "... M"]:
        """The places of the least sum of squares that never fall from point to point: dynamic programming."""
        square = torch.where(self.present.unsqueeze(-1), square, 0.0)
        total, before = square[..., 0, :], []
        for i in range(1, self._points):
            least, at = total.cummin(-1)
            total = least + square[..., i, :]
            before.append(at)
        k = [total.argmin(-1)]
        for at in reversed(before):
            k.append(at.gather(-1, k[-1].unsqueeze(-1)).squeeze(-1))
        return torch.stack(k[::-1], -1)

    @property
    def reading(self) -> Float[Tensor, "B rows"]:
        """Zero for what was seen."""
        return torch.where(self.weights > 0, 0.0, torch.nan).to(self.s.dtype)

    @property
    def weights(self) -> Float[Tensor, "B rows"]:
        """1 / noise^2, along the tangent at known ends only."""
        along = (self.present & self._at_ends).unsqueeze(-1)
        read = torch.cat([self.present.unsqueeze(-1).expand(-1, -1, 2), along], -1).flatten(1).to(self.s.dtype)
        return read / (self.noise.unsqueeze(-1) ** 2 if isinstance(self.noise, Tensor) else self.noise**2)

    def distances(self, rows: Float[Tensor, "B rows"]) -> Float[Tensor, "B K 3"]:
        """All of them, in axes of their own: two normal to the rod, the third along it."""
        return rows.unflatten(-1, (-1, 3))

    def take(self, index: Int[Tensor, " b"]) -> "CentreLine":
        """The samples of an index."""
        return replace(self, **rows_of(self, index, "positions", "noise"))

    def without(self, groups: Bool[Tensor, "B G"]) -> "CentreLine":
        """The points of these groups missing."""
        return replace(self, positions=self.positions.masked_fill(groups.unsqueeze(-1), torch.nan))

    def moved(self, R: Matrix, t: Vector) -> "CentreLine":
        """The points in the frame p' = R p + t."""
        return replace(self, positions=matvec(R, self.positions) + t)

    @property
    def _path(self) -> tuple[Float[Tensor, " B"], Float[Tensor, "B 2"]]:
        """How long the way through some of the points is (m), and how far from the origin the first and the last of them are."""
        some = torch.linspace(0, self._points - 1, min(ORDER_POINTS, self._points)).round().long()
        z = self.positions[:, some]
        far = z.norm(dim=-1).nan_to_num(0.0)
        return z.diff(dim=1).norm(dim=-1).nansum(-1), far[:, [0, -1]]

    def misplaced(self, sample: int) -> str:
        """What is wrong with the order of a sample's points, where they are said to be ordered; mostly nothing."""
        if not self.ordered:
            return ""
        path, far = self._path
        length, (first, last) = float(self.s[-1]), far[sample].tolist()
        if float(path[sample]) > ORDER_SLACK * length:
            return (
                f"The way through the points in their order is {float(path[sample]):.3g} m long on {length:g} m of rod: "
                "sort them from the base to the tip, or give CentreLine(ordered=False)."
            )
        if first + float(path[sample]) > ORDER_SLACK * length and last < 0.5 * first:
            return "The first point is the farthest from the base: give the points from the base to the tip."
        return ""

    def check(self) -> None:
        """Shapes that belong together, increasing places, a noise, and an order of most samples, where there is to be one."""
        B, M = len(self.positions), self._points
        if said := shape_error(self, {"s": (None,), "positions": (B, M, 3), "noise": (B,)}):
            raise ValueError(f"{said} with {M} points on {B} samples")
        if not B or not M:
            raise ValueError("there are no points; give at least one sample with points on the rod")
        if len(self.s) < 2 or not bool((self.s.diff() > 0).all()):
            raise ValueError("CentreLine.s must be at least two arc lengths (m) that increase, such as torch.linspace(0, L, 81)")
        check_noise("CentreLine.noise", self.noise, "m")
        wrong = [b for b in range(B if self.ordered else 0) if self.misplaced(b)]
        if 2 * len(wrong) > B:
            raise ValueError(f"CentreLine, {len(wrong)} of {B} samples: {self.misplaced(wrong[0])}")


def _at(x: Float[Tensor, "... K 3"], k: Int[Tensor, "... M"]) -> Float[Tensor, "... M 3"]:
    return x.gather(-2, k.unsqueeze(-1).expand(*k.shape, 3))


def _ends(x: Float[Tensor, "... K 3"], piece: Int[Tensor, "... M"]) -> tuple[Vector, Vector]:
    return _at(x, piece), _at(x, piece + 1)


def _cubic(x: Float[Tensor, "... 1"], a: Vector, b: Vector, da: Vector, db: Vector) -> tuple[Vector, Vector]:
    """Hermite's cubic from a to b with slopes da, db at x from 0 to 1, and its slope."""
    y = 1 - x
    place = y * y * ((1 + 2 * x) * a + x * da) + x * x * ((1 + 2 * y) * b - y * db)
    slope = 6 * x * y * (b - a) + y * (1 - 3 * x) * da + x * (1 - 3 * y) * db
    return place, slope
