"""Calibration: mass per length, stiffness and load-cell offsets from unloaded shapes, by the estimator's own filter.

The paper (section III.C) weighs its robot this way. The state is theta of analysis.unloaded_shapes, shared by all samples, with the
markers of all of them stacked into one measurement; the recursion is estimation.filter's `advance`, with the estimator's step
limit, adaptive noise and test of convergence.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from scipy.special import chdtri
from torch import Tensor

from ..estimation import filter as ekf
from ..estimation.result import ACCEPT, Z95
from ..estimation.solve import Settings
from ..mechanics.robot import Robot
from ..mechanics.statics import steps_of_rod
from ..mechanics.tendons import Tendons
from ..model.load_families import GaussianCoordinates
from ..model.problem import Problem
from ..model.sensors import Markers
from ..model.unknowns import Unknowns
from ..util.precision import DTYPE
from ..util.status import Status
from .unloaded_shapes import MASS, OFFSET, PRIOR, STIFFNESS, Trial, UnloadedShapes

RETREATS = 5  # halvings of a step that loses samples, before they are given up
HARDLY = 0.5  # a standard deviation of theta above this determines nothing


@dataclass(frozen=True)
class Calibration:
    """What was calibrated. One entry per unknown: names, values before and after, standard deviations.

    names: mass_per_length (kg/m), stiffness_factor (of K_se and K_bt alike, hence of E and G), tension_offset_1.. (N).
    std_noise: from (H^T W H + P)^-1 with the stated noise; std: the same with the noise the residuals show, where chi2 / dof says
    that it is larger (`rescaled`); std is what is reported, and interval_95 (n, 2), multiplicative for mass and stiffness, follows
    it. NaN where the fit has not converged. used (B,): samples with a marker and an equilibrium. residual (B, P, 3) m: measured
    minus fitted, NaN where there is neither. chi2, dof, accepted: chi2 below its 99.9 % point. undetermined: names whose standard
    deviation is half their size or more.
    """

    names: tuple[str, ...]
    before: Float[Tensor, " n"]
    values: Float[Tensor, " n"]
    std: Float[Tensor, " n"]
    std_noise: Float[Tensor, " n"]
    interval_95: Float[Tensor, "n 2"]
    undetermined: tuple[str, ...]
    used: Bool[Tensor, " B"]
    residual: Float[Tensor, "B P 3"]
    chi2: float
    dof: int
    iterations: int
    status: Status

    @property
    def accepted(self) -> bool:
        """Whether the calibrated robot explains the markers: converged, and chi2 below its 99.9 % point."""
        return self.status is Status.CONVERGED and self.chi2 <= float(chdtri(self.dof, 1 - ACCEPT))

    @property
    def rescaled(self) -> bool:
        """Whether the reported standard deviations come from the residuals, because they are larger than the stated noise."""
        return self.chi2 > self.dof

    @property
    def rms_residual(self) -> float:
        """Root mean square of the distances between measured and fitted markers (m)."""
        return float(self.residual.square().sum(-1).nanmean().sqrt())

    @property
    def message(self) -> str:
        """One sentence, with the remedy where there is something to do."""
        if self.status is not Status.CONVERGED:
            return (
                f"Did not converge in {self.iterations} iterations: check units, gravity, tensions and marker order; then start "
                "from a mass_per_length nearer the truth, or allow more iterations."
            )
        if self.undetermined:
            return (
                f"Converged, but these shapes hardly determine {', '.join(self.undetermined)}: add shapes at other tensions "
                "or with gravity across the rod, or ask for fewer parameters."
            )
        if not self.accepted:
            return (
                "Converged, but the calibrated robot does not explain the markers: state more noise, or check gravity's direction, "
                "tensions, the base frame and that nothing touched the robot."
            )
        return "Converged."

    def value(self, name: str, default: float) -> float:
        """The calibrated value of one unknown; the default where it was not asked for."""
        return float(self.values[self.names.index(name)]) if name in self.names else default

    def applied(self, robot: Robot) -> Robot:
        """The robot with the calibrated values."""
        k = self.value(STIFFNESS, 1.0)
        mass = torch.tensor(self.value(MASS, float(robot.rod.mass_per_length)), dtype=DTYPE)
        rod = replace(robot.rod, K_se=k * robot.rod.K_se, K_bt=k * robot.rod.K_bt, mass_per_length=mass)
        tendons = tuple(
            replace(t, tension_offset=self.value(f"{OFFSET}{j + 1}", t.tension_offset)) for j, t in enumerate(robot.tendons.tendons)
        )
        return replace(robot, rod=rod, tendons=Tendons(tendons))


def calibrate(
    robot: Robot,
    markers: Markers,
    tension: Float[Tensor, "B T"] | None = None,
    youngs_modulus: bool = False,
    tension_offset: bool = False,
    settings: Settings | None = None,
    steps: int | None = None,
) -> Calibration:
    """Mass per length, and where asked stiffness and tension offsets, from the shapes of a robot that nothing touches but gravity.

    markers: all samples are of one robot, with one noise for all; gravity (3,) or (B, 3), base frame. tension: (B, T) N, readings.
    Missing markers weigh nothing; a sample without a marker or an equilibrium is left out (`used`). Non-convergence is a status.
    Errors: ValueError, one sentence with the remedy, where the data cannot determine what is asked.
    Source: the paper, section III.C and (3), (4); docs/model.md.
    """
    none = Unknowns(GaussianCoordinates(0, robot.rod.length, robot.rod.force_scale))
    Problem(robot, none, [markers], tension).check()
    steps = steps or steps_of_rod(robot, markers.s)  # the same for every trial, or their differences would jump
    shapes = UnloadedShapes(robot, markers, tension, markers.weights[:, ::3], youngs_modulus, tension_offset, steps)
    _refuse(shapes)
    return _result(shapes, *_iterate(shapes, settings or Settings()))


def _refuse(shapes: UnloadedShapes) -> None:
    """Raise ValueError for what no data of this kind can determine."""
    robot, markers = shapes.robot, shapes.markers
    if not markers.isotropic:
        raise ValueError("calibrate takes markers with one noise in all directions; give neither covariances nor s_std")
    if not bool(robot.gravity.any()):
        raise ValueError("the robot has no gravity, so its weight does not show; add gravity = [x, y, z] (m/s^2) to [rod]")
    if shapes.offsets and not len(robot.tendons):
        raise ValueError("the robot has no tendons, so there are no tension offsets; drop --tension-offset")
    pulled = shapes.tension is not None and bool((shapes.tension > 0).any())
    if shapes.stiffness and not pulled:
        raise ValueError(
            "without tension only the ratio of weight to stiffness shows; add shapes with tension or drop --youngs-modulus"
        )
    seen, unknowns = 3 * int(markers.present.sum()), len(shapes.names)
    if seen <= unknowns:
        raise ValueError(f"{seen} marker coordinates cannot determine {unknowns} parameters; add markers or shapes")


def _iterate(shapes: UnloadedShapes, settings: Settings) -> tuple[Float[Tensor, " n"], Trial, int, Status]:
    """The filter on theta: estimation.filter's `advance` on a batch of one."""
    mean, limits = shapes.start(), ekf.Limits(step=settings.step_limit)
    prior, Q = (mean, torch.full_like(mean, PRIOR)), settings.Q * torch.ones_like(mean)
    Sigma0 = settings.initial_covariance(mean)[None]
    at = ekf.Iterate.start(mean[None], Sigma0, torch.inf if settings.adaptive else 0.0)
    kept, retreats = torch.zeros(len(shapes.weights), dtype=torch.bool), 0
    for iteration in range(1, settings.max_iterations + 1):
        trial = shapes.linearize(at.x[0], mean)
        if bool((kept & ~trial.solved).any()) and retreats < RETREATS:
            # A step too far: half way back to the last place where these samples had an equilibrium.
            at, retreats = replace(at, x=0.5 * (at.x + at.before)), retreats + 1
            continue
        if not bool((trial.w > 0).any()):
            if iteration > 1:
                return at.x[0], trial, iteration, Status.NOT_CONVERGED
            raise ValueError(
                f"no sample has markers, finite tensions and an equilibrium at {float(mean[0].exp()):.3g} kg/m; check the units "
                "of tensions and stiffness, or start from another mass_per_length"
            )
        onward = ekf.advance(at, trial.normal, Sigma0, prior, Q, limits)
        if bool(onward.done):
            return at.x[0], trial, iteration, Status.CONVERGED
        kept, retreats = trial.solved, 0
        at = replace(onward, x=shapes.stopped_at_kinks(at.x[0], (onward.x - at.x)[0])[None])
    return at.x[0], shapes.linearize(at.x[0], mean), settings.max_iterations, Status.NOT_CONVERGED


def _result(shapes: UnloadedShapes, theta: Float[Tensor, " n"], trial: Trial, iterations: int, status: Status) -> Calibration:
    """Values and standard deviations in SI units, residuals and chi2 at theta."""
    r, w = trial.r, trial.w
    chi2, dof = float((w * r * r).sum()), int((w > 0).sum()) - len(theta)
    excess = max(1.0, chi2 / max(dof, 1))
    prior = torch.diag(torch.full_like(theta, PRIOR))
    values, log, names = shapes.physical(theta), shapes.logarithmic, shapes.names
    unknown = math.nan if status is not Status.CONVERGED else 1.0
    stated, std = (unknown * ekf.inverse(trial.A_mean / factor + prior)[0].diagonal().sqrt() for factor in (1.0, excess))
    size = torch.where(log, values, shapes.unit)
    reach = Z95 * torch.stack([-std, std], -1)
    around = values.unsqueeze(-1)
    interval = torch.where(log.unsqueeze(-1), around * reach.exp(), around + reach * size.unsqueeze(-1))
    residual = torch.where(w > 0, r, torch.nan).reshape(shapes.markers.positions.shape)
    return Calibration(
        names,
        shapes.before(),
        values,
        std * size,
        stated * size,
        interval,
        tuple(name for name, s in zip(names, std.tolist(), strict=True) if s > HARDLY),
        trial.solved & shapes.markers.present.any(-1),
        residual,
        chi2,
        dof,
        iterations,
        status,
    )
