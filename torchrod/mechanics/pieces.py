"""Rods whose section varies: steps, tapers, tubes, oval sections, and tables of K(s).

A rod is a row of pieces, and on each of them stiffness and mass per length are polynomials of fourth degree in s, which is what a
diameter that changes linearly makes of EI, GJ and GI. They are held relative to the rod's own K_se, K_bt and mass per length,

    (1)  K(s) = C P(s) C^T,   K = C C^T the rod's (Cholesky),        mass per length: mass_per_length p(s)

so that whoever changes the rod's K changes the whole rod: k K makes it k times as stiff everywhere, and where K and K(s) are
diagonal each entry scales its own. The rod's K_bt is that of a uniform rod whose tip yields as far to a force at the tip, its K_se
that of the mean shear and axial compliance, its mass per length the mean:

    (2)  K_bt^-1 = int_0^L 3 (L - s)^2 / L^3 K_bt(s)^-1 ds,      K_se^-1 = int_0^L K_se(s)^-1 ds / L
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from ..util.precision import DTYPE, Float64
from .lie import Matrix

DEGREE = 4
PLACES = torch.linspace(0, 1, DEGREE + 1, dtype=DTYPE)  # of a piece, at which its section is told
FROM_VALUES = torch.linalg.inv(PLACES.unsqueeze(-1) ** torch.arange(DEGREE + 1, dtype=DTYPE))
SAMPLES = 17  # of a piece, where its least stiffness is looked for
_GAUSS = (  # Gauss-Legendre on [0, 1], exact to degree 15
    [0.5 + 0.5 * x for x in (-0.9602898564975363, -0.7966664774136267, -0.5255324099163290, -0.1834346424956498)]
    + [0.5 + 0.5 * x for x in (0.1834346424956498, 0.5255324099163290, 0.7966664774136267, 0.9602898564975363)],
    [0.5 * w for w in (0.1012285362903763, 0.2223810344533745, 0.3137066458778873, 0.3626837833783620)]
    + [0.5 * w for w in (0.3626837833783620, 0.3137066458778873, 0.2223810344533745, 0.1012285362903763)],
)
Ends = float | tuple[float, float]  # the same all along a piece, or at its start and its end, linear in between


def _along(name: str, value: Ends, positive: bool = True) -> Float[Tensor, " 5"]:
    """A number at the five places. Errors: ValueError."""
    a, b = value if isinstance(value, tuple) else (value, value)
    for x in (a, b):
        if not (math.isfinite(x) and (x > 0 or (x == 0 and not positive))):
            raise ValueError(f"{name} is {x}; it must be {'positive' if positive else 'at least 0'} and finite")
    return a + (b - a) * PLACES


def _diagonal(x: Tensor, y: Tensor, z: Tensor) -> Float[Tensor, "5 3 3"]:
    return torch.diag_embed(torch.stack([x, y, z], -1))


@dataclass(frozen=True)
class Piece(Float64):
    """A piece of a rod, from where the piece before it ends to `to` (m): its section at five evenly spaced places.

    K_se (N), K_bt (N m^2): (5, 3, 3), section frame. mass: (5,), kg/m. Errors: ValueError for what is no section.
    """

    to: float
    K_se: Float[Tensor, "5 3 3"]
    K_bt: Float[Tensor, "5 3 3"]
    mass: Float[Tensor, " 5"]

    @classmethod
    def round(
        cls,
        to: float,
        diameter: Ends,
        youngs_modulus: float,
        shear_modulus: float,
        mass_per_length: Ends = 0.0,
        inner_diameter: Ends = 0.0,
    ) -> "Piece":
        """A round section, solid or a tube; two diameters (m) make a taper. Moduli in Pa, mass in kg/m (two: linear)."""
        D, d = _along("diameter", diameter), _along("inner_diameter", inner_diameter, False)
        if not bool((d < D).all()):
            raise ValueError(f"inner_diameter is {inner_diameter}; it must be less than the diameter, {diameter}")
        E, G = (float(_along(n, v)[0]) for n, v in (("youngs_modulus", youngs_modulus), ("shear_modulus", shear_modulus)))
        # By Python's powers, which are those of Rod.circular to the last bit.
        area, inertia = (
            torch.tensor([math.pi * (x**n - y**n) / by for x, y in zip(D.tolist(), d.tolist(), strict=True)], dtype=DTYPE)
            for n, by in ((2, 4), (4, 64))
        )
        K_se, K_bt = _diagonal(G * area, G * area, E * area), _diagonal(E * inertia, E * inertia, 2 * G * inertia)
        return cls(to, K_se, K_bt, _along("mass_per_length", mass_per_length, False))

    @classmethod
    def oval(
        cls,
        to: float,
        axes: tuple[Ends, Ends],
        youngs_modulus: float,
        shear_modulus: float,
        mass_per_length: Ends = 0.0,
        angle: float = 0.0,
    ) -> "Piece":
        """A solid ellipse with axes (m, whole ones), the first of which is turned by `angle` (rad) from the section's x towards y.

        Its torsion constant is pi a^3 b^3 / (16 (a^2 + b^2)); where axes taper out of proportion, a polynomial through five places.
        """
        a, b = (_along("axes", axis) for axis in axes)
        E, G = (float(_along(n, v)[0]) for n, v in (("youngs_modulus", youngs_modulus), ("shear_modulus", shear_modulus)))
        if not math.isfinite(angle):
            raise ValueError(f"angle is {angle}; it must be finite, in rad")
        area, J = math.pi * a * b / 4, math.pi * a**3 * b**3 / (16 * (a**2 + b**2))
        c, s = math.cos(angle), math.sin(angle)
        R = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=DTYPE)
        K_bt = R @ _diagonal(E * math.pi * a * b**3 / 64, E * math.pi * a**3 * b / 64, G * J) @ R.mT
        return cls(
            to, _diagonal(G * area, G * area, E * area), 0.5 * (K_bt + K_bt.mT), _along("mass_per_length", mass_per_length, False)
        )

    @classmethod
    def of_stiffness(
        cls, to: float, K_se: Matrix | tuple[Matrix, Matrix], K_bt: Matrix | tuple[Matrix, Matrix], mass_per_length: Ends = 0.0
    ) -> "Piece":
        """Any section by its stiffness (N, N m^2), or by that at start and end, linear in between: a row of a table K(s)."""

        def along(K: Matrix | tuple[Matrix, Matrix]) -> Float[Tensor, "5 3 3"]:
            a, b = K if isinstance(K, tuple) else (K, K)
            return a.to(DTYPE) + (b - a).to(DTYPE) * PLACES[:, None, None]

        return cls(to, along(K_se), along(K_bt), _along("mass_per_length", mass_per_length, False))

    @property
    def uniform(self) -> bool:
        """Whether the section is the same all along."""
        return all(bool((x == x[:1]).all()) for x in (self.K_se, self.K_bt, self.mass))


def polynomial(values: Float[Tensor, "5 ..."]) -> Float[Tensor, "5 ..."]:
    """Coefficients of rising powers of the share of a piece; those of a constant are exact."""
    if bool((values == values[:1]).all()):
        return torch.cat([values[:1], torch.zeros_like(values[1:])])
    return torch.einsum("ij,j...->i...", FROM_VALUES, values)


@dataclass(frozen=True)
class Pieces(Float64):
    """How stiffness and mass vary along a rod, by (1). ends: (n + 1,) m, from 0 to the length.

    K_se, K_bt: P of (1), (n, 5, 3, 3), coefficients of rising powers of the share of the piece; mass: p, (n, 5).
    """

    ends: Float[Tensor, " n1"]
    K_se: Float[Tensor, "n 5 3 3"]
    K_bt: Float[Tensor, "n 5 3 3"]
    mass: Float[Tensor, "n 5"]

    def _place(self, s: Float[Tensor, "..."], inside: Float[Tensor, "..."]) -> tuple[Tensor, Float[Tensor, "..."]]:
        """The piece that `inside` lies on, and which share of it lies before s."""
        piece = torch.searchsorted(self.ends[1:-1].contiguous(), inside.detach().contiguous())
        start = self.ends[piece]
        return piece, (s - start) / (self.ends[piece + 1] - start)

    def stiffness(
        self, K_se: Matrix, K_bt: Matrix, s: Float[Tensor, "..."], inside: Float[Tensor, "..."]
    ) -> tuple[Float[Tensor, "... 3 3"], Float[Tensor, "... 3 3"]]:
        """K_se(s), K_bt(s) of a rod of these by (1); `inside`, of the same step, says on which side of a jump s is."""
        piece, t = self._place(s, inside)
        t = t[..., None, None]

        def at(K: Matrix, coefficients: Float[Tensor, "n 5 3 3"]) -> Float[Tensor, "... 3 3"]:
            c, C = coefficients[piece].unbind(-3), torch.linalg.cholesky(K)
            P = c[DEGREE]
            for k in reversed(range(DEGREE)):
                P = P * t + c[k]
            return C @ P @ C.mT

        return at(K_se, self.K_se), at(K_bt, self.K_bt)

    def sampled(self, K_se: Matrix, K_bt: Matrix) -> tuple[Float[Tensor, "m 3 3"], Float[Tensor, "m 3 3"]]:
        """K_se and K_bt at places all along, both sides of every jump."""
        a, b = self.ends[:-1, None], self.ends[1:, None]
        s = a + (b - a) * torch.linspace(0, 1, SAMPLES, dtype=DTYPE)
        return self.stiffness(K_se, K_bt, s.flatten(), (0.5 * (a + b)).expand_as(s).flatten())

    def length_beyond(self, s: Float[Tensor, "..."], inside: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """int_s^L p (m): how long a piece of the mean mass per length weighs as much as all beyond s."""
        piece, t = self._place(s, inside)
        h = self.ends.diff()
        c = h.unsqueeze(-1) * self.mass / torch.arange(1, DEGREE + 2, dtype=DTYPE)
        later = c.sum(-1).flip(0).cumsum(0).flip(0)
        before = torch.zeros_like(t)
        for k in reversed(range(DEGREE + 1)):
            before = (before + c[piece, k]) * t
        return later[piece] - before


def joined(pieces: tuple[Piece, ...]) -> tuple[Matrix, Matrix, Float[Tensor, ""], Pieces]:
    """K_se, K_bt and mass per length of (2), and how they vary by (1). Errors: ValueError for pieces that are no rod."""
    ends = torch.tensor([0.0, *(piece.to for piece in pieces)], dtype=DTYPE)
    if not pieces or any(not (math.isfinite(b) and a < b) for a, b in pairwise(ends.tolist())):
        raise ValueError(f"the pieces of a rod end at {ends[1:].tolist()} m; their ends must be finite and increase from 0")
    for i, piece in enumerate(pieces):
        for name, unit in (("K_se", "N"), ("K_bt", "N m^2")):
            K = getattr(piece, name)
            if K.shape != (DEGREE + 1, 3, 3) or not bool(torch.isfinite(K).all()) or int(torch.linalg.cholesky_ex(K).info.sum()):
                raise ValueError(f"{name} of piece {i + 1} must be five symmetric positive definite 3 x 3 matrices, in {unit}")
    L, h = float(ends[-1]), ends.diff()
    x, w = (torch.tensor(v, dtype=DTYPE) for v in _GAUSS)
    s = (ends[:-1, None] + h[:, None] * x).flatten()
    share = (h[:, None] * w).flatten()
    powers = x.unsqueeze(-1) ** torch.arange(DEGREE + 1, dtype=DTYPE)
    coefficients = {n: torch.stack([polynomial(getattr(p, n)) for p in pieces]) for n in ("K_se", "K_bt", "mass")}

    def mean(name: str, weight: Float[Tensor, " m"]) -> Matrix:
        K = torch.einsum("gk,nkij->ngij", powers, coefficients[name]).flatten(0, 1)
        compliance = ((weight * share)[:, None, None] * torch.linalg.inv(K)).sum(0)
        K = torch.linalg.inv(compliance)
        return 0.5 * (K + K.mT)

    K_se, K_bt = mean("K_se", torch.full_like(s, 1 / L)), mean("K_bt", 3 * ((L - s) / L) ** 2 / L)
    total = (h.unsqueeze(-1) * coefficients["mass"] / torch.arange(1, DEGREE + 2, dtype=DTYPE)).sum()

    def relative(K: Matrix, name: str) -> Float[Tensor, "n 5 3 3"]:
        C = torch.linalg.inv(torch.linalg.cholesky(K))
        return C @ coefficients[name] @ C.mT

    mass = coefficients["mass"] * (L / total) if total > 0 else torch.zeros_like(coefficients["mass"])
    if not total > 0:
        mass[:, 0] = 1.0  # whatever mass the rod is given later is spread evenly
    return K_se, K_bt, total / L, Pieces(ends, relative(K_se, "K_se"), relative(K_bt, "K_bt"), mass)
