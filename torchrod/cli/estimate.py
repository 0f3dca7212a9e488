"""torchrod estimate: arguments to a problem, and an analysis to a table and files."""

import math
import warnings

import torch
from jsonargparse import Namespace

from ..analysis.count import Hypothesis, StartFor
from ..analysis.diagnosis import ROBUST
from ..analysis.pipeline import Analysis, analyze, contact_hypotheses, learned_or_cold
from ..estimation.load_profile import Profile
from ..estimation.solve import Settings
from ..estimation.starts import cold_start
from ..io import RESULT_SUFFIXES, Noises, Shapes, read_base_pose, read_robot, read_shapes, read_uncertainty, write_result
from ..learned.features import features
from ..learned.warm_start import WarmStart
from ..mechanics.robot import Robot
from ..model.load_families import GaussianCoordinates
from ..model.problem import FINEST, Problem
from ..model.unknowns import Registration, Scope, Unknowns
from ..util.errors import InputError
from ..util.progress import bar
from .arguments import FIGURE_SUFFIXES, noise_or_auto, positive, writable
from .table import table

MOST_PROFILES = 1000  # samples, where nobody says whether profiles are wanted: 0.6 ms each
STATED = 1 / 400  # of the length: what stands for a noise that is to be estimated


def _count(options: Namespace, robot: Robot) -> int | str:
    """How many loads, or auto."""
    L = robot.rod.length
    contacts = options.contacts or "1"
    if options.location:
        if options.contacts not in (None, str(len(options.location))):
            raise InputError(f"--contacts {options.contacts} but {len(options.location)} locations; give one --location per load")
        if not all(0 < s <= L for s in options.location):
            raise InputError(f"--location {options.location}: must lie on the rod, above 0 and up to {L} m")
        if len(set(options.location)) < len(options.location):
            raise InputError(f"--location {options.location}: two loads at one place cannot be told apart; give it once")
        return len(options.location)
    if contacts != "auto" and contacts not in [str(k) for k in range(11)]:
        raise InputError(f"--contacts is {contacts!r}; it must be auto or a number from 0 to 10")
    return contacts if contacts == "auto" else int(contacts)


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


def _problem(options: Namespace, robot: Robot, shapes: Shapes, noise: float | None) -> Problem:
    """The readings, with one load among the unknowns, whose number and width the hypotheses replace."""
    rod = robot.rod
    std = options.tension_std if len(robot.tendons) else None
    loads = GaussianCoordinates(1, rod.length, rod.force_scale)
    nearly = read_uncertainty(options.robot)
    registration = _registration(options) or nearly.frame
    stated = STATED * rod.length if noise is None else noise
    positive("--angle-noise", options.angle_noise)
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
    noises = Noises(stated, options.angle_noise, base, options.curvature_noise)
    try:
        unknowns = Unknowns(loads, options.unknown_tip, std, registration, uncertainty=nearly.robot)
        return Problem(robot, unknowns, shapes.sensors(noises), shapes.tension, options.steps or 0)
    except ValueError as error:
        raise InputError(f"{options.shapes}: {error}") from None


def estimate(options: Namespace) -> None:
    """torchrod estimate."""
    robot = read_robot(options.robot)
    shapes = read_shapes(options.shapes, robot, options.units)
    noise = noise_or_auto(options.noise, robot.rod.length)
    if options.tension_std is not None:
        positive("--tension-std", options.tension_std)
    positive("--max-iterations", options.max_iterations)
    writable(options.out, RESULT_SUFFIXES)
    writable(options.plot, FIGURE_SUFFIXES)
    problem = _problem(options, robot, shapes, noise)
    candidates = contact_hypotheses(problem, _count(options, robot), options.load_prior, options.location or None)
    settings = Settings(max_iterations=options.max_iterations, robust=ROBUST if options.robust else math.inf)
    sampled = options.intervals == "sampled" and bool(options.out or options.plot)  # which the table does not show
    try:
        found = analyze(problem, candidates, noise is None, settings, _starts(options, problem, candidates), bar, sampled)
    except InputError:  # names its own file
        raise
    except ValueError as error:
        raise InputError(f"{options.shapes}: {error}") from None
    fit = found.estimate
    print(table(fit, shapes.samples, found.diagnosis, found.noise))  # noqa: T201
    if options.out:
        said = {name: getattr(found, name) for name in ("evidence", "diagnosis", "noise", "places", "intervals")}
        nearly = problem.unknowns.uncertainty
        said["parameters"] = [] if nearly is None else [p.name for p in nearly.parameters(robot)]
        said |= {"profile": _profile(options, found), "base": read_base_pose(options.robot), "time": shapes.time}
        write_result(options.out, fit, shapes.samples, robot.name, **said)
    if options.plot:
        _draw(options.plot, robot, shapes, found)


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
        nearest = min(range(len(problems)), key=lambda k: abs(problems[k].state.loads.size - 4 * named.card["contacts"]))
        raise InputError(f"--warm-start {options.warm_start}: {reasons[nearest]}")
    fitting = problems[reasons.index(None)]
    outside = int((~named.known(fitting, features(fitting))).sum())
    if outside:
        warnings.warn(f"{options.warm_start}: {outside} samples lie outside of what it knows and start cold", stacklevel=2)
    return lambda own: named if named.misfit(own, measured=False) is None else cold_start


def _draw(path: str, robot: Robot, shapes: Shapes, found: Analysis) -> None:
    from ..plotting.estimate import draw

    fit = found.estimate
    drawable = torch.isfinite(fit.base_wrench).all(-1).nonzero().flatten().tolist()
    if not drawable:
        warnings.warn(f"{path}: not written, because no sample has a fit to draw", stacklevel=2)
        return
    b = drawable[0]
    title = f"{robot.name}, sample {shapes.samples[b]}: {fit.message(b)}"
    tension = None if shapes.tension is None else shapes.tension[b]
    draw(path, robot, fit.fitted_rod(b, found.profile), shapes.positions[b], tension, title)
