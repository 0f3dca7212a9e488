"""The elastic rod: length, section stiffness, mass and reference curvature."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..util.kept import kept
from ..util.precision import DTYPE, Float64
from .lie import Matrix


@dataclass(frozen=True)
class Rod(Float64):
    """A straight or pre-curved rod of uniform section, clamped at s = 0, leaving the base frame along +z.

    Constitutive law in the section frame: n = K_se (v - e3), m = K_bt (u - u*).
    length: L (m). K_se: shear and axial stiffness (3, 3), N. K_bt: bending and torsion stiffness (3, 3), N m^2.
    mass_per_length: kg/m. reference_curvature: rows [s, u*_x, u*_y, u*_z] (m, 1/m), s not falling: linear in between,
    constant beyond, a jump where two rows have the same s. One row is constant.
    One rod serves the whole batch. Source: Rucker & Webster 2011, eq. (4)-(6).
    """

    length: float
    K_se: Float[Tensor, "3 3"]
    K_bt: Float[Tensor, "3 3"]
    mass_per_length: Float[Tensor, ""]
    reference_curvature: Float[Tensor, "rows 4"]

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

    @property
    def bending_stiffness(self) -> float:
        """EI (N m^2): the geometric mean of the two bending stiffnesses, the rod's scale of stiffness."""
        return kept(self, "_bending_stiffness", self.K_bt, lambda K_bt: float((K_bt[0, 0] * K_bt[1, 1]).detach().sqrt()))

    @property
    def force_scale(self) -> float:
        """4 EI / L^2 (N): a force that bends the rod visibly; 1 N for the paper's rod, so that the paper's units carry over."""
        return 4 * self.bending_stiffness / self.length**2

    @property
    def moment_scale(self) -> float:
        """2 EI / L (N m): 0.2 N m for the paper's rod."""
        return 2 * self.bending_stiffness / self.length

    @property
    def softest(self) -> float:
        """The least of the three stiffnesses in bending and torsion (N m^2)."""
        return kept(self, "_softest", self.K_bt, lambda K_bt: float(torch.linalg.eigvalsh(K_bt.detach())[0]))

    @property
    def knots(self) -> tuple[float, ...]:
        """Arc lengths (m) on the rod at which u* jumps or bends: step boundaries of the integration."""
        return kept(self, "_knots", self.reference_curvature, self._knots_of)

    def _knots_of(self, rows: Float[Tensor, "rows 4"]) -> tuple[float, ...]:
        return tuple(s for s in rows[:, 0].tolist() if 0 < s < self.length) if len(rows) > 1 else ()

    @property
    def straight(self) -> bool:
        """Whether u* is zero all along."""
        return kept(self, "_straight", self.reference_curvature, lambda rows: not bool((rows[:, 1:] != 0).any()))

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
