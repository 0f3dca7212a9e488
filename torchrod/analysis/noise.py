"""The markers' noise from the residual of a fit, where nobody knows it.

    (1)  sigma^2 = sum |r|^2 / nu,   nu = 3 P - (unknowns that the markers alone determine)

is unbiased for a model that explains the markers, with a relative standard deviation of 1 / sqrt(2 nu) of sigma. A fit needs a
sigma and gives one: a few rounds settle to 1 %. Each sample has its own, so that its answer does not depend on its batch.

What this costs: an estimate divided by its standard deviation then follows Student's t with nu degrees of freedom, so that
standard deviations are multiplied by t_97.5 % / 1.96 to make 95 % of 1.96 of them. And chi^2 is nu by construction: whether the
model explains the markers is judged by whether neighbouring residuals are alike. With white noise the correlation

    (2)  rho = sum r_i . r_(i+1) / sum |r_i|^2

is normal with standard deviation 1 / sqrt(3 (P - 1)) or less; loads missing in the model leave a smooth residual, rho near 1.
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace

import torch
from jaxtyping import Bool, Float
from scipy.special import stdtrit
from torch import Tensor

from ..estimation.result import Z95, Estimate
from ..estimation.solve import Settings, estimate_each
from ..estimation.starts import Origin, Start, StartRule, cold_start
from ..model.problem import Problem
from ..model.unknowns import Unknowns

FIRST = 1 / 400  # of the rod's length: 1 mm on the paper's
ROUNDS = 6
SETTLED = 0.01  # relative change of sigma
LEAST = 1e-5  # of the rod's length: less is finer than what the width of a load and the steps of the model leave
SMOOTH = 3.09  # standard deviations of rho: 99.9 %


@dataclass(frozen=True)
class Noise:
    """sigma (B,) m and its standard deviation, std (B,) m; freedom (B,): nu, the degrees of freedom of the residual.

    NaN where nothing is left to tell it from. std is 0 where the residual is smaller than LEAST, which then stands in for sigma,
    and chi^2 is a test as ever. Source: (1) of torchrod/analysis/noise.py.
    """

    sigma: Float[Tensor, " B"]
    std: Float[Tensor, " B"]
    freedom: Float[Tensor, " B"]

    def judged(self, fit: Estimate) -> Estimate:
        """The fit with spreads for a noise that was estimated, accepted where the residual is white (2)."""
        told = self.std != 0
        factor = torch.from_numpy(stdtrit(self.freedom.clamp(min=1).numpy(), 0.975)).where(told, Z95) / Z95

        def wider(C: Tensor | None) -> Tensor | None:
            return None if C is None else C * factor.square().reshape(-1, *[1] * (C.ndim - 1))

        spreads = {name: wider(getattr(fit, name)) for name in ("covariance", "load_covariance", "tip_covariance")}
        std = None if fit.tension_std is None else fit.tension_std * factor.unsqueeze(-1)
        return replace(fit, accepted=fit.accepted & (white(fit) | ~told), tension_std=std, **spreads)


def white(fit: Estimate) -> Bool[Tensor, " B"]:
    """(2): whether neighbouring residuals are no more alike than chance allows."""
    r = torch.where(fit.outlier.unsqueeze(-1), 0.0, fit.residual.nan_to_num(0.0))
    seen = (r != 0).any(-1)
    pairs = (seen[:, 1:] & seen[:, :-1]).sum(-1)
    rho = (r[:, 1:] * r[:, :-1]).sum((-1, -2)) / r.square().sum((-1, -2)).clamp(min=1e-300)
    return rho < SMOOTH / (3 * pairs.clamp(min=1)).sqrt()


def _spent(problem: Problem) -> int:
    """What the unknowns take of the marker coordinates: nu of (1) is 3 for every marker that the fit uses, less this."""
    return problem.state.free_size - problem.state.loads.informative


def _sigma(problem: Problem, fit: Estimate) -> tuple[Float[Tensor, " B"], Float[Tensor, " B"]]:
    """(1), over the markers that are not outliers."""
    used = torch.isfinite(fit.residual[..., 0]) & ~fit.outlier
    nu = 3.0 * used.sum(-1) - _spent(problem)
    square = torch.where(used, fit.residual.square().sum(-1), 0.0).sum(-1)
    return torch.where(nu > 0, (square / nu).sqrt().clamp(min=LEAST * problem.robot.rod.length), torch.nan), nu


def with_noise(problem: Problem, sigma: float | Float[Tensor, " B"]) -> Problem:
    """The problem with another noise (m) of its markers, one for all samples or one for each."""
    markers = problem.markers
    assert markers is not None
    return replace(problem, sensors=[replace(markers, noise=sigma)])


def estimate_noise(
    problem: Problem, settings: Settings | None = None, start: StartRule = cold_start
) -> tuple[Noise, Float[Tensor, " B"]]:
    """The noise of every sample's markers by fits of a problem that must be rich enough to explain them; and the noise to fit with.

    The markers must be its only sensor; their stated noise plays no part. The second value is finite for every sample, also where
    nothing tells the noise: give a fit of `with_noise(problem, sigma)` to Noise.judged. Errors: ValueError as torchrod.estimate,
    and for other sensors.
    """
    if problem.markers is None or problem.markers.s_std is not None:
        raise ValueError("the noise can be estimated of markers alone, at known arc lengths; state the noise where more was read")
    L, settings = problem.robot.rod.length, replace(settings or Settings(), restarts=())
    sigma = torch.full((problem.batch,), FIRST * L, dtype=torch.float64)
    begin: StartRule | Start = start
    nu, settled = torch.zeros_like(sigma), torch.zeros_like(sigma, dtype=torch.bool)
    for _ in range(ROUNDS):
        fit = estimate_each(with_noise(problem, sigma), settings, begin)
        found, freedom = _sigma(problem, fit)
        moved = (found / sigma).log().abs().nan_to_num(0.0)
        # A sample that has settled stays, whatever its neighbours do.
        onward = found.where(torch.isfinite(found), sigma)
        sigma, nu = torch.where(settled, sigma, onward), torch.where(settled, nu, freedom)
        settled = settled | (moved < SETTLED)
        if bool(settled.all()):
            break
        begin = Start(fit.x, torch.full_like(fit.origin, int(Origin.OTHER_FIT)), torch.isfinite(fit.x).all(-1))
    known = nu > 0
    std = torch.where(sigma > LEAST * L, sigma / (2 * nu.clamp(min=1)).sqrt(), 0.0)
    return Noise(sigma.where(known, torch.nan), std.where(known, torch.nan), nu), sigma


def estimate_noise_among(
    problem: Problem, candidates: Sequence[Unknowns], settings: Settings | None = None, start: StartRule = cold_start
) -> tuple[Noise, Float[Tensor, " B"]]:
    """The same where nobody knows the number of loads either: unknowns of the same kind, each with more loads than the one before.

    The richest that a sample has markers for tells its noise. It contains the others, so that its residual is the least of all;
    where a poorer one leaves less, the fit of the richest has not settled, and the poorer one tells it. Without that a tenth of the
    samples without a load, and 3 % of those with one, get a noise up to 14 times too large when it is 0.2 mm. Unknowns without a
    load never stand in for those that have too few markers: they would take a load for noise. Nor do any that leave more markers
    aside as outliers: a robust fit with too few loads calls most of them so. Errors: ValueError as estimate_noise.
    """
    problems = [problem.of(unknowns) for unknowns in candidates]
    fitting = [p for p in problems if p.determined] or problems[:1]
    noise, sigma = estimate_noise(fitting[-1], settings, start)
    used = noise.freedom + _spent(fitting[-1])
    for poorer in reversed(fitting[:-1]):
        other, by_other = estimate_noise(poorer, settings, start)
        by_more = other.freedom + _spent(poorer)
        less = (other.sigma.square() * other.freedom < noise.sigma.square() * noise.freedom) & (by_more >= used)
        loaded = poorer.state.external.stop > 0
        swap = less | (torch.isnan(noise.sigma) & torch.isfinite(other.sigma) & loaded)
        used = torch.where(swap, by_more, used)
        noise = Noise(*(torch.where(swap, theirs, mine) for mine, theirs in zip(astuple(noise), astuple(other), strict=True)))
        sigma = torch.where(swap, by_other, sigma)
    return noise, sigma
