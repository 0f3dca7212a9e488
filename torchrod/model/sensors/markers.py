"""Markers: positions of points on the rod, from a tracker or a camera system."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...mechanics.lie import Matrix, Vector, cross, matvec, rotate
from ...util.precision import Float64
from .sensor import RodState, as_numbers, check_noise, shape_error


@dataclass(frozen=True)
class Markers(Float64):
    """Measured positions of P markers on B samples: p(s) + R(s) r + noise, three rows for each marker.

    s: (P,) m, arc lengths. positions: (B, P, 3) m, base frame, NaN where a marker is missing. noise: standard deviation of a
    coordinate (m), one number, one for each sample (B,) or each marker (B, P), (1, P), or (P,) where P is not B; or covariances
    (P, 3, 3) or (B, P, 3, 3) m^2, base frame, such as a stereo camera's, whose depth is the least certain. offsets: (P, 3) m, r,
    from the centre line in the section frame. s_std: (P,) m, standard deviations of the arc lengths, each marker's by itself; None:
    they are exact.

    With covariances C or s_std the rows are the deviation from what was read, whitened, so that their reading is 0:

        (1)  w (C + s_std^2 t t^T)^-1/2 (p(s) + R(s) r - z),   t = dp/ds + dR/ds r,   w^2 = trace(C) / 3

    t is held fixed while (1) is differentiated: exact where the rows vanish, and no bias elsewhere. Errors: ValueError of `check`.
    """

    s: Float[Tensor, " P"]
    positions: Float[Tensor, "B P 3"]
    noise: float | Float[Tensor, " B"] | Float[Tensor, "B P"] | Float[Tensor, "B P 3 3"]
    offsets: Float[Tensor, "P 3"] | None = None
    s_std: Float[Tensor, " P"] | None = None

    def __post_init__(self):
        super().__post_init__()
        as_numbers(self, "noise")
        if isinstance(self.noise, Tensor):
            object.__setattr__(self, "noise", _of_samples(self.noise, len(self.positions), len(self.s)))

    @property
    def present(self) -> Bool[Tensor, "B P"]:
        """Which markers were seen."""
        x, y, z = self.positions.unbind(-1)
        some = x + y + z
        return some - some == 0  # an eighth of the time of isfinite(positions).all(-1)

    @property
    def alike(self) -> bool:
        """Whether all markers of a sample have the same noise in all directions."""
        return self.isotropic and not (isinstance(self.noise, Tensor) and self.noise.ndim > 1)

    @property
    def isotropic(self) -> bool:
        """Whether every marker has the same noise in all directions, so that the rows are the positions themselves."""
        return self.s_std is None and not (isinstance(self.noise, Tensor) and self.noise.ndim > 2)

    @property
    def deviation(self) -> float | Tensor:
        """The standard deviation (m) of a marker's rows: `noise`, or w of (1); a number, (B, 1) or (B, P)."""
        if isinstance(self.noise, Tensor) and self.noise.ndim > 2:
            return (self.noise.diagonal(dim1=-2, dim2=-1).sum(-1) / 3).sqrt()
        return self.noise.unsqueeze(-1) if isinstance(self.noise, Tensor) and self.noise.ndim == 1 else self.noise

    @cached_property
    def _root(self) -> Float[Tensor, "B P 3 3"] | None:
        """C^1/2 / w, by Cholesky; the identity for a missing marker. None without covariances."""
        if not (isinstance(self.noise, Tensor) and self.noise.ndim > 2 and isinstance(w := self.deviation, Tensor)):
            return None
        there, eye = self.present[..., None, None], torch.eye(3, dtype=self.s.dtype)
        return torch.linalg.cholesky(torch.where(there, self.noise / w[..., None, None] ** 2, eye))

    @cached_property
    def _whitener(self) -> Float[Tensor, "B P 3 3"] | None:
        root = self._root
        return None if root is None else torch.linalg.solve_triangular(root, torch.eye(3, dtype=root.dtype), upper=False)

    @property
    def rows(self) -> int:
        """Three for each marker."""
        return 3 * len(self.s)

    @property
    def groups(self) -> Int[Tensor, " rows"]:
        """A marker's three rows."""
        return torch.arange(len(self.s)).repeat_interleave(3)

    def predict(self, rod: RodState) -> Float[Tensor, "... rows"]:
        """p(s) + R(s) r, or (1)."""
        p = rod.p if self.offsets is None else rod.p + rotate(rod.q, self.offsets)
        if self.isotropic:
            return p.flatten(-2)
        off = torch.where(self.present.unsqueeze(-1), p - self.positions.nan_to_num(0.0), 0.0)
        off = off if self._whitener is None else matvec(self._whitener, off)
        return (off if self.s_std is None else off - self._along(rod, off)).flatten(-2)

    def _along(self, rod: RodState, off: Float[Tensor, "... P 3"]) -> Float[Tensor, "... P 3"]:
        """What the uncertain arc lengths take of whitened deviations along a = s_std C^-1/2 t: (1 - (1 + a^2)^-1/2) a a^T / a^2."""
        assert self.s_std is not None
        v, u = rod.strains()
        t = rotate(rod.q, v if self.offsets is None else v + cross(u, self.offsets)).detach()
        a = t if self._whitener is None else matvec(self._whitener, t)
        w = self.deviation
        a = a * (self.s_std / w).unsqueeze(-1)
        size = (1 + (a * a).sum(-1, keepdim=True)).sqrt()
        return a * (a * off).sum(-1, keepdim=True) / (size * (1 + size))

    @property
    def reading(self) -> Float[Tensor, "B rows"]:
        """The positions (m), or zero for every marker that was seen, from which (1) deviates."""
        if self.isotropic:
            return self.positions.flatten(1)
        return torch.where(self.present, 0.0, torch.nan).repeat_interleave(3, -1).to(self.s.dtype)

    @property
    def weights(self) -> Float[Tensor, "B rows"]:
        """1 / noise^2, 1 / w^2 of (1)."""
        w = self.deviation
        if isinstance(w, Tensor):
            return torch.where(self.present, 1 / w**2, 0.0).repeat_interleave(3, -1)
        return self.present.to(self.s.dtype).repeat_interleave(3, -1) / w**2

    def distances(self, rows: Float[Tensor, "B rows"]) -> Float[Tensor, "B K 3"]:
        """All of them; with s_std without the part along the rod that the arc lengths explain."""
        each = rows.unflatten(-1, (-1, 3))
        return each if self._root is None else matvec(self._root, each)

    def take(self, index: Int[Tensor, " b"]) -> "Markers":
        """The samples of an index."""
        noise = self.noise[index] if isinstance(self.noise, Tensor) else self.noise
        return Markers(self.s, self.positions[index], noise, self.offsets, self.s_std)

    def without(self, groups: Bool[Tensor, "B G"]) -> "Markers":
        """The markers of these groups missing."""
        return replace(self, positions=self.positions.masked_fill(groups.unsqueeze(-1), torch.nan))

    def moved(self, R: Matrix, t: Vector) -> "Markers":
        """The positions, and covariances, in the frame p' = R p + t."""
        noise = R @ self.noise @ R.mT if isinstance(self.noise, Tensor) and self.noise.ndim > 2 else self.noise
        return replace(self, positions=matvec(R, self.positions) + t, noise=noise)

    def check(self) -> None:
        """Shapes that belong together, at least one marker of one sample, finite arc lengths, a noise."""
        P, B = self.s.numel(), len(self.positions)
        noise = self.noise
        shapes = {1: (B,), 2: (B, P), 3: (P, 3, 3), 4: (B, P, 3, 3)}
        own = {"noise": shapes.get(noise.ndim, (B,))} if isinstance(noise, Tensor) else {}
        if said := shape_error(self, {"s": (P,), "positions": (B, P, 3), **own, "offsets": (P, 3), "s_std": (P,)}):
            raise ValueError(f"{said} with {P} arc lengths and {B} samples")
        if not P or not B:
            raise ValueError("there are no markers; give at least one sample with markers")
        if isinstance(noise, Tensor) and noise.ndim > 2:
            C = noise[self.present]
            even = (C - C.mT).abs().flatten(1).amax(-1) <= 1e-6 * C.abs().flatten(1).amax(-1)
            if not bool((even & (torch.linalg.cholesky_ex(C.nan_to_num(-1.0)).info == 0)).all()):
                raise ValueError("Markers.noise has covariances (m^2) that are not symmetric and positive definite")
        else:
            check_noise("Markers.noise", noise[self.present] if isinstance(noise, Tensor) and noise.ndim == 2 else noise, "m")
        if self.s_std is not None and not bool(((self.s_std >= 0) & torch.isfinite(self.s_std)).all()):
            raise ValueError("Markers.s_std must be finite and not negative (m)")


def _of_samples(noise: Tensor, B: int, P: int) -> Tensor:
    """With a row for each sample, so that samples can be taken; what has no such shape is left to `check`."""
    if noise.ndim == 3 or (noise.ndim == 1 and len(noise) == P != B):
        noise = noise.unsqueeze(0)
    return noise.expand(B, *noise.shape[1:]) if noise.ndim > 1 and len(noise) == 1 else noise
