"""Coordinates v in which the posterior of x is nearly normal, and what is known of x before it is measured.

At given places of the loads the markers are nearly linear in the forces, and in all else that is unknown (l). With the response to
a force at any place s, worked out once at the fit and with the base wrench in equilibrium, the forces that the markers ask for at
the places s_1 .. s_K are normal about mu with information S, and

    (1)  v = [L^T (l - mu), eta, log c],    S(eta) = L L^T,    |det dx/dv| = 1 / det L

has neither the banana of a push nearer the base that looks like a weaker one farther out nor the valley of two pushes that trade.
It only says where to draw: weights make up for what is not linear. Forces along the rod, where they are unknown, are among the
forces, and for an entry xi that stands for one (load_families.family, along_rod) v has that force. Families of other loads are
drawn in their own entries. The base wrench is no entry of v: equilibrium gives it.

The fit needs weak priors that are normal in its own entries, of which draws must make sense where the data say little: normal with
a deviation of 10 in eta puts nine tenths of all pushes within a tenth of the ends. For intervals, pushes at unknown places have
Jeffreys' prior (estimation.jeffreys). That tells no evidence, for which they may be anywhere along the rod with the same
probability, and of any size,

    (2)  p(eta) = r (1 - r),    p(F) = exp(-|F|^2 / 2 w^2) / (f^2 + |F|^2)^(d/2) / Z

even in log |F| between the least force worth telling (f = FAINT) and the fit's own weak prior (w), F being the d components of all
loads together: normal forces whose common size may be any. Of loads one by one, the prior would take one of two close pushes to be
next to nothing. The unknown force and the moment at the tip have (2) each for itself, across the base's axis and along it, and so
has, for the evidence, a strip's soft side, and always what pushes across it. What only weighs on what bends the rod already is even
up to where it bends the rod by itself (f = BUCKLES, TWISTS, GIVES_WAY): smaller amounts are as hard to see as none, and no
likelier. So is a wrench at the tip where nothing else is unknown (f = FAINT_WRENCH): its force and its moment bend the rod much
alike, and of the two the prior would take one to be next to nothing. Widths, tensions and the base frame's error keep their priors,
and so does all that a problem has a prior of its own for.
"""

import math
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..model.load_families import GaussianCoordinates, PointCoordinates
from ..model.load_families.family import WEAK_STD, along_rod
from ..model.problem import TIP_ROWS, Problem
from ..model.unknowns import TIP_STD
from ..util.precision import DTYPE
from . import filter as ekf
from .elsewhere import across_strip
from .evaluator import evaluator
from .jeffreys import Information

PLACES = 24  # along the rod, at which a force is tried
CELLS = 96  # between which the response is linear
FAINT = 0.01  # in force and moment scales: what is weaker might as well be nothing
BUCKLES = math.pi**2 / 16  # force scales: what is weaker along the rod only weighs on what bends it already
FAINT_WRENCH = 0.1  # where force and moment at the tip trade, and nothing else is unknown
TWISTS = 2.2  # moment scales, in the same way: 4.49 EI / L twist a straight rod off its axis
GIVES_WAY = 1.0  # force scales, of a push across a strip, in the same way
STEP = 1e-3  # of the differences in dv/dy
TORQUE_STD = 3.0  # moment scales


@lru_cache(maxsize=32)
def _log_normalizer(d: int, faint: float, weak: float) -> float:
    """log Z of (2): the sphere's surface times an integral over log |F|."""
    surface = 2 * math.pi ** (d / 2) / math.gamma(d / 2)
    F = torch.logspace(math.log10(faint) - 6, math.log10(weak) + 2, 4001, dtype=DTYPE)
    density = F**d * torch.exp(-0.5 * (F / weak) ** 2) * (faint**2 + F**2) ** (-d / 2)  # over log F
    return math.log(surface * float(torch.trapezoid(density, F.log())))


def _log_size(F: Float[Tensor, "... d"], weak: float, faint: float) -> Float[Tensor, "..."]:
    """log p(F) of (2)."""
    d, square = F.shape[-1], F.square().sum(-1)
    return -0.5 * square / weak**2 - 0.5 * d * torch.log(faint**2 + square) - _log_normalizer(d, faint, weak)


@dataclass(frozen=True)
class _Sized:
    """Entries that share a size by (2): with the deviation of their weak prior, and what is faint, in force or moment scales. axis:
    of lateral forces, only what is along it in the section. unit: of the entries, in scales. push: they are forces of loads that
    Jeffreys' prior is of.
    """

    at: list[int]
    weak: float
    faint: float
    axis: Float[Tensor, " 2"] | None = None
    unit: float = 1.0
    push: bool = False

    def of(self, y: Float[Tensor, "... m"]) -> Float[Tensor, "... d"]:
        """What has that size, in scales."""
        F = self.unit * y[..., self.at]
        return F if self.axis is None else F.unflatten(-1, (-1, 2)) @ self.axis

    def log_prior(self, y: Float[Tensor, "... m"]) -> Float[Tensor, "..."]:
        """(2) of the entries."""
        F = self.of(y)
        return _log_size(F, self.weak, self.faint) + F.shape[-1] * math.log(self.unit)


@cache
def _cubic() -> Float[Tensor, "C J"]:
    """The response at the CELLS + 1 places 0 .. L, from those at PLACES of them, by the cubic through the nearest four; nothing at
    the clamp.
    """
    at = torch.arange(CELLS + 1, dtype=DTYPE) * (PLACES / CELLS)
    first = (at.floor() - 1).clamp(0, PLACES - 3)
    weights = torch.zeros(CELLS + 1, PLACES + 1, dtype=DTYPE)
    for i in range(4):
        others = [j for j in range(4) if j != i]
        part = math.prod((at - first - j) / (i - j) for j in others)
        weights.scatter_(1, (first + i).long().unsqueeze(-1), part.unsqueeze(-1))  # pyright: ignore[reportAttributeAccessIssue]
    return weights[:, 1:]


@dataclass(frozen=True)
class Response:
    """What B samples say of forces anywhere along the rod and of the entries u = [tip, tension, registration], at their fits.

    A force has d = 2 components, or 3. gram (B, C, C, d d): H^T W H of a force at one place and one at another, row by row; cross
    (B, C, d q): with u; own (B, q, q): of u, with its prior. pull (B, C, d), pull_u (B, q): H^T W (z - h) as if there were no
    force and u were at the fit. information: for Jeffreys' prior, where that is asked for.
    """

    gram: Float[Tensor, "B CC d2"]
    cross: Float[Tensor, "B C p"]
    own: Float[Tensor, "B q q"]
    pull: Float[Tensor, "B C d"]
    pull_u: Float[Tensor, "B q"]
    information: Information | None

    def take(self, index: Int[Tensor, " b"]) -> "Response":
        """The samples of an index."""
        information = None if self.information is None else self.information.take(index)
        return Response(self.gram[index], self.cross[index], self.own[index], self.pull[index], self.pull_u[index], information)


def _cells(at: Float[Tensor, "..."], count: int) -> tuple[Int[Tensor, "... 2"], Float[Tensor, "... 2"]]:
    """Between which two of the places 0 .. L, so many apart, s / L lies, and its share of both."""
    at = at * count
    first = at.floor().clamp(0, count - 1)
    share = at - first
    return torch.stack([first, first + 1], -1).long(), torch.stack([1 - share, share], -1)


def _halves(mu: Float[Tensor, "..."], width: Float[Tensor, "..."]) -> Float[Tensor, "... 2"]:
    """Two places, half of a load at each, with the mean and the variance of a Gaussian (in lengths) as far as it is on the rod.

    Source: of a truncated normal distribution, Johnson, Kotz & Balakrishnan 1994, 13.10.
    """
    low, high = -mu / width, (1 - mu) / width
    on_rod = (torch.special.ndtr(high) - torch.special.ndtr(low)).clamp(min=1e-12)
    a, b = (torch.exp(-0.5 * t.clamp(-30, 30) ** 2) / math.sqrt(2 * math.pi) / on_rod for t in (low, high))
    mean = mu + width * (a - b)
    std = width * (1 + low * a - high * b - (a - b) ** 2).clamp(min=0).sqrt()
    return torch.stack([mean - std, mean + std], -1).clamp(0, 1)


def _response(
    problem: Problem, x: Float[Tensor, "B n"], at: Float[Tensor, "B K"], force: Float[Tensor, "B K d"], informed: bool
) -> Response:
    """At the fits x, whose loads are at s / L and have these forces (in force scales): each is shared between two point forces,
    which bend the rod as it does, and then the model is linear in point forces all along the rod.
    """
    rod, state, B, d = problem.robot.rod, problem.state, len(x), force.shape[-1]
    q, J = state.base.at.start - state.loads.at.stop, d * PLACES
    cell, share = _cells(at, PLACES)
    shared = (share.unsqueeze(-1) * force.unsqueeze(-2)).flatten(1, 2)
    cells = cell.flatten(1).unsqueeze(-1).expand(-1, -1, d)
    there = torch.zeros(B, PLACES + 1, d, dtype=DTYPE).scatter_add(1, cells, shared)[:, 1:].flatten(1)
    places = tuple(rod.length * (j + 1) / PLACES for j in range(PLACES))
    loads = PointCoordinates(PLACES, rod.length, rod.force_scale, places, friction=math.inf if d == 3 else None)
    wide = problem.of(replace(problem.unknowns, loads=loads))
    sums = evaluator(wide).sums(torch.cat([there, x[:, state.loads.at.stop :]], -1))
    A, pull = (v.nan_to_num(0.0) for v in ekf.TipCondition.of(sums.C, sums.r[:, -TIP_ROWS:]).reduced(sums.A[:, 0], sums.g[:, 0]))
    pull = pull + (A[:, :, :J] @ there.unsqueeze(-1)).squeeze(-1)
    u = slice(state.loads.at.stop, state.base.at.start)
    mean, precision = (v[..., u].expand(B, -1) for v in (problem.mean, problem.precision))
    own, pull_u = A[:, J:, J:] + torch.diag_embed(precision), pull[:, J:] + precision * (mean - x[:, u])
    U = _cubic()
    gram = torch.einsum("ci,bixjy,dj->bcdxy", U, A[:, :J, :J].reshape(B, PLACES, d, PLACES, d), U)
    cross = torch.einsum("ci,bixq->bcxq", U, A[:, :J, J:].reshape(B, PLACES, d, q))
    asked = torch.einsum("ci,bix->bcx", U, pull[:, :J].reshape(B, PLACES, d))
    information = Information.of(A, own, d) if informed else None
    return Response(gram.flatten(1, 2).flatten(-2), cross.flatten(-2), own, asked, pull_u, information)


@dataclass(frozen=True)
class Chart:
    """v of B fitted samples: all entries of x but the base wrench's, m of them. response: None where v are those entries."""

    problem: Problem
    x: Float[Tensor, "B n"]
    response: Response | None

    @classmethod
    def at(cls, problem: Problem, x: Float[Tensor, "B n"], jeffreys: bool = False) -> "Chart":
        """About the fits x. jeffreys: the prior of pushes is Jeffreys', not (2)."""
        bare = cls(problem, x, None)
        K = len(bare.places)
        if not K:
            return bare
        force = bare._with_forces(x)[:, bare.linear[: bare.components * K]]
        at, informed = torch.sigmoid(x[:, bare.places]), jeffreys and bare.has_pushes
        return cls(problem, x, _response(problem, x, at, force.unflatten(-1, (K, -1)), informed))

    def take(self, index: Int[Tensor, " b"]) -> "Chart":
        """The samples of an index."""
        if len(index) == len(self.x):
            return self
        response = None if self.response is None else self.response.take(index)
        return Chart(self.problem.take(index), self.x[index], response)

    @property
    def size(self) -> int:
        """m."""
        return self.problem.state.base.at.start

    @cached_property
    def places(self) -> list[int]:
        """The entries that are places eta; each follows the lateral components of its force."""
        loads = self.problem.unknowns.loads
        if not isinstance(loads, GaussianCoordinates | PointCoordinates) or loads.locations is not None:
            return []
        return [loads.per_load * k + 2 for k in range(loads.count)]

    @cached_property
    def in_order(self) -> Int[Tensor, "B K"]:
        """The entries of `places` in the order of the fit's loads along the rod."""
        places = torch.tensor(self.places, dtype=torch.int64)
        return places[self.x[:, places].argsort(dim=-1, stable=True)]

    @property
    def friction(self) -> float | None:
        """Of the contacts, where forces along the rod are unknown."""
        return getattr(self.problem.unknowns.loads, "friction", None)

    @property
    def components(self) -> int:
        """Of a force that is unknown: 2, or 3."""
        return 2 if self.friction is None else 3

    @cached_property
    def along(self) -> list[int]:
        """The entries xi."""
        after = getattr(self.problem.unknowns.loads, "per_load", 0) - 3
        return [] if self.friction is None else [i + after for i in self.places]

    @cached_property
    def linear(self) -> Int[Tensor, " l"]:
        """The entries l: forces, then u."""
        forces = [[i - 2, i - 1, *self.along[k : k + 1]] for k, i in enumerate(self.places)]
        return torch.tensor([*(j for force in forces for j in force), *range(self.problem.state.loads.at.stop, self.size)])

    def _per_xi(self, y: Float[Tensor, "... m"]) -> Float[Tensor, "... K"]:
        """dF_z/dxi at the lateral forces of y."""
        places = torch.tensor(self.places)
        force = torch.stack([y[..., places - 2], y[..., places - 1]], -1)
        return along_rod(force, torch.ones_like(force[..., 0]), self.friction or 0.0)

    def _with_forces(self, y: Float[Tensor, "... m"]) -> Float[Tensor, "... m"]:
        """y with F_z (force scales) in the place of xi."""
        if not self.along:
            return y
        z = y.clone()
        z[..., self.along] *= self._per_xi(y)
        return z

    def _with_entries(self, z: Float[Tensor, "... m"]) -> Float[Tensor, "... m"]:
        """The inverse."""
        if not self.along:
            return z
        y = z.clone()
        y[..., self.along] /= self._per_xi(z)
        return y

    def log_marginal(self, eta: Float[Tensor, "B D K"]) -> Float[Tensor, "B D"]:
        """log of how probable places of the loads are, forces integrated out to first order; but for a constant of each sample."""
        y = self.x[:, None, : self.size].expand(-1, eta.shape[1], -1).clone()
        y[..., self.places] = eta
        mu, L, gain = self._conditional(y)
        y = self._with_entries(y.index_copy(-1, self.linear, mu))
        turned = self._per_xi(y).log().sum(-1) if self.along else 0.0
        return 0.5 * gain - L.diagonal(dim1=-2, dim2=-1).log().sum(-1) + self.log_prior(y) - turned

    def _conditional(
        self, y: Float[Tensor, "B D m"]
    ) -> tuple[Float[Tensor, "B D l"], Float[Tensor, "B D l l"], Float[Tensor, "B D"]]:
        """mu and L of (1) at the places of y or v, and by how much the forces lower the cost."""
        found = self.response
        assert found is not None
        B, D, K, q, d = *y.shape[:2], len(self.places), found.own.shape[-1], self.components
        cell, share = self._shared(y)
        P = cell.shape[-1]
        pair = cell[:, :, :, None, :, None] * (CELLS + 1) + cell[:, :, None, :, None, :]
        by = share[:, :, :, None, :, None] * share[:, :, None, :, None, :]
        gram = found.gram.gather(1, pair.reshape(B, -1, 1).expand(-1, -1, d * d)).view(B, D, K, K, P * P, d * d)
        S_F = torch.einsum("bdijp,bdijpk->bdijk", by.reshape(B, D, K, K, P * P), gram)
        S_F = S_F.view(B, D, K, K, d, d).transpose(3, 4).reshape(B, D, d * K, d * K)
        flat = cell.reshape(B, -1, 1)
        cross = found.cross.gather(1, flat.expand(-1, -1, d * q)).view(B, D, K, P, d * q)
        S_Fu = (share.unsqueeze(-1) * cross).sum(-2).view(B, D, d * K, q)
        pull = (share.unsqueeze(-1) * found.pull.gather(1, flat.expand(-1, -1, d)).view(B, D, K, P, d)).sum(-2).view(B, D, d * K)
        S = torch.cat([torch.cat([S_F, S_Fu], -1), torch.cat([S_Fu.mT, found.own.unsqueeze(1).expand(-1, D, -1, -1)], -1)], -2)
        asked = torch.cat([pull, found.pull_u.unsqueeze(1).expand(-1, D, -1)], -1)
        mean, precision = self._prior_of_forces
        S[..., : d * K, : d * K] += torch.diag_embed(precision.expand(B, D, -1))
        asked[..., : d * K] += precision * mean
        size = S.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).sqrt()
        scaled = S / size.unsqueeze(-1) / size.unsqueeze(-2) + 1e-10 * torch.eye(S.shape[-1], dtype=DTYPE)
        L = size.unsqueeze(-1) * torch.linalg.cholesky_ex(scaled)[0]
        mu = torch.cholesky_solve(asked.unsqueeze(-1), L).squeeze(-1)
        gain = (mu * asked).sum(-1)
        mu[..., d * K :] += self.x[:, None, self.linear[d * K :]]
        return mu, L, gain

    @cached_property
    def _prior_of_forces(self) -> tuple[Tensor, Tensor]:
        """Mean and precision of the forces among l; of F_z at the lateral forces of the fit."""
        at = self.linear[: self.components * len(self.places)]
        mean, precision = (v[..., at] for v in (self.problem.mean, self.problem.precision))
        if self.along:
            per_xi = torch.ones(len(self.x), len(self.places), self.components, dtype=DTYPE)
            per_xi[..., 2] = self._per_xi(self.x)
            mean, precision = mean * per_xi.flatten(1), precision / per_xi.flatten(1) ** 2
        mean, precision = (v.unsqueeze(1) if v.ndim > 1 else v for v in (mean, precision))
        return mean, precision

    def _shared(self, y: Float[Tensor, "B D m"]) -> tuple[Int[Tensor, "B D K P"], Float[Tensor, "B D K P"]]:
        """Between which places the force of each load is shared, and how."""
        at, loads = torch.sigmoid(y[..., self.places]), self.problem.unknowns.loads
        if not isinstance(loads, GaussianCoordinates):
            return _cells(at, CELLS)
        width = torch.exp(-0.5 * y[..., [i + 1 for i in self.places]].clamp(-4, 20)) / math.sqrt(2)
        cell, share = _cells(_halves(at, width), CELLS)
        return cell.flatten(-2), 0.5 * share.flatten(-2)

    def to(self, y: Float[Tensor, "B D m"]) -> Float[Tensor, "B D m"]:
        """v of the entries y of x."""
        if self.response is None:
            return y
        (mu, L, _), v = self._conditional(y), self._with_forces(y).clone()
        v[..., self.linear] = (L.mT @ (v[..., self.linear] - mu).unsqueeze(-1)).squeeze(-1)
        return v

    def back(self, v: Float[Tensor, "B D m"]) -> tuple[Float[Tensor, "B D m"], Float[Tensor, "B D"]]:
        """y of v, and log |det dy/dv|."""
        if self.response is None:
            return v, v.new_zeros(v.shape[:-1])
        (mu, L, _), y = self._conditional(v), v.clone()
        y[..., self.linear] = mu + torch.linalg.solve_triangular(L.mT, v[..., self.linear].unsqueeze(-1), upper=True).squeeze(-1)
        y, log_det = self._with_entries(y), -L.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)
        return y, log_det - self._per_xi(y).log().sum(-1) if self.along else log_det

    def slope(self, y: Float[Tensor, "B m"]) -> Float[Tensor, "B m m"]:
        """dv/dy, by central differences."""
        if self.response is None:
            return torch.eye(self.size, dtype=y.dtype).expand(len(y), -1, -1)
        step = STEP * torch.eye(self.size, dtype=y.dtype)
        return ((self.to(y.unsqueeze(1) + step) - self.to(y.unsqueeze(1) - step)) / (2 * STEP)).mT

    @cached_property
    def _scale_free(self) -> list[_Sized]:
        """The forces and moments of any size, each group with a size of its own."""
        loads, found = self.problem.unknowns.loads, []
        if self.problem.prior is not None:
            return found
        if isinstance(loads, GaussianCoordinates | PointCoordinates) and loads.force_std == WEAK_STD and loads.count:
            lateral = [loads.per_load * k + i for k in range(loads.count) for i in range(2)]
            sides, across = self.problem.robot.rod.sides, across_strip(self.problem.robot.rod)
            if across is None or loads.friction == math.inf:
                along = self.along if loads.friction == math.inf else []
                found.append(_Sized(lateral + along, WEAK_STD, FAINT * min(1.0, *sides), push=True))
            else:
                soft = torch.stack([across[1], -across[0]])
                found.append(_Sized(lateral, WEAK_STD, FAINT * min(sides), soft, push=True))
                found.append(_Sized(lateral, WEAK_STD, GIVES_WAY, across))
        tip, rod = self.problem.state.tip, self.problem.robot.rod
        faint = FAINT_WRENCH if tip.size == 6 and not self.problem.state.loads.size else FAINT
        for first in range(tip.at.start, tip.at.stop, 3):  # across the base's axis, and along it
            turns = first > tip.at.start
            along = (TORQUE_STD, TWISTS) if turns else (TIP_STD, BUCKLES)
            unit = float(tip.unit[first - tip.at.start]) / (rod.moment_scale if turns else rod.force_scale)
            found += [_Sized([first, first + 1], TIP_STD, faint, unit=unit), _Sized([first + 2], *along, unit=unit)]
        return found

    @cached_property
    def _pushes(self) -> _Sized | None:
        """Those at unknown places whose prior, for intervals, is Jeffreys'."""
        return next((sized for sized in self._scale_free if sized.push), None) if self.places else None

    @property
    def has_pushes(self) -> bool:
        """Whether there are loads that Jeffreys' prior is of."""
        return self._pushes is not None

    def _log_jeffreys(self, y: Float[Tensor, "B D m"], information: Information) -> Float[Tensor, "B D"]:
        """log of Jeffreys' prior of pushes and their places, within the fit's weak prior of forces."""
        pushes, K, d = self._pushes, len(self.places), self.components
        assert pushes is not None
        F = self._with_forces(y)[..., self.linear[: d * K]].unflatten(-1, (K, d))
        axes = torch.eye(d, dtype=DTYPE)
        ways = axes[: len(pushes.at) // K] if pushes.axis is None else (pushes.axis @ axes[:2]).unsqueeze(0)
        weak = -0.5 * pushes.of(y).square().sum(-1) / pushes.weak**2
        return information.log_root(y[..., self.places], F, ways) + weak

    def fitted_prior(self, x: Float[Tensor, "B D n"]) -> Float[Tensor, "B D"]:
        """What the fit's cost holds of its own prior."""
        mean, precision = (v.unsqueeze(1) if v.ndim > 1 else v for v in (self.problem.mean, self.problem.precision))
        return (precision * (x - mean) ** 2).sum(-1)

    def log_prior(self, y: Float[Tensor, "B D m"]) -> Float[Tensor, "B D"]:
        """log p(y), normalized but for entries without a prior, and Jeffreys'."""
        m, total = self.size, y.new_zeros(y.shape[:-1])
        mean, precision = ((v.unsqueeze(1) if v.ndim > 1 else v)[..., :m] for v in (self.problem.mean, self.problem.precision))
        normal = torch.ones(m, dtype=torch.bool)
        information = None if self.response is None else self.response.information
        for sized in self._scale_free:
            if information is None or sized is not self._pushes:
                total = total + sized.log_prior(y)
            else:
                total = total + self._log_jeffreys(y, information)
            normal[sized.at] = False
        for i in self.places if self.problem.prior is None else ():
            if information is None:
                total = total + torch.nn.functional.logsigmoid(y[..., i]) + torch.nn.functional.logsigmoid(-y[..., i])
            normal[i] = False
        log_density = 0.5 * (torch.log(precision.clamp(min=1e-300) / (2 * math.pi)) - precision * (y - mean) ** 2)
        return total + torch.where(precision > 0, log_density, 0.0)[..., normal].sum(-1)
