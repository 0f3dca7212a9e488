"""The result of an estimate: loads, how sure, how well they explain the readings, and what became of every sample."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int
from scipy.special import chdtri
from torch import Tensor

from ..kernel import Sums
from ..mechanics.jacobian import pointwise_jacobian
from ..mechanics.loads import FourierLoads, GaussianLoads, Load, PointForces, on_rod_fraction
from ..model.load_families import GaussianCoordinates, LoadFamily
from ..model.problem import TIP_ROWS, Problem
from ..util.precision import DTYPE
from ..util.status import Status
from . import filter as ekf
from .evaluator import Evaluator
from .load_profile import Profile
from .starts import Fate, Origin

Z95 = 1.959964  # of the standard normal distribution
SAME_PROFILE, COSINES = 0.05, 40  # of the peak; of a profile that is drawn
ACCEPT = 0.999  # accepted: chi^2 below this quantile of its distribution


@dataclass(frozen=True)
class FittedRod:
    """What a figure needs of one sample: force (K, 2) N (section frame), location (K,) m, width (K,) m (0: a point force), base
    wrench (6,) [N, N m], the registration (6,) [m, rad] that carries the rod into the measured frame, or None, the unknown
    force (3,) N at the tip in the base frame, or None, the 95 % intervals (K, 2) m of the locations, NaN where they are not
    known, and the load profile with its band; both None where only the shape is to be drawn. axial (K,) N: the forces along the
    rod, or None. errors: of the robot's parameters, by their names (model.uncertainty).
    """

    force: Float[Tensor, "K 2"]
    location: Float[Tensor, " K"]
    width: Float[Tensor, " K"]
    base_wrench: Float[Tensor, " 6"]
    registration: Float[Tensor, " 6"] | None = None
    tip_force: Float[Tensor, " 3"] | None = None
    location_interval: Float[Tensor, "K 2"] | None = None
    profile: Profile | None = None
    axial: Float[Tensor, " K"] | None = None
    errors: Mapping[str, float] = field(default_factory=dict)

    @property
    def pushes(self) -> Float[Tensor, "K 3"]:
        """The forces with what is along the rod (N, section frame)."""
        axial = torch.zeros_like(self.location) if self.axial is None else self.axial
        return torch.cat([self.force, axial.unsqueeze(-1)], -1)

    def loads(self, length: float) -> tuple[Load, ...]:
        """The loads as mechanics.loads has them: of a profile that is not that of Gaussians, a series of cosines."""
        series = self._series(length)
        if series is not None:
            return (series,)
        point = self.width <= 0
        c = 0.5 / self.width[~point] ** 2
        spread = (math.pi / c).sqrt() * on_rod_fraction(self.location[~point], c, length)
        force = self.pushes
        smooth = GaussianLoads(force[~point] / spread.unsqueeze(-1), self.location[~point], c)
        return (smooth, PointForces(force[point], self.location[point]))

    def _series(self, length: float) -> FourierLoads | None:
        """The profile in cosines; None where there is none, or the loads are Gaussians that have it already."""
        if self.profile is None or not len(self.location) or bool((self.width <= 0).any()):
            return None
        s, f = self.profile.s, self.profile.f
        density = replace(self, profile=None).loads(length)[0].density(s)
        assert density is not None
        if float((density[..., :2] - f).norm(dim=-1).max()) < SAME_PROFILE * float(f.norm(dim=-1).max()):
            return None
        wave = torch.cos(torch.arange(COSINES, dtype=DTYPE) * math.pi * s.unsqueeze(-1) / length)
        amplitude = 2 / length * torch.trapezoid(f.unsqueeze(-1) * wave.unsqueeze(-2), s, dim=0)
        amplitude[:, 0] /= 2
        return FourierLoads(amplitude, torch.zeros_like(amplitude[:, 1:]), 2 * length)


@lru_cache(maxsize=4096)
def limit(dof: int) -> float:
    """The 99.9 % point of chi^2."""
    return float(chdtri(max(dof, 1), 1 - ACCEPT))


@lru_cache(maxsize=64)
def _limits(most: int) -> Float[Tensor, " K"]:
    """That of 0 to so many degrees of freedom."""
    return torch.tensor([limit(dof) for dof in range(most + 1)], dtype=DTYPE)


def verdict(
    evaluate: Evaluator, sums: Sums, cost: Float[Tensor, " B"]
) -> tuple[Bool[Tensor, "B G"], Float[Tensor, " B"], Int[Tensor, " B"], Bool[Tensor, " B"]]:
    """outlier, chi2 and dof of Estimate, and whether the fit explains the readings: one that leaves most aside does not."""
    problem = evaluate.problem
    read, state = problem.seen, problem.state
    outlier, chi2 = torch.zeros(problem.batch, problem.group_count, dtype=torch.bool), cost.clone()
    most_inside = read > 0
    if math.isfinite(evaluate.nu):
        present, groups, m = problem.present, problem.groups, len(problem.groups)
        rows = torch.bincount(groups).tolist()
        square = ekf.by_group((problem.weights * sums.r**2)[:, :m], groups)
        outlier = present & (square > torch.tensor([limit(k) for k in rows], dtype=DTYPE))
        inside = present & ~outlier
        chi2 = cost - sums.cost[:, 0] + (square * inside).sum(-1)
        read = read - (outlier[:, groups] & (problem.weights[:, :m] > 0)).sum(-1)
        most_inside = 2 * inside.sum(-1) > present.sum(-1)
    dof = read + TIP_ROWS + state.informative - state.size
    most = problem.weights.shape[-1] + state.size
    return outlier, chi2, dof, (chi2 < _limits(most)[dof.clamp(min=0)]) & most_inside


MOST_SHOWN = 5  # samples, where an estimate is printed


@dataclass(frozen=True)
class Estimate:
    """Everything known of B samples after the fit. Status codes are torchrod.Status; SI units; forces in the section frame.

    x, covariance: the state in the units of Problem.state and its posterior (H^T W H + P)^-1 with the true noise; covariances are
    NaN where the fit has not converged. As in any Kalman filter x is one update further than the evaluation of the model that the
    covariance, the residual and the centre line are of, by less than what 1e-3 of chi^2 can tell; cost and chi2 are foretold for x.
    force (B, K, 2) N, location (B, K) m, width (B, K) m, and the covariance (B, K, 4, 4) of [F_x, F_y, location, width].
    net_force (B, K, 2): the paper's (13), which counts the part of a Gaussian beyond the tip; `force` is what the rod feels.
    axial, axial_std (B, K) N: the forces along the rod, positive towards the tip, None where loads are normal to the rod; neither
    `force` nor `magnitude` counts them.
    tip (B, 6) [N, N m] and tip_covariance (B, 6, 6): the unknown dead wrench at the tip, base frame, zero in the entries that are
    not unknown; None without Unknowns.tip. base_wrench (B, 6) [N, N m] and registration (B, 6) [m, rad] or None. centre_line
    (B, P, 3) m: the fitted rod at the sensors' arc lengths, in the base frame. residual (B, K, 3) m: of all rows that are positions
    (markers), measured minus fitted, NaN where missing; row_residual (B, rows): of every row, in its own unit, 0 where missing.
    iterations (B,): evaluations of h and H, of all attempts; restarts (B,): further attempts, cold or from other magnitudes.
    origin (B,): where the fit that is reported began; guess, fate (B,): the start that was given and what became of it (codes of
    estimation.starts Origin and Fate). tension, tension_std (B, T) N: as found; None where they are taken as exact. outlier (B, G):
    groups of rows (a marker each) that a robust fit has left aside. cost (B,): what was minimized; chi2: the same of the other
    groups, as the normal distribution has it. dof (B,), accepted: chi2 below its 99.9 % point; a sample may have converged to a fit
    that does not explain the data. coarse (B,): steps that were refined as far as they go do not follow the load; unstable (B,): no
    rod stays in the equilibrium that was found unless what pushes also holds it. Neither is accepted, but for an unstable one where
    something pushes. rod_length (B,): m, beyond which no location lies.
    """

    x: Float[Tensor, "B n"]
    covariance: Float[Tensor, "B n n"]
    force: Float[Tensor, "B K 2"]
    location: Float[Tensor, "B K"]
    width: Float[Tensor, "B K"]
    load_covariance: Float[Tensor, "B K 4 4"]
    net_force: Float[Tensor, "B K 2"]
    axial: Float[Tensor, "B K"] | None
    axial_std: Float[Tensor, "B K"] | None
    tip: Float[Tensor, "B 6"] | None
    tip_covariance: Float[Tensor, "B 6 6"] | None
    base_wrench: Float[Tensor, "B 6"]
    registration: Float[Tensor, "B 6"] | None
    centre_line: Float[Tensor, "B P 3"]
    residual: Float[Tensor, "B Q 3"]
    row_residual: Float[Tensor, "B rows"]
    tension: Float[Tensor, "B T"] | None
    tension_std: Float[Tensor, "B T"] | None
    parameters: Float[Tensor, "B m"] | None
    parameters_std: Float[Tensor, "B m"] | None
    outlier: Bool[Tensor, "B G"]
    cost: Float[Tensor, " B"]
    chi2: Float[Tensor, " B"]
    dof: Int[Tensor, " B"]
    accepted: Bool[Tensor, " B"]
    iterations: Int[Tensor, " B"]
    restarts: Int[Tensor, " B"]
    status: Int[Tensor, " B"]
    origin: Int[Tensor, " B"]
    guess: Int[Tensor, " B"]
    fate: Int[Tensor, " B"]
    coarse: Bool[Tensor, " B"]
    unstable: Bool[Tensor, " B"]
    rod_length: Float[Tensor, " B"]

    def __repr__(self) -> str:
        """How many samples came to what, and the loads of the first with their standard deviations; all else is in the fields."""
        B, converged = len(self.status), int((self.status == int(Status.CONVERGED)).sum())
        lines = [f"Estimate of {B} sample{'s' * (B != 1)}: {converged} converged, {int(self.accepted.sum())} accepted"]
        columns = (self.magnitude, self.magnitude_std, self.location, self.location_std)
        for b, rows in enumerate(zip(*(column[:MOST_SHOWN].tolist() for column in columns), strict=True)):
            loads = [
                f"{F:.4g} +- {dF:.2g} N at {s:.4g} +- {ds:.2g} m" for F, dF, s, ds in zip(*rows, strict=True) if not math.isnan(F)
            ]
            if self.tip is not None and bool(torch.isfinite(self.tip[b]).all()):
                loads.append(f"({', '.join(f'{v:.4g}' for v in self.tip[b, :3].tolist())}) N at the tip")
            lines.append(f"  {b}: {'; '.join(loads) or 'no load'}")
        return "\n".join([*lines, *["  ..."] * (B > MOST_SHOWN)])

    @property
    def warm_started(self) -> Bool[Tensor, " B"]:
        """Whether the fit that is reported began from a learned start or from the frame before."""
        return (self.origin == int(Origin.LEARNED)) | (self.origin == int(Origin.PREVIOUS))

    @property
    def magnitude(self) -> Float[Tensor, "B K"]:
        """|F| (N), normal to the rod."""
        return self.force.norm(dim=-1)

    @property
    def magnitude_std(self) -> Float[Tensor, "B K"]:
        """Standard deviation of |F| (N), along the force's direction; where there is no force, of one component."""
        return self.magnitude_location_covariance[..., 0, 0].clamp(min=0).sqrt()

    @property
    def magnitude_location_covariance(self) -> Float[Tensor, "B K 2 2"]:
        """Covariance of (|F|, location) [N^2, N m; N m, m^2], |F| as in magnitude_std."""
        size = self.magnitude.unsqueeze(-1)
        along = torch.where(size > 0, self.force / size, torch.full_like(self.force, 0.5**0.5))
        zero = torch.zeros_like(size)
        J = torch.stack([torch.cat([along, zero], -1), torch.cat([zero, zero, zero + 1], -1)], -2)
        return J @ self.load_covariance[..., :3, :3] @ J.mT

    @property
    def location_std(self) -> Float[Tensor, "B K"]:
        """Standard deviation of the location (m)."""
        return self.load_covariance[..., 2, 2].clamp(min=0).sqrt()

    @property
    def log_covariance(self) -> Float[Tensor, "B K 3 3"]:
        """Covariance of [log |F|, direction (rad, about the rod), log location].

        A push nearer the base looks like a weaker one farther out: the region of (force, location) is a banana in newtons and
        metres and an ellipse in their logarithms, so this is the one to build joint regions from (docs/reproduction.md).
        """
        size = self.magnitude.unsqueeze(-1)
        along = self.force / size
        across = torch.stack([-along[..., 1], along[..., 0]], -1)
        zero = torch.zeros_like(size)
        place = torch.cat([zero, zero, 1 / self.location.unsqueeze(-1)], -1)
        J = torch.stack([torch.cat([along / size, zero], -1), torch.cat([across / size, zero], -1), place], -2)
        return J @ self.load_covariance[..., :3, :3] @ J.mT

    @property
    def magnitude_interval(self) -> Float[Tensor, "B K 2"]:
        """95 % interval of |F| (N)."""
        return _interval(self.magnitude, self.magnitude_std)

    @property
    def location_interval(self) -> Float[Tensor, "B K 2"]:
        """95 % interval of the location (m), on the rod."""
        return _interval(self.location, self.location_std).minimum(self.rod_length[:, None, None])

    @property
    def rms_residual(self) -> Float[Tensor, " B"]:
        """Root of the mean squared distance between measured and fitted markers (m), over those that were seen."""
        return self.residual.square().sum(-1).nanmean(-1).sqrt()

    def message(self, sample: int) -> str:
        """What became of a sample, with the remedy; a second sentence where the start that it was given did not serve."""
        guess, fate = Origin(int(self.guess[sample])), Fate(int(self.fate[sample]))
        said = ""
        if guess in (Origin.LEARNED, Origin.PREVIOUS):
            said = {
                Fate.DROPPED: f"The {guess.label} was no nearer to the markers than a cold one and was dropped.",
                Fate.RETRIED: f"The fit from the {guess.label} was not accepted, so a cold start was tried as well.",
            }.get(fate, "")
        return f"{self._outcome(sample)} {said}".strip()

    @property
    def messages(self) -> list[str]:
        """Of every sample."""
        usual = (self.status == int(Status.CONVERGED)) & self.accepted & ~self.unstable & (self.fate == int(Fate.USED))
        return [Status.CONVERGED.message if fine else self.message(b) for b, fine in enumerate(usual.tolist())]

    def _outcome(self, sample: int) -> str:
        status = Status(int(self.status[sample]))
        if status is Status.CONVERGED and self.unstable[sample]:
            return (
                "Converged, but to an equilibrium that is unstable under dead loads: no rod stays there unless what pushes also "
                "holds it; otherwise check gravity, mass and tip."
            )
        if status is not Status.CONVERGED or self.accepted[sample]:
            return status.message
        if self.coarse[sample]:
            return "Converged, but to a load that bends the rod too sharply for any steps: check units and marker order."
        chi2, dof = float(self.chi2[sample]), int(self.dof[sample])
        reason = f"chi2 = {chi2:.3g} for {dof} degrees of freedom"
        if chi2 < limit(dof):
            reason = "most markers were left aside, or neighbouring residuals are too much alike for noise"
        remedy = "allow more contacts, state more noise, or check tensions, gravity and registration"
        what = "markers" if self.residual.shape[1] else "readings"
        return f"Converged, but {reason}: the model does not explain the {what}; {remedy}."

    def fitted_rod(
        self, sample: int, profile: Profile | None = None, location_interval: Float[Tensor, "B K 2"] | None = None
    ) -> FittedRod:
        """What a figure needs of one sample. profile (torchrod.load_profile), location_interval: of all samples, if not its own."""
        zeta = None if self.registration is None else self.registration[sample]
        there = torch.isfinite(self.location[sample])
        tip = None if self.tip is None or bool(self.tip[sample].isnan().all()) else self.tip[sample, :3]
        loads = (self.force[sample][there], self.location[sample][there], self.width[sample][there])
        intervals = self.location_interval if location_interval is None else location_interval
        interval, along = intervals[sample][there], None if profile is None else profile.of(sample)
        axial = None if self.axial is None else self.axial[sample][there]
        return FittedRod(*loads, self.base_wrench[sample], zeta, tip, interval, along, axial)

    def improved_by(self, other: "Estimate", index: Int[Tensor, " b"]) -> "Estimate":
        """With the samples of `index` replaced by those of another attempt where that is better; every attempt is counted.

        Better: accepted where this one is not, else of lower cost, unless only this one has converged. What is said of the start
        that was given stays.
        """
        was, lower = self.accepted[index], other.cost < self.cost[index].nan_to_num(torch.inf)
        lost = (self.status[index] == int(Status.CONVERGED)) & (other.status != int(Status.CONVERGED))
        better = (other.accepted & ~was) | ((other.accepted == was) & lower & ~lost)
        merged = self.merged(other, index, better)
        return replace(
            merged, guess=self.guess, fate=self.fate, restarts=merged.restarts.index_add(0, index, torch.ones_like(index))
        )

    def merged(self, other: "Estimate", index: Int[Tensor, " b"], better: Bool[Tensor, " b"]) -> "Estimate":
        """With the samples of `index` that are better in `other`, which holds only those samples; every evaluation is counted.

        Where one of the two has more loads or unknowns, entries that the other does not have are NaN.
        """
        changed: dict[str, Tensor | None] = {}
        for f in fields(Estimate):
            mine, theirs = getattr(self, f.name), getattr(other, f.name)
            if mine is None and theirs is None:
                changed[f.name] = None
                continue
            mine, theirs = _alike(mine, theirs, (len(self.status), len(index)))
            mine[index[better]] = theirs[better]
            changed[f.name] = mine
        changed["iterations"] = self.iterations.index_add(0, index, other.iterations)
        changed["restarts"] = self.restarts.index_add(0, index, other.restarts)
        return Estimate(**changed)  # pyright: ignore[reportArgumentType]

    def of(self, index: Int[Tensor, " b"], size: int) -> "Estimate":
        """The samples of an index, with the first `size` entries of x: what unknowns of theirs have of a batch that has more."""
        taken = {f.name: None if (v := getattr(self, f.name)) is None else v[index] for f in fields(Estimate)}
        taken |= {"x": self.x[index, :size], "covariance": self.covariance[index, :size, :size]}
        return Estimate(**taken)  # pyright: ignore[reportArgumentType]

    @staticmethod
    def cat(parts: list["Estimate"]) -> "Estimate":
        """Join the estimates of several chunks."""
        if len(parts) == 1:
            return parts[0]

        def joined(values: list[Tensor | None]) -> Tensor | None:
            present = [v for v in values if v is not None]
            return torch.cat(present) if present else None

        return Estimate(**{f.name: joined([getattr(p, f.name) for p in parts]) for f in fields(Estimate)})  # pyright: ignore[reportArgumentType]


def _alike(mine: Tensor | None, theirs: Tensor | None, counts: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Copies of the same trailing shape, filled up with NaN; of one that is None, nothing but NaN."""
    present = [v for v in (mine, theirs) if v is not None]
    wide = tuple(max(sizes) for sizes in zip(*(v.shape[1:] for v in present), strict=True))

    def padded(v: Tensor | None, count: int) -> Tensor:
        if v is not None and v.shape[1:] == wide:
            return v.clone()
        full = torch.full((count, *wide), torch.nan, dtype=present[0].dtype)
        if v is not None:
            full[(slice(None), *(slice(0, n) for n in v.shape[1:]))] = v
        return full

    return padded(mine, counts[0]), padded(theirs, counts[1])


def _interval(value: Float[Tensor, "B K"], std: Float[Tensor, "B K"]) -> Float[Tensor, "B K 2"]:
    """95 %: symmetric in the logarithm where that is well known (to a factor of about e), else in the value, and not below 0."""
    relative = std / value
    sign = value.new_tensor([-1.0, 1.0]) * Z95
    by_factor = value.unsqueeze(-1) * torch.exp(sign * relative.unsqueeze(-1))
    by_difference = (value.unsqueeze(-1) + sign * std.unsqueeze(-1)).clamp(min=0)
    return torch.where((relative < 0.5).unsqueeze(-1), by_factor, by_difference)


def load_covariance(c: LoadFamily, gamma: Float[Tensor, "B g"], C: Float[Tensor, "B g g"]) -> Float[Tensor, "B K 4 4"]:
    """Covariance of [F_x, F_y, location, width] per load, carried over from that of gamma by the derivative of `describe`."""
    if isinstance(c, GaussianCoordinates) and c.size:  # a fifth of the time of a single frame
        slope = c.report_slope(gamma)
        own = C.unflatten(2, (c.count, -1)).unflatten(1, (c.count, -1)).diagonal(dim1=1, dim2=3).movedim(-1, 1)
        if c.per_load != 4 or c.locations is not None:  # any entry in a known location's place; xi is the last
            kept = [0, 1, 2, 2 if c.locations is not None else 3]
            own = own[..., kept, :][..., kept]
        return own * (slope.unsqueeze(-1) * slope.unsqueeze(-2))

    def described(gamma: Float[Tensor, "... g"]) -> Float[Tensor, "... k4"]:
        report = c.describe(gamma)
        return torch.cat([report.force, report.location.unsqueeze(-1), report.width.unsqueeze(-1)], -1).flatten(-2)

    _, J = pointwise_jacobian(described, gamma)
    J = J.unflatten(1, (-1, 4))
    return J @ C.unsqueeze(1) @ J.transpose(-1, -2)


def axial_std(c: LoadFamily, gamma: Float[Tensor, "B g"], C: Float[Tensor, "B g g"]) -> Float[Tensor, "B K"] | None:
    """Standard deviation (N) of each force along the rod, carried over likewise; None where there is none."""
    if c.describe(gamma).axial is None:
        return None

    def axial(gamma: Float[Tensor, "... g"]) -> Float[Tensor, "... K"]:
        found = c.describe(gamma).axial
        assert found is not None
        return found

    _, J = pointwise_jacobian(axial, gamma)
    return (J @ C @ J.mT).diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()


def _only(mask: Bool[Tensor, "..."]) -> Callable[[Tensor], Tensor]:
    """What leaves the samples (or markers) of a mask as they are and fills the others with NaN."""
    if bool(mask.all()):  # as a rule
        return Tensor.contiguous
    return lambda value: torch.where(mask.reshape(*mask.shape, *[1] * (value.ndim - mask.ndim)), value, torch.nan)


def _read_only(problem: Problem) -> Callable[[Tensor], Tensor]:
    """What leaves those of the rows that are positions and were read as they are and fills the others with NaN."""
    if int(problem.seen.min()) == len(problem.groups):  # as a rule
        return Tensor.contiguous
    return _only(problem.distances((problem.weights > 0).to(DTYPE)).abs().amax(-1) > 0)


def _spreads(
    problem: Problem, x: Float[Tensor, "B n"], covariance: Float[Tensor, "B n n"]
) -> dict[str, Float[Tensor, "B ..."] | None]:
    """The covariance, and every field of Estimate that is a spread made of it."""
    state, family, gamma = problem.state, problem.unknowns.loads, x[:, problem.state.loads.at]
    tip, of_loads = state.tip.size, covariance[:, state.loads.at, state.loads.at]
    of_tensions, of_parameters = (b.covariance(covariance).diagonal(dim1=-2, dim2=-1) for b in (state.tension, state.parameters))
    pad = torch.nn.functional.pad
    return {
        "covariance": covariance,
        "load_covariance": load_covariance(family, gamma, of_loads),
        "axial_std": axial_std(family, gamma, of_loads),
        "tip_covariance": pad(state.tip.covariance(covariance), (0, 6 - tip, 0, 6 - tip)) if tip else None,
        "tension_std": of_tensions.clamp(min=0).sqrt() if state.tension.size else None,
        "parameters_std": of_parameters.clamp(min=0).sqrt() if state.parameters.size else None,
    }


def with_covariance(problem: Problem, fit: Estimate, covariance: Float[Tensor, "B n n"]) -> Estimate:
    """The fit with another covariance of x, and all spreads that it makes."""
    return replace(fit, **_spreads(problem, fit.x, covariance))  # pyright: ignore[reportArgumentType]


def make_estimate(
    evaluate: Evaluator,
    x: Float[Tensor, "B n"],
    evaluated: Float[Tensor, "B n"],
    sums: Sums,
    status: Int[Tensor, " B"],
    iterations: Int[Tensor, " B"],
    origin: Int[Tensor, " B"],
) -> Estimate:
    """Assemble the result from x and the sums where the model was last evaluated; an invalid sample holds NaN throughout."""
    problem = evaluate.problem
    state, family = problem.state, problem.unknowns.loads
    covariance, cost = evaluate.posterior(sums, evaluated)
    valid = (status != int(Status.INVALID)) & torch.isfinite(cost)
    status = torch.where(valid, status, int(Status.INVALID))

    converged = status == int(Status.CONVERGED)
    kept, settled = _only(valid), _only(converged)  # elsewhere a spread would look like knowledge
    gamma = x[:, state.loads.at]
    report = family.describe(gamma)
    outlier, chi2, dof, explained = verdict(evaluate, sums, cost)
    rows = sums.r[:, :-TIP_ROWS]
    spreads = {name: None if value is None else settled(value) for name, value in _spreads(problem, x, covariance).items()}
    return Estimate(
        x=kept(x),
        **spreads,  # pyright: ignore[reportArgumentType]
        force=kept(report.force),
        location=kept(report.location),
        width=kept(report.width),
        net_force=kept(report.net_force),
        axial=None if report.axial is None else kept(report.axial),
        tip=kept(state.tip_wrench(x)) if state.tip.size else None,
        base_wrench=kept(state.base.of(x)),
        registration=kept(state.registration.of(x)) if state.registration.size else None,
        centre_line=kept(sums.line),
        residual=_read_only(problem)(kept(problem.distances(rows))),
        row_residual=kept(rows),
        tension=kept(pulling) if state.tension.size and (pulling := problem.tensions(x)) is not None else None,
        parameters=kept(state.parameters.of(x)) if state.parameters.size else None,
        outlier=outlier,
        cost=kept(cost),
        chi2=kept(chi2),
        dof=dof,
        accepted=explained & converged,
        iterations=iterations,
        restarts=torch.zeros_like(iterations),
        status=status,
        origin=origin.clone(),
        guess=origin.clone(),
        fate=torch.zeros_like(origin),
        coarse=torch.zeros_like(status, dtype=torch.bool),
        unstable=torch.zeros_like(status, dtype=torch.bool),
        rod_length=x.new_full((len(x),), problem.robot.rod.length),
    )
