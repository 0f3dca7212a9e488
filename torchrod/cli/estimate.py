"""torchrod estimate: arguments to a problem, and an analysis to a table and files."""

import math
import warnings

import torch
from jaxtyping import Bool
from jsonargparse import Namespace
from scipy.special import chdtr
from torch import Tensor

from ..analysis.count import Hypothesis, StartFor
from ..analysis.diagnosis import ROBUST
from ..analysis.pipeline import Analysis, analyze, contact_hypotheses, learned_or_cold
from ..estimation.intervals import interval_of
from ..estimation.load_profile import Profile
from ..estimation.result import FittedRod
from ..estimation.solve import Settings
from ..estimation.starts import cold_start
from ..estimation.walk import kernel_serves, kernel_walks
from ..io import (
    RESULT_SUFFIXES,
    NearlyKnown,
    Noises,
    Result,
    Shapes,
    check_parameters,
    read_base_pose,
    read_robot,
    read_shapes,
    read_uncertainty,
    write_result,
)
from ..learned.features import features
from ..learned.warm_start import WarmStart
from ..mechanics.robot import Robot
from ..model.load_families import GaussianCoordinates, SmoothCoordinates
from ..model.problem import FINEST, Problem
from ..model.sensors import Markers
from ..model.unknowns import Registration, Scope, Unknowns
from ..util.errors import InputError
from ..util.progress import bar
from ..util.status import Status
from .arguments import FIGURE_SUFFIXES, NOISE, as_calibrated, in_metres, noise_or_auto, positive, writable
from .table import table

MOST_PROFILES = 1000  # samples, where nobody says whether profiles are wanted (0.6 ms each), or what nobody told of (0.4 ms)
MOST_DRAWN, MOST_READINGS = 100, 200  # samples, and numbers of each, that are drawn where torch works out what sensors read;
MOST_RUBBING = 10  # where tendons rub as well: a second each
ANGLE_NOISE = 0.01  # rad
ROUGHLY = 0.15  # a share of EI: above it, intervals of a section that may be oval hold less than they say
EXACT = (
    "ROBOT.toml is taken as exact, {parts} included: an error in it shows as a load, or as a wrong force. State what is only "
    "nearly known under [uncertainty], or run torchrod calibrate."
)
NARROW = (
    "Loads are taken to be contacts, about 2.5 % of the length wide; where one may be spread along the rod, try --load-prior auto."
)
LATERAL = "Contacts are taken to push without drag along the rod; where they rub, state --contact-friction."
FAR_TOO_GOOD = 1e-4  # of the probability: readings that agree even better
GENEROUS = (
    "chi2 = {chi2:.3g} for {dof} degrees of freedom in all: the readings are better than their stated noise, and the intervals "
    "wider than need be; try --noise auto."
)
HIDDEN = (
    "Beside a push an unknown wrench at the tip hides much of it: 95 % intervals hold the truth in 75 to 90 %. Where no moment "
    "acts on the tip, --unknown-tip force tells more."
)
NOISE_OF = {"orientations": "orientations qx,qy,qz,qw", "curvature": "curvatures kx,ky", "base_wrench": "base wrenches base_fx, .."}
STATED = 1 / 400  # of the length: what stands for a noise that is to be estimated


def _count(options: Namespace, robot: Robot) -> int | str:
    """How many loads, or auto."""
    L = robot.rod.length
    contacts = options.contacts or "1"
    if options.location:
        if options.contacts not in (None, str(len(options.location))):
            given = f"{len(options.location)} place{'s' * (len(options.location) != 1)}"
            raise InputError(f"--contacts {options.contacts}, but --location names {given}; give one place per load")
        if not all(0 < s <= L for s in options.location):
            raise InputError(f"--location {options.location}: must lie on the rod, above 0 and up to {L} m")
        if len(set(options.location)) < len(options.location):
            raise InputError(f"--location {options.location}: two loads at one place cannot be told apart; give it once")
        return len(options.location)
    if contacts != "auto" and contacts not in [str(k) for k in range(11)]:
        raise InputError(f"--contacts is {contacts!r}; it must be auto or a number from 0 to 10")
    return contacts if contacts == "auto" else int(contacts)


def _friction(options: Namespace) -> float | None:
    """Of the contacts: infinite where their force along the rod is free."""
    if options.contact_friction is not None:
        positive("--contact-friction", options.contact_friction)
        if options.axial:
            raise InputError("--contact-friction limits what --axial leaves free; give one of them")
    return math.inf if options.axial else options.contact_friction


def _registration(options: Namespace) -> Registration | None:
    """What is known of the base frame."""
    if options.one_frame and not options.registration:
        raise InputError("--one-frame says that all samples share what --registration estimates; give --registration as well")
    if options.frame_std is not None:
        shift, turn = options.frame_std
        positive("--frame-std SHIFT", shift)
        positive("--frame-std TURN", turn)
        if not options.registration:
            raise InputError("--frame-std says how well the base frame is known; give --registration as well")
        if turn > 1:
            raise InputError(f"--frame-std TURN is {turn}; it is in radians: 3 degrees are 0.052")
    if not options.registration:
        return None
    shift, turn = options.frame_std or (None, None)
    return Registration(shift, turn, Scope.SHARED if options.one_frame else Scope.SAMPLE)


def _warn_of_idle(options: Namespace, robot: Robot, shapes: Shapes) -> None:
    """Say of every option that has nothing to act on."""
    seen = torch.isfinite(shapes.points).all(-1)
    stated = shapes.readings.get("position_std")
    unstated = seen if stated is None else seen & ~torch.isfinite(stated[..., 0])
    lacks = {name: f"{options.shapes} has no {columns}" for name, columns in NOISE_OF.items() if name not in shapes.readings}
    whole = options.out is not None and not options.out.endswith(".csv")
    idle = {
        "--noise": options.noise is not None and not bool(unstated.any()) and f"{options.shapes} {_own_noise(seen)}",
        "--s-std": options.s_std is not None and _all_places(shapes) and f"{options.shapes} {_all_places(shapes)}",
        "--angle-noise": options.angle_noise is not None and lacks.get("orientations"),
        "--curvature-noise": options.curvature_noise is not None and lacks.get("curvature"),
        "--base-noise": options.base_noise is not None and lacks.get("base_wrench"),
        "--tension-std": options.tension_std is not None and not len(robot.tendons) and f"{options.robot} has no tendons",
        "hung_kg": "hung" in shapes.readings and "known weights are for torchrod calibrate; here they are found like any load",
        "--load-prior": options.load_prior != "contact" and options.contacts == "0" and "--contacts 0 leaves no load",
        "--intervals sampled": options.intervals == "sampled"
        and options.one_frame
        and "draws of one sample cannot have the error of a base frame that all share (--one-frame)",
        "--profile on": options.profile == "on" and not whole and "only RESULT.json and RESULT.npz have profiles (--out)",
    }
    for option, why in idle.items():
        if why:
            warnings.warn(f"{option} has no effect: {why}", stacklevel=2)


def _all_places(shapes: Shapes) -> str:
    """What a file has instead of positions at arc lengths; nothing where it has some."""
    if any(isinstance(sensor, Markers) for sensor in shapes.stated):
        return ""
    return "has no positions x,y,z but those of orientations" if "orientations" in shapes.readings else "has no positions at s"


def _own_noise(seen: Bool[Tensor, "B P"]) -> str:
    return "states the noise of every position, sx" if bool(seen.any()) else "has no positions x,y,z"


def _sampled(options: Namespace, problem: Problem, several: bool) -> bool:
    """Whether there are to be draws: of a large batch only where that is asked for. several: hypotheses compete."""
    if options.intervals == "gaussian":
        return False
    quick = kernel_walks(problem) and not options.one_frame
    if options.intervals == "sampled" or not quick:
        return options.intervals == "sampled"
    plain = kernel_serves(problem) and not (problem.state.tip.size or problem.state.tension.size)
    most = MOST_DRAWN if problem.on_grid.tendons.friction is None else MOST_RUBBING
    few = problem.batch <= MOST_PROFILES if plain else problem.batch <= most and len(problem.groups) <= MOST_READINGS
    if not few:
        warnings.warn(
            f"the intervals of {problem.batch} samples are those of the covariance"
            f"{' and the choice of loads that of the BIC' * several}, because draws would take longer than all else; "
            "--intervals sampled takes draws",
            stacklevel=2,
        )
    return few


def _check_enough(options: Namespace, problem: Problem) -> None:
    """Refuse a single place that is to tell of a contact, with what it can tell of. Errors: InputError."""
    if problem.determined or len(problem.s.unique()) > 1:
        return
    read = "a single marker" if problem.markers is not None else "what was read at a single place"
    raise InputError(
        f"{options.shapes}: {read} cannot tell a contact and its place; add markers or, for a force at the tip, try "
        "--contacts 0 --unknown-tip force"
    )


def _problem(options: Namespace, robot: Robot, nearly: NearlyKnown, shapes: Shapes, noise: float | None) -> Problem:
    """The readings, with one load among the unknowns, whose number and width the hypotheses replace."""
    rod = robot.rod
    std = options.tension_std if len(robot.tendons) else None
    loads = GaussianCoordinates(1, rod.length, rod.force_scale)
    registration = _registration(options) or nearly.frame_of_a_sample
    stated = STATED * rod.length if noise is None else noise
    angle = ANGLE_NOISE if options.angle_noise is None else options.angle_noise
    positive("--angle-noise", angle)
    for value in options.base_noise or ():
        positive("--base-noise", value)
    base = None if options.base_noise is None else (options.base_noise[0], options.base_noise[1])
    if options.curvature_noise is not None:
        positive("--curvature-noise", options.curvature_noise)
    if stated < FINEST * rod.length:
        warnings.warn(
            f"--noise {stated:g} m counts as {FINEST * rod.length:.2g} m for markers: steps along the rod leave as much",
            stacklevel=2,
        )
    own = nearly.of_a_sample
    check_parameters(own, robot, options.robot)
    if own is not None and own.oval > ROUGHLY:
        warnings.warn(
            f"{options.robot}: uncertainty: oval is {own.oval:g}; above {ROUGHLY:g} intervals are too narrow now and then, so "
            "calibrate the robot",
            stacklevel=2,
        )
    if options.s_std is not None:
        positive("--s-std", options.s_std)
        in_metres("--s-std", options.s_std, rod.length)
    noises = Noises(stated, angle, base, options.curvature_noise, options.s_std)
    try:
        unknowns = Unknowns(loads, options.unknown_tip, std, registration, uncertainty=nearly.of_a_sample)
        return Problem(robot, unknowns, shapes.sensors(noises), shapes.tension, options.steps or 0)
    except ValueError as error:
        raise InputError(f"{options.shapes}: {error}") from None


def estimate(options: Namespace) -> None:
    """torchrod estimate."""
    robot = read_robot(options.robot)
    shapes = read_shapes(options.shapes, robot, options.units, options.tensions)
    known = read_uncertainty(options.robot)
    calibrated = known.calibrated
    shapes = as_calibrated(options.shapes, shapes, calibrated)
    usual = calibrated.noise if calibrated is not None else None
    noise = usual or NOISE if options.noise is None else noise_or_auto(options.noise, robot.rod.length)
    if options.tension_std is not None:
        positive("--tension-std", options.tension_std)
    positive("--max-iterations", options.max_iterations)
    writable(options.out, RESULT_SUFFIXES)
    writable(options.plot, FIGURE_SUFFIXES)
    _warn_of_idle(options, robot, shapes)
    problem = _problem(options, robot, known, shapes, noise)
    count, at = _count(options, robot), options.location or None
    if options.load_prior == "smooth" and (count not in (1, "auto") or at or _friction(options) is not None):
        raise InputError(
            "--load-prior smooth is one load along the whole rod; leave out --contacts, --location, --contact-friction and --axial"
        )
    candidates = contact_hypotheses(problem, count, options.load_prior, at, _friction(options))
    _check_enough(options, problem.of(next((c for c in candidates if c.contacts), candidates[0]).unknowns))
    settings = Settings(max_iterations=options.max_iterations, robust=ROBUST if options.robust else math.inf)
    sampled = _sampled(options, problem, len(candidates) > 1)
    if options.load_prior == "auto" and not sampled:  # which only draws can weigh against the others
        warnings.warn("--load-prior auto weighs contact against distributed alone: smooth loads need draws", stacklevel=2)
        candidates = [c for c in candidates if not isinstance(c.unknowns.loads, SmoothCoordinates)]
    try:
        named = problem.batch <= (MOST_PROFILES if kernel_walks(problem) else MOST_DRAWN)
        found = analyze(problem, candidates, noise is None, settings, _starts(options, problem, candidates), bar, sampled, named)
    except InputError:  # names its own file
        raise
    except ValueError as error:
        raise InputError(f"{options.shapes}: {error}") from None
    fit = found.estimate
    print(table(fit, shapes.samples, found.diagnosis, found.noise, found.intervals))  # noqa: T201
    if said := _to_bear_in_mind(options, found):
        print(said)  # noqa: T201
    if options.out:
        nearly, base = problem.unknowns.uncertainty, read_base_pose(options.robot)
        result = Result(
            fit,
            shapes.samples,
            robot.name,
            evidence=found.evidence,
            profile=_profile(options, found),
            diagnosis=found.diagnosis,
            noise=found.noise,
            places=found.places,
            base=base if base is None or calibrated is None else base.moved(calibrated.zeta),
            time=shapes.time,
            intervals=found.intervals,
            parameters=() if nearly is None else [p.name for p in nearly.parameters(robot)],
        )
        write_result(options.out, result)
    if options.plot:
        _draw(options.plot, robot, shapes, found)


def _to_bear_in_mind(options: Namespace, found: Analysis) -> str:
    """What is taken as known where nobody said that it is not, and where intervals are wrong; "" where there is nothing."""
    said, problem = [], found.problem
    if problem.unknowns.uncertainty is None:
        parts = ["tensions"] * (not problem.state.tension.size) + ["friction"] if len(problem.robot.tendons) else []
        said.append(EXACT.format(parts=" and ".join([", ".join(parts), "stiffness"]) if parts else "stiffness"))
    if _friction(options) is None and options.contacts != "0" and options.load_prior != "smooth":
        said.append(LATERAL)
        said += [NARROW] * (options.load_prior == "contact" and not options.location)
    fit = found.estimate
    known = fit.status == int(Status.CONVERGED)
    chi2, dof = float(fit.chi2[known].sum()), int(fit.dof[known].sum())
    if found.noise is None and dof > 0 and float(chdtr(dof, chi2)) < FAR_TOO_GOOD:
        said.append(GENEROUS.format(chi2=chi2, dof=dof))
    beside = any(u.tip == "wrench" and len(rows) and not options.location and u.loads.size for u, rows in found.parts)
    if beside and all(isinstance(sensor, Markers) for sensor in problem.sensors):
        said.append(HIDDEN)
    return " ".join(said)


def _profile(options: Namespace, found: Analysis) -> Profile | None:
    """The load profile, whose band takes far longer than the fit; of a large batch only where it is asked for, which is told."""
    if options.profile == "off" or options.out.endswith(".csv"):
        return None
    if options.profile == "auto" and found.problem.batch > MOST_PROFILES:
        warnings.warn(
            f"{options.out}: without the load profiles of {found.problem.batch} samples, which would take longer than all else; "
            "--profile on writes them",
            stacklevel=2,
        )
        return None
    return found.profile


def _starts(options: Namespace, problem: Problem, candidates: list[Hypothesis]) -> StartFor:
    """Where the fits of each hypothesis start: cold, from the shipped checkpoint that fits, or from the one that is named."""
    if options.warm_start == "off":
        return lambda _: cold_start
    if options.warm_start == "auto":
        return learned_or_cold
    named, problems = WarmStart.read(options.warm_start), [problem.of(c.unknowns) for c in candidates]
    reasons = [named.misfit(own) for own in problems]
    if None not in reasons:
        nearest = min(range(len(problems)), key=lambda k: abs(candidates[k].contacts - named.card["contacts"]))
        raise InputError(f"--warm-start {options.warm_start}: {reasons[nearest]}")
    fitting = problems[reasons.index(None)]
    outside = int((~named.known(fitting, features(fitting))).sum())
    if outside:
        warnings.warn(f"{options.warm_start}: {outside} samples lie outside of what it knows and start cold", stacklevel=2)
    return lambda own: named if named.misfit(own, measured=False) is None else cold_start


def _drawn_rod(found: Analysis, sample: int) -> FittedRod:
    return found.estimate.fitted_rod(sample, found.profile, interval_of(found.estimate, found.intervals, "location"))


def _draw(path: str, robot: Robot, shapes: Shapes, found: Analysis) -> None:
    from ..plotting.estimate import draw

    fit = found.estimate
    drawable = torch.isfinite(fit.base_wrench).all(-1).nonzero().flatten().tolist()
    if not drawable:
        warnings.warn(f"{path}: not written, because no sample has a fit to draw", stacklevel=2)
        return
    b = drawable[0]
    title = f"{robot.name}, sample {shapes.samples[b]}: {found.message(b)}"
    tension = None if shapes.tension is None else shapes.tension[b]
    rod, points, nearly = _drawn_rod(found, b), shapes.points[b], found.problem.unknowns.uncertainty
    if nearly is not None and fit.parameters is not None:
        names = [p.name for p in nearly.parameters(robot)]
        robot, warp = nearly.found_at(robot, dict(zip(names, fit.parameters[b].tolist(), strict=True)))
        points = warp.undone(points)
    draw(path, robot, rod, points, tension, title)
