"""Calibration: what a robot's file does not say well enough, from shapes of it under known loads, by the estimator's filter.

The parameters are those of model.uncertainty and the base frame's error, shared by all samples; what is each sample's own (errors
from trial to trial, and loads, where they are not known) is eliminated (estimation.joint). The paper (section III.C) weighs its
robot this way. What is a positive number is sought by its logarithm:

    (1)  rho = rho_0 exp(z),   k = exp(z) of K_se and K_bt alike,   and others  value = value_0 + z

Without tension and without a known load only rho / k shows.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from scipy.special import chdtri
from torch import Tensor

from ..estimation.joint import Joint, Shared, fit_jointly
from ..estimation.result import ACCEPT, Z95
from ..estimation.shared import BaseFrame, shared_frame
from ..estimation.solve import Settings
from ..mechanics.robot import Robot
from ..mechanics.statics import steps_of_rod
from ..model.load_families import GaussianCoordinates, LoadFamily
from ..model.problem import Problem
from ..model.sensors import Markers, Sensor
from ..model.uncertainty import KINDS, OF_TENDONS, Change, Found, Parameter, Uncertainty
from ..model.unknowns import Registration, Unknowns
from ..util.precision import DTYPE
from ..util.status import Status

INNER = 100  # iterations of each fit; the settings' own count is of the steps of the parameters
OTHER_MASSES = (0.25, 4.0, 0.06, 16.0)  # of the first, to start from
WRONG = 10.0  # of the readings: a cost that no noise makes
FREE = 10.0  # standard deviation of what is free, in sizes: it only keeps what does not show finite
SOUGHT = tuple(kind for kind in KINDS if kind not in ("curvature", "curvature_length", "metric"))  # the same in all samples
FIRST_SAG = 0.05  # where the file has no mass: the tip of the straight rod, held across gravity, sags by this part of its length
HARDLY = 0.5  # a standard deviation above this part of a parameter's size determines nothing
ALIKE = 0.95  # parameters so correlated cannot be told apart
MASS, STIFFNESS, OFFSET, FRAME = "mass_per_length", "stiffness_factor", "tension_offset_", "frame_"
PUBLIC = {"mass": MASS, "stiffness": STIFFNESS}  # names of a calibration for those of model.uncertainty
FRAME_AXES = ("x", "y", "z", "turn_x", "turn_y", "turn_z")


@dataclass(frozen=True)
class Unknown:
    """What is sought: a parameter of the robot, or (None) an entry of the base frame's error; and how it is written down.

    name, unit: of the value. before: its value so far. size, std: see SharedParameter. logarithmic: (1).
    """

    name: str
    unit: str
    before: float
    size: float
    std: float
    logarithmic: bool = False
    parameter: Parameter | None = None

    @property
    def change(self) -> Change | None:
        """What an error does to the robot."""
        return None if self.parameter is None else self.parameter.change

    @property
    def free(self) -> bool:
        """Whether nothing is known of it."""
        return self.std >= FREE * self.size

    def error(self, z: float) -> float:
        """Of the robot's parameter, in its unit."""
        return math.expm1(z) if self.logarithmic else z

    def value(self, z: Tensor) -> Tensor:
        """In its unit."""
        return self.before * z.exp() if self.logarithmic else self.before + z


@dataclass(frozen=True)
class Calibration:
    """What was calibrated. One entry per unknown: names, units, values before and after, standard deviations.

    names: mass_per_length (kg/m), stiffness_factor (of K_se and K_bt alike, hence of E and G), tension_offset_1.. (N),
    friction_1.., tendon_x_1.. (m), and so on as model.uncertainty has them, frame_x .. frame_turn_z (m, rad). std_noise: with the
    stated noise; std: the same with the noise the residuals show, where chi2 / dof says that it is larger (`rescaled`); std is what
    is reported, and interval_95 (n, 2), multiplicative for mass and stiffness, follows it. NaN where the fit has not converged.
    covariance (n, n): of std, of log mass and log stiffness where those are sought. used (B,): samples with a marker and an
    equilibrium. residual (B, P, 3) m: measured minus fitted, NaN where there is neither. chi2, dof, accepted: chi2 below its 99.9 %
    point. undetermined: names of free unknowns whose standard deviation is half their size or more. alike: pairs of names that
    these shapes cannot tell apart.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    before: Float[Tensor, " n"]
    values: Float[Tensor, " n"]
    std: Float[Tensor, " n"]
    std_noise: Float[Tensor, " n"]
    interval_95: Float[Tensor, "n 2"]
    covariance: Float[Tensor, "n n"]
    undetermined: tuple[str, ...]
    alike: tuple[tuple[str, str], ...]
    used: Bool[Tensor, " B"]
    residual: Float[Tensor, "B P 3"]
    chi2: float
    dof: int
    iterations: int
    status: Status
    unknowns: tuple[Unknown, ...]
    z: Float[Tensor, " n"]

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
        """What came of it, with the remedy where there is something to do."""
        if self.status is not Status.CONVERGED:
            return (
                f"Did not converge in {self.iterations} iterations: check units, gravity, tensions and marker order; then start "
                "from a mass_per_length nearer the truth, or allow more iterations."
            )
        if self.undetermined:
            held = " (--hold-mass keeps the file's mass)" if MASS in self.undetermined else ""
            return (
                f"Converged, but these shapes hardly determine {', '.join(self.undetermined)}: add shapes at other tensions "
                f"or with gravity across the rod, or ask for fewer parameters{held}."
            )
        twins = "".join(f" These shapes do not tell {a} from {b}; only their common effect is known." for a, b in self.alike)
        if not self.accepted:
            return (
                "Converged, but the calibrated robot does not explain the markers: state more noise, or check gravity's direction, "
                f"tensions, the base frame and that nothing touched the robot.{twins}"
            )
        return f"Converged.{twins}"

    def value(self, name: str, default: float) -> float:
        """The calibrated value of one unknown; the default where it was not asked for."""
        return float(self.values[self.names.index(name)]) if name in self.names else default

    def applied(self, robot: Robot) -> Robot:
        """The robot with the calibrated values, but for the base frame (`frame`)."""
        for unknown, z in zip(self.unknowns, self.z.tolist(), strict=True):
            if unknown.name == MASS and not float(robot.rod.mass_per_length):  # which the search has started from
                robot = replace(robot, rod=replace(robot.rod, mass_per_length=torch.tensor(unknown.before, dtype=DTYPE)))
            if unknown.change is not None:
                robot = unknown.change(robot, unknown.error(z))
        return robot

    @property
    def frame(self) -> BaseFrame | None:
        """The error of the base frame, where it was sought."""
        at = [i for i, unknown in enumerate(self.unknowns) if unknown.parameter is None]
        return BaseFrame(self.z[at], self.covariance[at][:, at]) if at else None

    @property
    def found(self) -> Found:
        """What is left unknown of it."""
        return Found(tuple(u.name if u.parameter is None else u.parameter.name for u in self.unknowns), self.covariance)

    @property
    def correlation(self) -> Float[Tensor, "n n"]:
        """Of the unknowns."""
        d = self.covariance.diagonal().sqrt()
        return self.covariance / d / d.unsqueeze(-1)

    def marker_offsets(self, s: Float[Tensor, " P"]) -> Float[Tensor, "n 5"]:
        """By how much markers at s (m) are measured off: rows [s, x, y, z, std] (m) of the mean residual, and of how sure it is."""
        count = torch.isfinite(self.residual).all(-1).sum(0)
        mean = self.residual.nanmean(0)
        free = (count - 1).clamp(min=0).sum().clamp(min=1)
        spread = ((self.residual - mean).square().nansum() / (3 * free)).sqrt()  # of all markers alike
        rows = torch.cat([s.unsqueeze(-1), mean, (spread / count.clamp(min=1).sqrt()).unsqueeze(-1)], -1)
        return rows[count > 0]


def calibrate(
    robot: Robot,
    markers: Markers | Sequence[Sensor],
    tension: Float[Tensor, "B T"] | None = None,
    youngs_modulus: bool = False,
    tension_offset: bool = False,
    settings: Settings | None = None,
    steps: int | None = None,
    mass: bool = True,
    free: Sequence[str] = (),
    shared: Uncertainty | None = None,
    frame: Registration | None = None,
    own: Uncertainty | None = None,
    hung: Float[Tensor, "B 2"] | None = None,
    loads: LoadFamily | None = None,
) -> Calibration:
    """Parameters of a robot from shapes of it under loads that are known: none but gravity and tendons, or a weight that was hung.

    markers: what was read of all samples, of one robot; gravity (3,) or (B, 3), base frame. tension: (B, T) N, readings. mass,
    youngs_modulus, tension_offset, free (kinds of `Uncertainty`, such as "friction"): what is sought of which nothing is known.
    shared: what is sought of which this much is known, by standard deviations about the file's values. frame: the base frame's
    error is sought, too, with such a prior. own: errors that are another in every sample, such as tensions from trial to trial.
    hung: [s (m), mass (kg)] of a weight on each sample, 0 kg for none. loads: a family of loads that are not known either, of
    every sample. Missing readings weigh nothing; a sample without a marker or an equilibrium is left out (`used`). Non-convergence
    is a status. Errors: ValueError, one sentence with the remedy, where the data cannot determine what is asked.
    Source: the paper, section III.C and (3), (4); docs/model.md.
    """
    settings = settings or Settings()
    sensors = [markers] if isinstance(markers, Markers) else list(markers)
    none = loads or GaussianCoordinates(0, robot.rod.length, robot.rod.force_scale)
    whole = Problem(robot, Unknowns(none, uncertainty=own), sensors, tension, steps or 0)
    whole.check()
    kinds = [*free, *(["mass"] if mass else []), *(["stiffness"] if youngs_modulus else [])]
    kinds += ["tension_offset"] if tension_offset else []
    start = _with_mass(robot) if mass else robot
    _refuse_kinds(robot, kinds)
    sought = _unknowns(start, tension, kinds, shared or Uncertainty(), frame)
    _refuse(whole, sought, hung)
    groups = _groups(whole, start, hung)
    parts = [
        replace(whole.take(index), robot=own_robot, steps=steps or steps_of_rod(robot, whole.s)) for own_robot, index in groups
    ]
    terms = [Shared((u.size,), (u.std,), _change(u, change)) for u in sought if (change := u.change) is not None]
    terms += [] if frame is None else [shared_frame(whole, frame)]
    try:
        found = fit_jointly(parts, terms, replace(settings, max_iterations=INNER), settings.max_iterations)
    except ValueError as error:
        raise ValueError(
            f"{error} at {float(start.rod.mass_per_length):.3g} kg/m; check the units of tensions and stiffness, or start from "
            "another mass_per_length"
        ) from None
    found = _from_other_masses(found, parts, terms, settings, names=[u.name for u in sought])
    return _result(whole, sought, found, [index for _, index in groups], robot)


def _from_other_masses(found: Joint, parts: list[Problem], terms: list[Shared], settings: Settings, names: list[str]) -> Joint:
    """The fit of least cost of those from other masses, where the first is plainly wrong: a rod that has fallen over under too much
    weight, or stands under too little, is no way from one shape to the other.
    """
    seen = sum(int(part.seen.sum()) for part in parts)
    for factor in OTHER_MASSES if MASS in names else ():
        if found.cost < WRONG * seen:
            break
        start = torch.zeros_like(found.z)
        start[names.index(MASS)] = math.log(factor)
        try:
            other = fit_jointly(parts, terms, replace(settings, max_iterations=INNER), settings.max_iterations, start)
        except ValueError:  # no equilibrium at all under it
            continue
        if other.count >= found.count and other.cost < found.cost:
            found = other
    return found


def _with_mass(robot: Robot) -> Robot:
    """The robot; without a mass in the file, with one that lets the tip sag: rho g L^4 / (8 EI) = FIRST_SAG L."""
    rod = robot.rod
    if float(rod.mass_per_length) or not bool(robot.gravity.any()):
        return robot
    sagging = 8 * FIRST_SAG * rod.bending_stiffness / (rod.length**3 * float(robot.gravity.norm(dim=-1).max()))
    return replace(robot, rod=replace(rod, mass_per_length=torch.tensor(sagging, dtype=DTYPE)))


def _unknowns(
    robot: Robot, tension: Float[Tensor, "B T"] | None, free: Sequence[str], shared: Uncertainty, frame: Registration | None
) -> tuple[Unknown, ...]:
    """What is sought, in its order."""
    known = {p.name: p for p in shared.parameters(robot)}
    every = replace(shared, found=None, **dict.fromkeys(free, 0.5)).parameters(robot)
    found = []
    for parameter in every:
        std = known[parameter.name].std if parameter.name in known else None
        size, before, unit = _measure(robot, tension, parameter)
        kind = parameter.name
        found.append(
            Unknown(
                PUBLIC.get(kind, kind),
                unit,
                before,
                size,
                FREE * size if std is None else std,
                parameter.relative,
                parameter,
            )
        )
    if frame is not None:
        block = shared_frame(Problem(robot, Unknowns(GaussianCoordinates(0, robot.rod.length, 1.0)), [], tension), frame)
        for axis, size, std in zip(FRAME_AXES, block.size, block.std, strict=True):
            found.append(Unknown(FRAME + axis, "rad" if axis.startswith("turn") else "m", 0.0, size, std))
    return tuple(found)


def _measure(robot: Robot, tension: Float[Tensor, "B T"] | None, parameter: Parameter) -> tuple[float, float, str]:
    """Size, value so far and unit of a parameter."""
    kind, _, which = parameter.name.rpartition("_")
    rod, tendons = robot.rod, robot.tendons.tendons
    if parameter.name == "mass":
        return 1.0, float(rod.mass_per_length), "kg/m"
    if parameter.relative:
        return 1.0, 1.0 if not which.isdigit() else tendons[int(which) - 1].tension_gain, "1"
    if kind == "tension_offset":
        largest = 0.0 if tension is None else float(tension.nan_to_num(0.0)[:, int(which) - 1].max())
        return largest or rod.force_scale, tendons[int(which) - 1].tension_offset, "N"
    if kind == "friction":
        own = tendons[int(which) - 1]
        return 1.0, own.friction * own.motion, "1"
    if kind in ("tendon_x", "tendon_y"):
        own = tendons[int(which) - 1].routing[0]
        return math.hypot(*own[1:]) or 0.01 * rod.length, own[1 if kind.endswith("x") else 2], "m"
    if kind == "gravity":
        return 0.3, 0.0, "rad"
    return 1 / rod.length, 0.0, "1/m"  # set_x, curvature_y_3, ..


def _change(unknown: Unknown, change: Change) -> Callable[[Problem, Tensor], Problem]:
    """What a value of z does to a problem."""
    return lambda problem, z: replace(problem, robot=change(problem.robot, unknown.error(float(z))))


def _refuse_kinds(robot: Robot, kinds: Sequence[str]) -> None:
    """Raise ValueError for what the robot has not."""
    if "mass" in kinds and not bool(robot.gravity.any()):
        raise ValueError("the robot has no gravity, so its weight does not show; add gravity = [x, y, z] (m/s^2) to [rod]")
    if unknown := [kind for kind in kinds if kind not in SOUGHT]:
        raise ValueError(f"{unknown[0]} is nothing that is calibrated; it must be one of {', '.join((*SOUGHT, 'frame'))}")
    if not len(robot.tendons):
        for kind in kinds:
            if kind in OF_TENDONS:
                option = "--tension-offset" if kind == "tension_offset" else kind
                raise ValueError(f"the robot has no tendons, so there is no {kind.replace('_', ' ')} of them; drop {option}")


def _refuse(problem: Problem, sought: tuple[Unknown, ...], hung: Float[Tensor, "B 2"] | None) -> None:
    """Raise ValueError for what no data of this kind can determine."""
    names = [u.name for u in sought]
    free = [u.name for u in sought if u.free]
    if not sought:
        raise ValueError("nothing is sought; ask for a parameter, or state how well some are known")
    pulled = problem.tension is not None and bool((problem.tension > 0).any())
    loaded = hung is not None and bool((hung[:, 1] > 0).any())
    if STIFFNESS in free and MASS in names and not pulled and not loaded:
        raise ValueError(
            "without tension only the ratio of weight to stiffness shows; add shapes with tension or a known weight, or drop "
            "--youngs-modulus"
        )
    seen = int(problem.seen.sum())
    if seen <= len(free):
        raise ValueError(f"{seen} marker coordinates cannot determine {len(free)} parameters; add markers or shapes")


def _groups(problem: Problem, robot: Robot, hung: Float[Tensor, "B 2"] | None) -> list[tuple[Robot, Int[Tensor, " b"]]]:
    """Samples with the same gravity and the same weight hung on them, and the robot that they are of."""
    B = problem.batch
    rows = robot.gravity.expand(B, 3)
    rows = torch.cat([rows, rows.new_zeros(B, 2) if hung is None else hung * (hung[:, 1:] > 0)], -1)
    kinds, which = torch.unique(rows, dim=0, return_inverse=True)
    found = []
    for k, (*g, s, kg) in enumerate(kinds.tolist()):
        weight = torch.tensor([[s, kg]], dtype=DTYPE)[: int(kg > 0)]
        rod = replace(robot.rod, masses=torch.cat([robot.rod.masses, weight]))
        found.append((replace(robot, rod=rod, gravity=torch.tensor(g, dtype=DTYPE)), (which == k).nonzero().squeeze(-1)))
    return found


def _result(
    problem: Problem, sought: tuple[Unknown, ...], found: Joint, groups: list[Int[Tensor, " b"]], robot: Robot
) -> Calibration:
    """Values and standard deviations in SI units, residuals and chi2."""
    B, z = problem.batch, found.z
    used = torch.zeros(B, dtype=torch.bool)
    residual = problem.reading.new_full((B, problem.distances(problem.weights).shape[1], 3), torch.nan)
    chi2, dof = 0.0, -len(sought) + sum(not u.free for u in sought)
    for index, fit, some in zip(groups, found.fits, found.used, strict=True):
        used[index], residual[index[some]] = some, fit.residual[some]
        chi2, dof = chi2 + float(fit.chi2[some].sum()), dof + int(fit.dof[some].sum())
    chi2 += float((found.prior.diagonal() * z**2).sum())
    excess = max(1.0, chi2 / max(dof, 1))
    known = torch.nan if found.status is not Status.CONVERGED else 1.0
    stated, covariance = (known * found.covariance(factor) for factor in (1.0, excess))
    std_z = covariance.diagonal().sqrt()
    log = torch.tensor([u.logarithmic for u in sought])
    values = torch.stack([u.value(v) for u, v in zip(sought, z, strict=True)])
    unit = torch.where(log, values, 1.0)
    reach, around = Z95 * torch.stack([-std_z, std_z], -1), values.unsqueeze(-1)
    interval = torch.where(log.unsqueeze(-1), around * reach.exp(), around + reach)
    hardly = [u.name for u, s in zip(sought, std_z.tolist(), strict=True) if u.free and s > HARDLY * u.size]
    together = (covariance / std_z / std_z.unsqueeze(-1)).abs() > ALIKE
    pairs = [(i, j) for i in range(len(sought)) for j in range(i) if bool(together[i, j])]
    before = torch.tensor([u.before for u in sought], dtype=DTYPE)
    if MASS in (u.name for u in sought) and not float(robot.rod.mass_per_length):
        before = before.index_fill(0, torch.tensor([[u.name for u in sought].index(MASS)]), 0.0)
    return Calibration(
        tuple(u.name for u in sought),
        tuple(u.unit for u in sought),
        before,
        values,
        std_z * unit,
        stated.diagonal().sqrt() * unit,
        interval,
        covariance,
        tuple(hardly),
        tuple((sought[j].name, sought[i].name) for i, j in pairs),
        used,
        residual,
        chi2,
        dof,
        found.iterations,
        found.status,
        sought,
        z,
    )
