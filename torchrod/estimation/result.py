"""The result of an estimate: loads, how sure, how well they explain the markers, and what became of every sample."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..kernel import Sums
from ..mechanics.jacobian import pointwise_jacobian
from ..model.load_families import GaussianCoordinates
from ..model.measurement import Model
from ..util.status import Learned, Status
from .evaluator import Prepared
from .fit import Fit
from .load_profile import Profile
from .verdict import limit, verdict

Z95 = 1.959964  # of the standard normal distribution


@dataclass(frozen=True)
class Estimate:
    """Everything known of B samples after the fit. Status codes are torchrod.Status; SI units; forces in the section frame.

    x, covariance: the state in the model's coordinates and its posterior (H^T W H + P)^-1 with the true noise; covariances are NaN
    where the fit has not converged. As in any Kalman filter x is one update further than the evaluation of the model that the
    covariance, the residual, the centre line, cost and chi2 are of: by less than what 1e-3 of chi^2 can tell.
    force (B, K, 2) N, location (B, K) m, width (B, K) m, and the covariance (B, K, 4, 4) of [F_x, F_y, location, width].
    net_force (B, K, 2): the paper's (13), which counts the part of a Gaussian beyond the tip; `force` is what the rod feels.
    tip (B, 6) [N, N m] and tip_covariance (B, 6, 6): the unknown dead wrench at the tip, base frame, zero in the entries that are
    not unknown; None without Model.tip. base_wrench (B, 6) [N, N m] and registration (B, 6) [m, rad] or None. centre_line
    (B, P, 3) m: the fitted rod at the markers, in the base frame. residual (B, P, 3) m: measured minus fitted, NaN where missing.
    iterations (B,): evaluations of h and H, of all attempts; restarts (B,): further attempts, cold or from other magnitudes.
    warm_started (B,): whether the fit that is reported started from a guess; learned (B,): util.status.Learned codes.
    tension, tension_std (B, T) N: as found; None where they are taken as exact. outlier (B, P): markers that a robust fit has left
    aside. cost (B,): what was minimized; chi2: the same of the other markers, as the normal distribution has it.
    chi2, dof (B,), accepted: chi2 below its 99.9 % point; a sample may have converged to a fit that does not explain the data.
    """

    x: Float[Tensor, "B n"]
    covariance: Float[Tensor, "B n n"]
    force: Float[Tensor, "B K 2"]
    location: Float[Tensor, "B K"]
    width: Float[Tensor, "B K"]
    load_covariance: Float[Tensor, "B K 4 4"]
    net_force: Float[Tensor, "B K 2"]
    tip: Float[Tensor, "B 6"] | None
    tip_covariance: Float[Tensor, "B 6 6"] | None
    base_wrench: Float[Tensor, "B 6"]
    registration: Float[Tensor, "B 6"] | None
    centre_line: Float[Tensor, "B P 3"]
    residual: Float[Tensor, "B P 3"]
    tension: Float[Tensor, "B T"] | None
    tension_std: Float[Tensor, "B T"] | None
    outlier: Bool[Tensor, "B P"]
    cost: Float[Tensor, " B"]
    chi2: Float[Tensor, " B"]
    dof: Int[Tensor, " B"]
    accepted: Bool[Tensor, " B"]
    iterations: Int[Tensor, " B"]
    restarts: Int[Tensor, " B"]
    status: Int[Tensor, " B"]
    warm_started: Bool[Tensor, " B"]
    learned: Int[Tensor, " B"]

    @property
    def magnitude(self) -> Float[Tensor, "B K"]:
        """|F| (N)."""
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
        """95 % interval of the location (m)."""
        return _interval(self.location, self.location_std)

    @property
    def rms_residual(self) -> Float[Tensor, " B"]:
        """Root of the mean squared distance between measured and fitted markers (m), over those that were seen."""
        return self.residual.square().sum(-1).nanmean(-1).sqrt()

    def message(self, sample: int) -> str:
        """What became of a sample, with the remedy; a second sentence where a learned start did not serve."""
        return f"{self._outcome(sample)} {Learned(int(self.learned[sample])).message}".strip()

    def _outcome(self, sample: int) -> str:
        status = Status(int(self.status[sample]))
        if status is not Status.CONVERGED or self.accepted[sample]:
            return status.message
        chi2, dof = float(self.chi2[sample]), int(self.dof[sample])
        reason = f"chi2 = {chi2:.3g} for {dof} degrees of freedom"
        if chi2 < limit(dof):
            reason = "most markers were left aside, or neighbouring residuals are too much alike for noise"
        remedy = "allow more contacts, state more noise, or check tensions, gravity and registration"
        return f"Converged, but {reason}: the model does not explain the markers; {remedy}."

    def fit(self, sample: int, profile: Profile | None = None) -> Fit:
        """What a figure needs of one sample; profile: of all samples (torchrod.load_profile)."""
        zeta = None if self.registration is None else self.registration[sample]
        there = torch.isfinite(self.location[sample])
        tip = None if self.tip is None or bool(self.tip[sample].isnan().all()) else self.tip[sample, :3]
        loads = (self.force[sample][there], self.location[sample][there], self.width[sample][there])
        interval, along = self.location_interval[sample][there], None if profile is None else profile.of(sample)
        return Fit(*loads, self.base_wrench[sample], zeta, tip, interval, along)

    def improved_by(self, other: "Estimate", index: Int[Tensor, " b"]) -> "Estimate":
        """With the samples of `index` replaced by those of another attempt where that is better; every attempt is counted.

        Better: accepted where this one is not, else of lower cost.
        """
        was, lower = self.accepted[index], other.cost < self.cost[index].nan_to_num(torch.inf)
        better = (other.accepted & ~was) | ((other.accepted == was) & lower)
        changed = {}
        for f in fields(Estimate):
            value = getattr(self, f.name)
            if value is not None:
                changed[f.name] = value.clone()
                changed[f.name][index[better]] = getattr(other, f.name)[better]
        changed["learned"] = self.learned
        changed["iterations"] = self.iterations.index_add(0, index, other.iterations)
        changed["restarts"] = self.restarts.index_add(0, index, 1 + other.restarts)
        return replace(self, **changed)

    @staticmethod
    def cat(parts: list["Estimate"]) -> "Estimate":
        """Join the estimates of several chunks."""
        if len(parts) == 1:
            return parts[0]

        def joined(values: list[Tensor | None]) -> Tensor | None:
            present = [v for v in values if v is not None]
            return torch.cat(present) if present else None

        return Estimate(**{f.name: joined([getattr(p, f.name) for p in parts]) for f in fields(Estimate)})  # pyright: ignore[reportArgumentType]


def _interval(value: Float[Tensor, "B K"], std: Float[Tensor, "B K"]) -> Float[Tensor, "B K 2"]:
    """95 %: symmetric in the logarithm where that is well known (to a factor of about e), else in the value, and not below 0."""
    relative = std / value
    sign = value.new_tensor([-1.0, 1.0]) * Z95
    by_factor = value.unsqueeze(-1) * torch.exp(sign * relative.unsqueeze(-1))
    by_difference = (value.unsqueeze(-1) + sign * std.unsqueeze(-1)).clamp(min=0)
    return torch.where((relative < 0.5).unsqueeze(-1), by_factor, by_difference)


def load_covariance(model: Model, x: Float[Tensor, "B n"], covariance: Float[Tensor, "B n n"]) -> Float[Tensor, "B K 4 4"]:
    """Covariance of [F_x, F_y, location, width] per load, carried over from x by the derivative of `describe`."""
    c, n = model.coordinates, model.coordinates.size
    if isinstance(c, GaussianCoordinates) and n:  # a fifth of the time of a single frame
        slope = c.report_slope(x[:, :n])
        own = covariance[:, :n, :n].unflatten(2, (c.count, -1)).unflatten(1, (c.count, -1)).diagonal(dim1=1, dim2=3).movedim(-1, 1)
        if c.per_load == 3:
            own = own[..., [0, 1, 2, 2], :][..., [0, 1, 2, 2]]  # any entry in the location's place
        return own * (slope.unsqueeze(-1) * slope.unsqueeze(-2))

    def described(gamma: Float[Tensor, "... g"]) -> Float[Tensor, "... k4"]:
        report = c.describe(gamma)
        return torch.cat([report.force, report.location.unsqueeze(-1), report.width.unsqueeze(-1)], -1).flatten(-2)

    _, J = pointwise_jacobian(described, x[:, :n])
    J = J.unflatten(1, (-1, 4))
    return J @ covariance[:, None, :n, :n] @ J.transpose(-1, -2)


def tip_covariance(model: Model, covariance: Float[Tensor, "B n n"]) -> Float[Tensor, "B 6 6"]:
    """Covariance of the unknown wrench at the tip [N, N m]; zero in the entries that are not unknown."""
    first, last = model.coordinates.size, model.load_size
    scale = model.alpha_scale(covariance)
    block = covariance[:, first:last, first:last]
    rest = 6 - (last - first)
    return torch.nn.functional.pad(block, (0, rest, 0, rest)) * scale * scale.unsqueeze(-1)


def _tensions(
    prepared: Prepared, x: Float[Tensor, "B n"], covariance: Float[Tensor, "B n n"]
) -> tuple[Float[Tensor, "B T"], Float[Tensor, "B T"]] | None:
    """The tensions (N) after the fit and their standard deviations, where they are unknown."""
    model = prepared.model
    tension = model.tension(x, prepared.markers.tension)
    if model.tension_std is None or tension is None:
        return None
    variance = covariance.diagonal(dim1=-2, dim2=-1)[:, model.load_size : model.load_size + model.tension_size]
    return tension, model.tension_std * variance.clamp(min=0).sqrt()


def _only(mask: Bool[Tensor, "..."]) -> Callable[[Tensor], Tensor]:
    """What leaves the samples (or markers) of a mask as they are and fills the others with NaN."""
    if bool(mask.all()):  # as a rule
        return Tensor.contiguous
    return lambda value: torch.where(mask.reshape(*mask.shape, *[1] * (value.ndim - mask.ndim)), value, torch.nan)


def make_estimate(
    prepared: Prepared,
    x: Float[Tensor, "B n"],
    evaluated: Float[Tensor, "B n"],
    sums: Sums,
    status: Int[Tensor, " B"],
    iterations: Int[Tensor, " B"],
    warm_started: Bool[Tensor, " B"],
) -> Estimate:
    """Assemble the result from x and the sums where the model was last evaluated; an invalid sample holds NaN throughout."""
    model, markers = prepared.model, prepared.markers
    covariance, cost = prepared.posterior(sums, evaluated)
    valid = (status != int(Status.INVALID)) & torch.isfinite(cost)
    status = torch.where(valid, status, int(Status.INVALID))

    converged = status == int(Status.CONVERGED)
    kept, settled = _only(valid), _only(converged)  # elsewhere a spread would look like knowledge
    gamma, zeta, alpha = model.split(x)
    report = model.coordinates.describe(gamma)
    free = _tensions(prepared, x, covariance)
    outlier, chi2, dof, explained = verdict(prepared, sums, cost)
    return Estimate(
        x=kept(x),
        covariance=settled(covariance),
        force=kept(report.force),
        location=kept(report.location),
        width=kept(report.width),
        load_covariance=settled(load_covariance(model, x, covariance)),
        net_force=kept(report.net_force),
        tip=None if model.tip == "none" else kept(model.tip_wrench(x)),
        tip_covariance=None if model.tip == "none" else settled(tip_covariance(model, covariance)),
        base_wrench=kept(alpha),
        registration=None if zeta is None else kept(zeta),
        centre_line=kept(sums.line),
        residual=_only(markers.present)(kept(sums.r[:, :-6].unflatten(-1, (-1, 3)))),
        tension=None if free is None else kept(free[0]),
        tension_std=None if free is None else settled(free[1]),
        outlier=outlier,
        cost=kept(cost),
        chi2=kept(chi2),
        dof=dof,
        accepted=explained & converged,
        iterations=iterations,
        restarts=torch.zeros_like(iterations),
        status=status,
        warm_started=warm_started,
        learned=torch.full_like(iterations, int(Learned.NONE)),
    )
