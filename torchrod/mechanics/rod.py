"""The elastic rod: length, section stiffness, mass and reference curvature."""

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..util.precision import DTYPE, Float64, plain
from .lie import Matrix
from .pieces import Piece, Pieces, joined

SYMMETRIC = 1e-6  # relative: what the numbers of a file may be off


def check_stiffness(name: str, K: Tensor, unit: str) -> None:
    """Refuse what is not a symmetric positive definite 3 x 3 matrix. Errors: ValueError."""
    if K.shape != (3, 3):
        raise ValueError(f"{name} has shape {tuple(K.shape)}; it must be a 3 x 3 matrix, in {unit}")
    if not plain(K):
        return
    if not bool(torch.isfinite(K).all()):
        raise ValueError(f"{name} must be finite, in {unit}")
    if not torch.allclose(K, K.mT, rtol=SYMMETRIC, atol=0) or int(torch.linalg.cholesky_ex(K.detach()).info):
        raise ValueError(f"{name} must be symmetric positive definite, in {unit}")


@dataclass(frozen=True)
class Rod(Float64):
    """A straight or pre-curved rod, clamped at s = 0, leaving the base frame along +z.

    Constitutive law in the section frame: n = K_se (v - e3), m = K_bt (u - u*). length: L (m). K_se: shear and axial stiffness (3,
    3), N. K_bt: bending and torsion stiffness (3, 3), N m^2. mass_per_length: kg/m. reference_curvature: rows [s, u*_x, u*_y, u*_z]
    (m, 1/m), s not falling: linear in between, constant beyond, a jump where two rows have the same s. One row is constant.
    pieces: how K_se, K_bt and mass_per_length, which then are means, vary along the rod (`Rod.of_pieces`); None: they do not.
    masses: rows [s, m] (m, kg) of what hangs on the rod at a point: discs, sensors, a camera at the tip. One rod serves the whole
    batch. Errors: ValueError for what is no rod. Source: Rucker & Webster 2011, eq. (4)-(6).
    """

    length: float
    K_se: Float[Tensor, "3 3"]
    K_bt: Float[Tensor, "3 3"]
    mass_per_length: Float[Tensor, ""]
    reference_curvature: Float[Tensor, "rows 4"]
    pieces: Pieces | None = None
    masses: Float[Tensor, "points 2"] = field(default_factory=lambda: torch.zeros(0, 2, dtype=DTYPE))

    def __post_init__(self):
        super().__post_init__()
        if not (math.isfinite(self.length) and self.length > 0):
            raise ValueError(f"the rod's length is {self.length} m; it must be positive and finite")
        for name, unit in (("K_se", "N"), ("K_bt", "N m^2")):
            check_stiffness(name, getattr(self, name), unit)
        mass, rows = self.mass_per_length, self.reference_curvature
        if mass.ndim or (plain(mass) and not (math.isfinite(float(mass)) and float(mass) >= 0)):
            said = f"of shape {tuple(mass.shape)}" if mass.ndim else f"{float(mass)} kg/m"
            raise ValueError(f"mass_per_length is {said}; it must be one finite number, at least 0")
        if rows.ndim != 2 or rows.shape[1] != 4 or not len(rows):
            raise ValueError(f"reference_curvature has shape {tuple(rows.shape)}; it must be rows of [s, ux, uy, uz]")
        if plain(rows) and not bool(torch.isfinite(rows).all()):
            raise ValueError("reference_curvature must be finite, in m and 1/m")
        if plain(rows) and bool((rows[:, 0].diff() < 0).any()):
            raise ValueError("reference_curvature: s must increase from row to row")
        if self.pieces is not None and abs(float(self.pieces.ends[-1]) - self.length) > SYMMETRIC * self.length:
            raise ValueError(f"the pieces end at {float(self.pieces.ends[-1])} m; the last must end at the length, {self.length} m")
        points = self.masses
        if points.ndim != 2 or points.shape[1] != 2:
            raise ValueError(f"masses has shape {tuple(points.shape)}; it must be rows of [s (m), mass (kg)]")
        if plain(points) and len(points):
            s, m = points.detach().unbind(-1)
            if not bool((torch.isfinite(m) & (m >= 0) & (s >= 0) & (s <= self.length * (1 + SYMMETRIC))).all()):
                raise ValueError(f"masses must be at least 0 kg and finite, at 0 to {self.length} m")

    @classmethod
    def circular(
        cls,
        length: float,
        diameter: float,
        youngs_modulus: float,
        shear_modulus: float,
        mass_per_length: float = 0.0,
        reference_curvature: Float[Tensor, "rows 4"] | None = None,
    ) -> "Rod":
        """A solid circular section: K_se = diag(GA, GA, EA), K_bt = diag(EI, EI, 2GI). SI units; no shear correction factor."""
        for name, value in (("diameter", diameter), ("youngs_modulus", youngs_modulus), ("shear_modulus", shear_modulus)):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}; it must be positive and finite")
        area = math.pi * diameter**2 / 4
        inertia = math.pi * diameter**4 / 64
        K_se = torch.tensor([shear_modulus * area, shear_modulus * area, youngs_modulus * area], dtype=DTYPE)
        K_bt = torch.tensor([youngs_modulus * inertia, youngs_modulus * inertia, 2 * shear_modulus * inertia], dtype=DTYPE)
        return cls.from_stiffness(length, torch.diag(K_se), torch.diag(K_bt), mass_per_length, reference_curvature)

    @classmethod
    def from_stiffness(
        cls,
        length: float,
        K_se: Matrix,
        K_bt: Matrix,
        mass_per_length: float = 0.0,
        reference_curvature: Float[Tensor, "rows 4"] | None = None,
    ) -> "Rod":
        """Any section, by its symmetric positive definite stiffness matrices (N and N m^2, section frame)."""
        if reference_curvature is None:
            reference_curvature = torch.zeros(1, 4, dtype=DTYPE)
        return cls(length, K_se, K_bt, torch.as_tensor(mass_per_length, dtype=DTYPE), reference_curvature)

    @classmethod
    def of_pieces(
        cls,
        pieces: tuple[Piece, ...],
        reference_curvature: Float[Tensor, "rows 4"] | None = None,
        masses: Float[Tensor, "points 2"] | None = None,
    ) -> "Rod":
        """A rod whose section varies: one piece after the other, from the base to the tip (mechanics.pieces)."""
        K_se, K_bt, mass, varying = joined(pieces)
        rod = cls.from_stiffness(pieces[-1].to, K_se, K_bt, 0.0, reference_curvature)
        masses = rod.masses if masses is None else masses
        return replace(rod, mass_per_length=mass, pieces=varying, masses=masses)

    @property
    def bending_stiffness(self) -> float:
        """EI (N m^2): the geometric mean of the two bending stiffnesses, the rod's scale of stiffness.

        Of a rod whose section varies: of a uniform one whose tip yields as far to a force there.
        """
        return float((self.K_bt[0, 0] * self.K_bt[1, 1]).detach().sqrt())

    @property
    def sides(self) -> tuple[float, float]:
        """How stiff the rod is against forces along x and y, in units of EI: 1 and 1 for a round section."""
        about_x, about_y = self.K_bt.detach().diagonal()[:2].tolist()
        return about_y / self.bending_stiffness, about_x / self.bending_stiffness

    @property
    def softer_side(self) -> float:
        """The least stiffness in bending, where the rod is free to twist, in units of EI: 1 for a round section."""
        return 1 / float(torch.linalg.eigvalsh(self.K_bt.detach().inverse()[:2, :2])[-1]) / self.bending_stiffness

    @property
    def force_scale(self) -> float:
        """4 EI / L^2 (N): a force that bends the rod visibly; 1 N for the paper's rod, so that the paper's units carry over.

        Of a flat backbone no more than what lets it give way sideways, with sqrt(EI_soft GJ) for EI (4.01 at the tip of a strip,
        Timoshenko & Gere 1961, 6.3), nor less than what bends its soft side.
        """
        (x, xy, _), (_, y, _), (_, _, torsion) = self.K_bt.detach().tolist()
        soft = 0.5 * (x + y) - math.hypot(0.5 * (x - y), xy)
        return 4 * min(self.bending_stiffness, max(soft, math.sqrt(soft * torsion))) / self.length**2

    @property
    def moment_scale(self) -> float:
        """2 EI / L (N m): 0.2 N m for the paper's rod."""
        return 2 * self.bending_stiffness / self.length

    @property
    def softest(self) -> float:
        """The least of the three stiffnesses in bending and torsion (N m^2), anywhere on the rod."""
        K = self.sampled_stiffness[1].detach()
        if K.ndim == 2 and not any((rows := K.tolist())[i][j] for i in range(3) for j in range(i)):
            return min(rows[i][i] for i in range(3))  # of a round tube, say, without eigenvalues: every fit asks
        return float(torch.linalg.eigvalsh(K)[..., 0].min())

    @property
    def sampled_stiffness(self) -> tuple[Float[Tensor, "... 3 3"], Float[Tensor, "... 3 3"]]:
        """K_se and K_bt, at places all along where they vary."""
        return (self.K_se, self.K_bt) if self.pieces is None else self.pieces.sampled(self.K_se, self.K_bt)

    @property
    def mass(self) -> float:
        """All of it (kg)."""
        return float(self.mass_per_length) * self.length + float(self.masses[:, 1].sum())

    @property
    def knots(self) -> tuple[float, ...]:
        """Arc lengths (m) on the rod at which u* jumps or bends, a piece ends or a mass hangs: step boundaries."""
        rows, pieces = self.reference_curvature, self.pieces
        places = rows[:, 0].tolist() if len(rows) > 1 else []
        places += [] if pieces is None else pieces.ends.tolist()
        return tuple(s for s in places + self.masses[:, 0].tolist() if 0 < s < self.length)

    @property
    def straight(self) -> bool:
        """Whether u* is zero all along."""
        return not bool(self.reference_curvature[:, 1:].any())

    def length_beyond(self, s: Float[Tensor, "..."], inside: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """How long a piece (m) of mass_per_length weighs as much as the rod, without the masses on it, beyond s."""
        return self.length - s if self.pieces is None else self.pieces.length_beyond(s, inside)

    def curvature_at(self, s: Float[Tensor, "..."], inside: Float[Tensor, "..."]) -> Float[Tensor, "... 3"]:
        """u*(s) (1/m), section frame; `inside` is a point of the same step and decides on which side of a jump s lies."""
        rows = self.reference_curvature
        if rows.shape[0] == 1:
            return rows[0, 1:].expand(*s.shape, 3)
        right = torch.searchsorted(rows[:, 0].contiguous(), inside.detach().contiguous()).clamp(1, rows.shape[0] - 1)
        low, high = rows[right - 1], rows[right]
        span = high[..., 0] - low[..., 0]
        # A table may begin or end with a jump, and then has no span there.
        t = torch.where(span > 0, (s - low[..., 0]) / torch.where(span > 0, span, 1.0), (inside > low[..., 0]).to(s.dtype))
        return low[..., 1:] + t.clamp(0, 1).unsqueeze(-1) * (high[..., 1:] - low[..., 1:])
