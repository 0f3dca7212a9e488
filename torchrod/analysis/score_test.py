"""Would one more load help, and where? Score tests on the residual of a fit, and the start it suggests for a fit with that load.

At a fit, add a point-like load at each of J places, with no force yet. With b the entries of the fitted state, c the two force
components at one place, A = H^T W H + P and g = H^T W r + P (x0 - x), to first order in the new force

    (1)  S = A_cc - A_cb A_bb^-1 A_bc            information on the force, everything else free
    (2)  F = S^-1 (g_c - A_cb A_bb^-1 g_b)       the force that the residual asks for
    (3)  drop = F^T S F                          by which the cost would fall: chi^2 with 2 degrees of freedom without a load there
    (4)  x_b moves by A_bb^-1 (g_b - A_bc F)

A force at the tip has three components, and its drop 3 degrees of freedom.
Source: Rao's score test (1948), in the information form of estimation.filter.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..estimation import filter as ekf
from ..estimation.evaluator import evaluator, normal
from ..estimation.joint import eliminated
from ..estimation.solve import linearize
from ..estimation.starts import Origin, Start
from ..mechanics.loads import GaussianLoads, Load
from ..model.load_families import Gamma, GaussianCoordinates
from ..model.load_families.family import logit
from ..model.problem import Problem
from ..model.unknowns import Unknowns
from ..util.precision import DTYPE

PLACES = 16  # along the rod, evenly spaced up to the tip: closer than two pushes can be told apart
BOLD = 3.0  # no force of a start is larger than this many force scales: (2) is linear


@dataclass(frozen=True)
class _WithCandidates:
    """The coordinates of a fit with point-like loads of zero force at fixed places behind them."""

    fitted: GaussianCoordinates
    places: tuple[float, ...]

    @property
    def informative_priors(self) -> int:
        return 0

    @property
    def size(self) -> int:
        return self.fitted.size + 2 * len(self.places)

    def loads(self, gamma: Gamma) -> tuple[Load, ...]:
        first = self.fitted.size
        c = torch.full((len(self.places),), 0.5 / (self.fitted.length / 100) ** 2, dtype=DTYPE)
        force = gamma[..., first:].unflatten(-1, (-1, 2)) * self.fitted.force_scale
        mu = torch.tensor(self.places, dtype=DTYPE).expand(force.shape[:-1])
        return (
            *self.fitted.loads(gamma[..., :first]),
            GaussianLoads(force * (c / torch.pi).sqrt().unsqueeze(-1), mu, c.expand_as(mu)),
        )

    def prior(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        mean, precision = self.fitted.prior()
        none = mean.new_zeros(2 * len(self.places))
        return torch.cat([mean, none]), torch.cat([precision, none])


@dataclass(frozen=True)
class ScoreTest:
    """Per sample, at the place that helps most: drop (B,) of the cost, force (B, 2) in force scales, eta (B,), and the fitted state
    x (B, n) moved along with it.
    """

    drop: Float[Tensor, " B"]
    force: Float[Tensor, "B 2"]
    eta: Float[Tensor, " B"]
    x: Float[Tensor, "B n"]

    def take(self, index: Int[Tensor, " b"]) -> "ScoreTest":
        """The samples of an index."""
        return ScoreTest(self.drop[index], self.force[index], self.eta[index], self.x[index])


def score_test(problem: Problem, x: Float[Tensor, "B n"]) -> ScoreTest:
    """The score test of one load more, at the fit x (B, n) of a problem with Gaussian loads, in the units of Problem.state.

    It evaluates the model once, at x, with a point-like load of no force at each of PLACES places, and tells what a first-order
    step of its force would take off the cost. Errors: ValueError for loads of another family. Source: Rao 1948; (1)-(4) of
    torchrod/analysis/score_test.py.
    """
    fitted = problem.unknowns.loads
    if not isinstance(fitted, GaussianCoordinates):
        raise ValueError(f"score_test: the loads are {type(fitted).__name__}; give a problem with GaussianCoordinates")
    L, g = fitted.length, fitted.size
    places = tuple(L * (j + 1) / PLACES for j in range(PLACES))
    wide = problem.of(replace(problem.unknowns, loads=_WithCandidates(fitted, places)))
    nothing = x.new_zeros(len(x), 2 * PLACES)
    # In equilibrium: slack at the tip would take up part of what a weak load does.
    at = linearize(wide, torch.cat([x[:, :g], nothing, x[:, g:]], -1), exact=True)
    assert at.tip is not None
    c, T = torch.arange(g, g + 2 * PLACES), at.tip.T
    found = eliminated(*at.tip.reduced(at.A, at.g), c)
    both = torch.cat([found.G, found.step.unsqueeze(-1)], -1)
    # And how the base wrench follows: T of those that stay, T of the new force, d.
    follows = torch.cat([T[:, :, c], at.tip.d.unsqueeze(-1)], -1) - torch.cat([T[:, :, :g], T[:, :, g + 2 * PLACES :]], -1) @ both
    both = torch.cat([both, follows], 1)
    pair = 2 * torch.arange(PLACES).unsqueeze(-1) + torch.arange(2)
    S, g_c = found.S[:, pair.unsqueeze(-1), pair.unsqueeze(-2)], found.q
    F = ekf.solve_spd(S.flatten(0, 1), g_c[:, pair].flatten(0, 1).unsqueeze(-1)).squeeze(-1).unflatten(0, (-1, PLACES))
    drop = (F * g_c[:, pair]).sum(-1).nan_to_num(0.0)
    best = drop.argmax(-1)
    return _at_best(best, drop, F, both, pair, x)


def drop_by_tip_force(problem: Problem, x: Float[Tensor, "B n"], nu: float = math.inf) -> Float[Tensor, " B"]:
    """The score test of a force at the tip, at the fit x (B, n) of a problem with nothing unknown there, in the units of
    Problem.state: (3) is chi^2 with 3 degrees of freedom where there is none. nu: of Student's t, as for `evaluator`.
    """
    first, wide = problem.state.tip.at.start, problem.of(replace(problem.unknowns, tip="force"))
    at = torch.cat([x[:, :first], x.new_zeros(len(x), 3), x[:, first:]], -1)
    N = normal(wide, evaluator(wide, nu).sums(at)).readings
    assert N.tip is not None
    A, g, _ = N.whole(at, wide.mean, wide.precision)
    found = eliminated(*N.tip.reduced(A, g), first + torch.arange(3))
    return ekf.decrement(found.S, found.q)


def _at_best(
    best: Int[Tensor, " B"], drop: Tensor, F: Tensor, both: Tensor, pair: Int[Tensor, "J 2"], x: Float[Tensor, "B n"]
) -> ScoreTest:
    """The place of the largest drop of every sample, with (4)."""
    rows = torch.arange(len(best))
    force = F[rows, best].nan_to_num(0.0)
    force = force * (BOLD / force.norm(dim=-1, keepdim=True).clamp(min=1e-12)).clamp(max=1.0)
    columns = both[..., :-1].gather(-1, pair[best].unsqueeze(1).expand(-1, both.shape[1], -1))
    moved = x + (both[..., -1] - (columns @ force.unsqueeze(-1)).squeeze(-1)).nan_to_num(0.0)
    eta = torch.tensor([logit(min((j + 1) / PLACES, 0.98)) for j in range(PLACES)], dtype=DTYPE)
    return ScoreTest(drop[rows, best], force, eta[best], moved)


def start_with_one_more(unknowns: Unknowns, found: ScoreTest) -> Start:
    """A start for unknowns with one Gaussian load more than the fit that was tested."""
    coordinates = unknowns.loads
    assert isinstance(coordinates, GaussianCoordinates)
    g = coordinates.size - coordinates.per_load
    x = torch.cat([found.x[:, :g], coordinates.one_more(found.force, found.eta), found.x[:, g:]], -1)
    return Start.at(x, Origin.SCORE_TEST, challenged=True)
