"""What draws of a posterior are proposed by: Student's t, places by a histogram, and mixtures of such (estimation.draws).

All of b samples, in m coordinates v; densities are normalized. The random numbers are always the same, whatever the batch.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Protocol, Self

import torch
from jaxtyping import Float, Int
from scipy.special import chdtri
from torch import Tensor
from torch.quasirandom import SobolEngine

from ..util.precision import DTYPE

NU = 8.0  # degrees of freedom of Student's t


class Proposal(Protocol):
    """Draws of b samples and how probable they are."""

    def take(self, index: Int[Tensor, " c"]) -> Self:
        """The samples of an index."""
        ...

    def draw(self, count: int, seed: int) -> Float[Tensor, "b D m"]:
        """So many of each sample."""
        ...

    def log_density(self, v: Float[Tensor, "b D m"]) -> Float[Tensor, "b D"]:
        """Of any v."""
        ...


@cache
def _uniform(size: int, count: int, seed: int) -> Float[Tensor, "D size"]:
    """Sobol points, always the same. Numbers that belong to one draw are of one call: the first coordinates of any two agree in
    their leading digits.
    """
    return SobolEngine(size, scramble=True, seed=seed).draw(count, dtype=DTYPE).clamp(1e-9, 1 - 1e-9)


def _student(uniform: Float[Tensor, "D n"]) -> Float[Tensor, "D m"]:
    """Points of a standard Student's t with NU degrees of freedom in m = n - 1 dimensions."""
    spread = torch.from_numpy(chdtri(NU, uniform[:, -1].numpy()))
    return torch.special.ndtri(uniform[:, :-1]) * (NU / spread).sqrt().unsqueeze(-1)


def _which(share: Float[Tensor, "b c"], uniform: Float[Tensor, " D"]) -> Int[Tensor, "b D"]:
    """Numbers 0 .. c - 1 with these shares."""
    ends = share.cumsum(-1)
    found = torch.searchsorted((ends / ends[:, -1:]).contiguous(), uniform.expand(len(share), -1).contiguous())
    return found.clamp(max=share.shape[-1] - 1)


@dataclass(frozen=True)
class Student:
    """Student's t of b samples: centre (b, m), and L with L L^T its scale matrix."""

    centre: Float[Tensor, "b m"]
    L: Float[Tensor, "b m m"]

    @classmethod
    def of(cls, centre: Float[Tensor, "b m"], C: Float[Tensor, "b m m"]) -> "Student":
        """By a factor of C, of which directions that are none are given a little."""
        d = C.diagonal(dim1=-2, dim2=-1).clamp(min=1e-24).sqrt()
        size, axes = torch.linalg.eigh(C / d.unsqueeze(-1) / d.unsqueeze(-2))
        R = (axes * size.clamp(min=1e-10).sqrt().unsqueeze(-2)).mT
        L = torch.linalg.qr(R)[1].mT
        return cls(centre, d.unsqueeze(-1) * L * L.diagonal(dim1=-2, dim2=-1).sign().unsqueeze(-2))

    def take(self, index: Int[Tensor, " c"]) -> "Student":
        """See Proposal."""
        return Student(self.centre[index], self.L[index])

    def draw(self, count: int, seed: int) -> Float[Tensor, "b D m"]:
        """See Proposal."""
        return self.at(_student(_uniform(self.centre.shape[-1] + 1, count, seed)))

    def at(self, standard: Float[Tensor, "D m"]) -> Float[Tensor, "b D m"]:
        """Points of the standard distribution on this one."""
        return self.centre.unsqueeze(1) + standard @ self.L.mT

    def log_density(self, v: Float[Tensor, "b D m"]) -> Float[Tensor, "b D"]:
        """See Proposal."""
        m = v.shape[-1]
        off = torch.linalg.solve_triangular(self.L, (v - self.centre.unsqueeze(1)).mT, upper=False)
        constant = math.lgamma((NU + m) / 2) - math.lgamma(NU / 2) - 0.5 * m * math.log(NU * math.pi)
        size = self.L.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1, keepdim=True)
        return constant - size - 0.5 * (NU + m) * torch.log1p(off.square().sum(-2) / NU)


@cache
def combinations(cells: int, K: int) -> tuple[Int[Tensor, "c K"], Int[Tensor, " lut"]]:
    """K cells in rising order, and which combination each K cells are, by their number in the base `cells`; -1: none."""
    cell = torch.combinations(torch.arange(cells), K)
    base = cells ** torch.arange(K)
    return cell, torch.full((cells**K,), -1).index_copy(0, (cell * base).sum(-1), torch.arange(len(cell)))


@dataclass(frozen=True)
class OnGrid:
    """Places of the loads by a histogram of how probable they are, all else by a Student's t.

    rest: that t, of the other entries. places: those of the etas, in the order along the rod. share (b, c): of each combination.
    """

    rest: Student
    places: Int[Tensor, "b K"]
    others: Int[Tensor, " r"]
    cells: int
    share: Float[Tensor, "b c"]

    def take(self, index: Int[Tensor, " c"]) -> "OnGrid":
        """See Proposal."""
        return replace(self, rest=self.rest.take(index), places=self.places[index], share=self.share[index])

    def draw(self, count: int, seed: int) -> Float[Tensor, "b D m"]:
        """See Proposal."""
        (b, K), r = self.places.shape, len(self.others)
        uniform = _uniform(r + K + 2, count, 100 + seed)
        cell, _ = combinations(self.cells, K)
        inside = uniform[:, -K:].clamp(1e-6, 1 - 1e-6)
        eta = torch.logit((cell[_which(self.share, uniform[:, r + 1])] + inside) / self.cells)
        v = eta.new_zeros(b, count, K + r)
        v[..., self.others] = self.rest.at(_student(uniform[:, : r + 1]))
        return v.scatter(-1, self.places.unsqueeze(1).expand(-1, count, -1), eta)

    def log_density(self, v: Float[Tensor, "b D m"]) -> Float[Tensor, "b D"]:
        """See Proposal."""
        K = self.places.shape[-1]
        at = torch.sigmoid(v.gather(-1, self.places.unsqueeze(1).expand(-1, v.shape[1], -1)))
        cell = (at * self.cells).long().clamp(max=self.cells - 1)
        _, table = combinations(self.cells, K)
        which = table[(cell * self.cells ** torch.arange(K)).sum(-1)]
        share = torch.where(which >= 0, self.share.gather(-1, which.clamp(min=0)), 0.0)
        slope = (at * (1 - at)).clamp(min=1e-300).log().sum(-1) + K * math.log(self.cells)
        return share.log() + slope + self.rest.log_density(v[..., self.others])


@dataclass(frozen=True)
class Mixture:
    """Of several Student's t, of which each sample has its own shares (b, c)."""

    parts: Sequence[Student]
    share: Float[Tensor, "b c"]

    def take(self, index: Int[Tensor, " c"]) -> "Mixture":
        """See Proposal."""
        return Mixture([part.take(index) for part in self.parts], self.share[index])

    def draw(self, count: int, seed: int) -> Float[Tensor, "b D m"]:
        """See Proposal."""
        m = self.parts[0].centre.shape[-1]
        uniform = _uniform(m + 2, count, 200 + seed)
        rows, which = torch.arange(len(self.share)).unsqueeze(-1), _which(self.share, uniform[:, -1])
        centre, L = (torch.stack([getattr(part, name) for part in self.parts], 1)[rows, which] for name in ("centre", "L"))
        return centre + (L @ _student(uniform[:, :-1]).unsqueeze(-1)).squeeze(-1)

    def log_density(self, v: Float[Tensor, "b D m"]) -> Float[Tensor, "b D"]:
        """See Proposal."""
        each = torch.stack([part.log_density(v) for part in self.parts], -1)
        return (each + self.share.log().unsqueeze(1)).logsumexp(-1)
