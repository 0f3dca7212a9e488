"""Jeffreys' prior of pushes at unknown places: before the data, loads count by how well the readings tell them apart.

    (1)  p(F, eta) = sqrt(det I),    I = B^T (G - G_u S^-1 G_u^T) B

with the Fisher information I of the forces and places of all pushes, what else is unknown (u) eliminated. G is that of forces all
along the rod, worked out once at the fit, S that of u; a push F at s bends the rod by g(s) F, and B takes dF and deta to that by
g(s) and (dg/ds F) ds/deta.

A prior that is even in place and force leaves most of its room to pushes near the base, where any force hardly shows, and one that
is even in log |F| to faint ones. Where the readings leave one of two pushes open, intervals are then about those. By (1) what the
readings cannot tell apart has no room. Of one number, intervals then hold the truth as often as they say, to second order in the
noise; of several, docs/coverage.md counts it. (1) has no integral, so it tells no evidence.
Source: Jeffreys, Proc. R. Soc. A 186 (1946) 453; Welch and Peers, J. R. Stat. Soc. B 25 (1963) 318.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..util.precision import DTYPE
from . import filter as ekf

LEAST = 1e-9  # of the eigenvalues of I, over its diagonal: round-off
AT_ONCE = 2**24  # numbers of G that are gathered at a time


@dataclass(frozen=True)
class Information:
    """G of B samples: gram (B, N N, d d) of forces at one of N evenly spaced places 0 .. L and at another, row by row."""

    gram: Float[Tensor, "B NN d2"]

    @classmethod
    def of(cls, A: Float[Tensor, "B l l"], own: Float[Tensor, "B q q"], d: int) -> "Information":
        """A: of forces of d components at evenly spaced places on the rod but its clamp, then of u; own: of u, with its prior."""
        J = A.shape[-1] - own.shape[-1]
        F, cross = A[:, :J, :J], A[:, :J, J:]
        if own.shape[-1]:
            F = F - cross @ ekf.solve_spd(own, cross.mT)
        gram = F.unflatten(1, (-1, d)).unflatten(3, (-1, d)).transpose(2, 3)
        return cls(torch.nn.functional.pad(gram, (0, 0, 0, 0, 1, 0, 1, 0)).flatten(-2).flatten(1, 2))

    def take(self, index: Int[Tensor, " b"]) -> "Information":
        """The samples of an index."""
        return Information(self.gram[index])

    def log_root(
        self, eta: Float[Tensor, "B D K"], force: Float[Tensor, "B D K d"], ways: Float[Tensor, "w d"]
    ) -> Float[Tensor, "B D"]:
        """log of (1), of pushes of these forces, of which the components along `ways` are unknown."""
        (B, _, K), d = eta.shape, ways.shape[1]
        each = max(1, AT_ONCE // (B * (4 * K * d) ** 2))
        return torch.cat([self._log_root(*part, ways) for part in zip(eta.split(each, 1), force.split(each, 1), strict=True)], 1)

    def _log_root(
        self, eta: Float[Tensor, "B D K"], force: Float[Tensor, "B D K d"], ways: Float[Tensor, "w d"]
    ) -> Float[Tensor, "B D"]:
        (B, D, K), (w, d), N = eta.shape, ways.shape, math.isqrt(self.gram.shape[1])
        place = torch.sigmoid(eta)
        near, share, slope = _cubic(place * (N - 1), N)
        pair = (near[:, :, :, :, None, None] * N + near[:, :, None, None, :, :]).reshape(B, -1, 1)
        G = self.gram.gather(1, pair.expand(-1, -1, d * d)).view(B, D, K, 4, K, 4, d, d)
        turned = (N - 1) * (place * (1 - place)).unsqueeze(-1) * force
        by_force = torch.einsum("bdkn,wx->bdkwnx", share, ways)
        T = torch.cat([by_force, (slope.unsqueeze(-1) * turned.unsqueeze(-2)).unsqueeze(3)], 3)
        fisher = torch.einsum("bdiwnx,bdinjmxy,bdjvmy->bdiwjv", T, G, T).reshape(B, D, K * (w + 1), -1)
        size = fisher.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).sqrt()
        scaled = fisher / size.unsqueeze(-1) / size.unsqueeze(-2) + LEAST * torch.eye(K * (w + 1), dtype=DTYPE)
        return 0.5 * torch.linalg.slogdet(scaled)[1] + size.log().sum(-1)


def _cubic(at: Float[Tensor, "..."], N: int) -> tuple[Int[Tensor, "... 4"], Float[Tensor, "... 4"], Float[Tensor, "... 4"]]:
    """The four of N places 0, 1, .. nearest to `at`, and the weights of value and slope of the cubic through them."""
    near = (at.floor() - 1).clamp(0, N - 4).long().unsqueeze(-1) + torch.arange(4)
    off = at.unsqueeze(-1) - near
    value, slope = [], []
    for i in range(4):
        a, b, c = (off[..., j] for j in range(4) if j != i)
        scale = math.prod(i - j for j in range(4) if j != i)
        value.append(a * b * c / scale)
        slope.append((a * b + a * c + b * c) / scale)
    return near, torch.stack(value, -1), torch.stack(slope, -1)
