"""torchrod estimate."""

import math
import warnings
from collections.abc import Callable
from dataclasses import replace

import torch
from jsonargparse import Namespace

from ..analysis.common_frame import STEPS as FRAME_STEPS
from ..analysis.common_frame import common_frame
from ..analysis.count import Hypothesis, same_kind, select
from ..analysis.diagnosis import ROBUST, diagnose
from ..analysis.noise import Noise, estimate_noise_among
from ..estimation.fit import Evidence
from ..estimation.load_profile import Profile, joined_profile
from ..estimation.result import Estimate
from ..estimation.solve import Settings
from ..estimation.solve import estimate as run_estimate
from ..estimation.starts import StartRule, cold_start
from ..io import RESULT_SUFFIXES, read_robot, read_shapes, write_result
from ..learned.features import features
from ..learned.warm_start import WarmStart, find_warm_start
from ..mechanics.robot import Robot
from ..model.load_families import GaussianCoordinates
from ..model.measurement import Markers, Model
from ..util.errors import InputError
from ..util.progress import bar
from .arguments import FIGURE_SUFFIXES, noise_or_auto, positive, writable
from .table import table

MAX_CONTACTS = 3
Parts = list[tuple[Model, torch.Tensor]]


def _count(options: Namespace, robot: Robot) -> int | None:
    """How many loads; None for auto."""
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
    if contacts == "auto":
        return None
    if contacts not in [str(k) for k in range(11)]:
        raise InputError(f"--contacts is {contacts!r}; it must be auto or a number from 0 to 10")
    return int(contacts)


def _check_frame_std(options: Namespace) -> None:
    shift, turn = options.frame_std
    positive("--frame-std SHIFT", shift)
    positive("--frame-std TURN", turn)
    if not options.registration:
        raise InputError("--frame-std says how well the base frame is known; give --registration as well")
    if turn > 1:
        raise InputError(f"--frame-std TURN is {turn}; it is in radians: 3 degrees are 0.052")


def estimate(options: Namespace) -> None:
    """torchrod estimate."""
    robot = read_robot(options.robot)
    shapes = read_shapes(options.shapes, robot)
    noise = noise_or_auto(options.noise, robot.rod.length)
    if options.tension_std is not None:
        positive("--tension-std", options.tension_std)
    positive("--steps", options.steps)
    positive("--max-iterations", options.max_iterations)
    writable(options.out, RESULT_SUFFIXES)
    writable(options.plot, FIGURE_SUFFIXES)
    if options.one_frame and not options.registration:
        raise InputError("--one-frame says that all samples share what --registration estimates; give --registration as well")
    if options.frame_std is not None:
        _check_frame_std(options)
    count = _count(options, robot)
    rod, locations = robot.rod, tuple(options.location) if options.location else None

    def model(k: int, prior: str, tip: str) -> Model:
        coordinates = GaussianCoordinates(k, rod.length, rod.force_scale, prior, locations)
        std = options.tension_std if len(robot.tendons) else None
        frame = tuple(options.frame_std) if options.frame_std else None
        return Model(robot, coordinates, options.registration, steps=options.steps, tip=tip, tension_std=std, frame_std=frame)

    settings = Settings(max_iterations=options.max_iterations, robust=ROBUST if options.robust else math.inf)
    candidates = _hypotheses(options, count, model)
    try:
        markers, noise, found = _with_noise(noise, [c.model for c in candidates], shapes.markers, settings)
        result, evidence, markers, fitted_by = _fitted(options, candidates, markers, noise, settings)
    except InputError:  # names its own file
        raise
    except ValueError as error:
        raise InputError(f"{options.shapes}: {error}") from None
    result = result if found is None else found.judged(result)
    diagnosis = diagnose(fitted_by, markers, noise, result, settings)
    print(table(result, shapes.samples, diagnosis, found))  # noqa: T201
    if options.out or options.plot:
        profile = joined_profile(fitted_by, result.x, result.covariance)
        if options.out:
            write_result(options.out, result, shapes.samples, robot.name, evidence, profile, diagnosis, found)
        if options.plot:
            _draw(options.plot, robot, shapes.markers, result, shapes.samples, profile)


def _with_noise(
    noise: float | None, models: list[Model], markers: Markers, settings: Settings
) -> tuple[Markers, float, Noise | None]:
    """The markers, their noise (m) or, where each sample has its own, the middle one, and what was estimated."""
    if noise is not None:
        return markers, noise, None
    found, known = estimate_noise_among([m for m in models if same_kind(m, models[-1])], markers, settings)
    assert known.sigma is not None
    return known, float(known.sigma.median()), found


def _fitted(
    options: Namespace, candidates: list[Hypothesis], markers: Markers, noise: float, settings: Settings
) -> tuple[Estimate, Evidence | None, Markers, Parts]:
    """The fit by the only model there is, or by the one that each sample asks for; with the markers in the frame that was found for
    all samples, if so wished, and every model with the samples that it was chosen for.
    """
    start_of = _starts(options, [c.model for c in candidates], markers, noise)

    def fitted(candidates: list[Hypothesis], markers: Markers) -> tuple[Estimate, Evidence | None, Parts]:
        if len(candidates) > 1:
            result, evidence = select(candidates, markers, noise, settings, start_of, bar)
            return result, evidence, [(c.model, (evidence.choice == h).nonzero().squeeze(-1)) for h, c in enumerate(candidates)]
        only = candidates[0]
        with bar(len(markers.positions), f"{only.contacts} contact{'s' * (only.contacts != 1)}") as shown:
            result = run_estimate(only.model, markers, noise, settings, start_of(only.model), shown.update)
        return result, None, [(only.model, torch.arange(len(markers.positions)))]

    result, evidence, parts = fitted(candidates, markers)
    if not options.one_frame:
        return result, evidence, markers, parts
    with bar(FRAME_STEPS * len(markers.positions), "base frame") as shown:
        frame = common_frame(parts, markers, noise, result, settings, shown.update)
    markers = frame.corrected(markers)
    plain = [replace(c, model=replace(c.model, registration=False)) for c in candidates]
    result, evidence, parts = fitted(plain, markers)
    return frame.widened(parts, markers, noise, result), evidence, markers, parts


def _hypotheses(options: Namespace, count: int | None, model: Callable[[int, str, str], Model]) -> list[Hypothesis]:
    """What competes: numbers of contacts, widths and the unknown tip, where they are left to the data."""
    counts = range(MAX_CONTACTS + 1) if count is None else [count]
    priors = ["contact", "distributed"] if options.load_prior == "auto" else [options.load_prior]
    tips = ["none", options.unknown_tip] if count is None and options.unknown_tip != "none" else [options.unknown_tip]
    found = []
    for k in counts:
        for tip in tips:
            for prior in priors if k else priors[:1]:
                name = f"{k} {prior}" if len(priors) > 1 and k else str(k)
                name += f" + tip {tip}" if len(tips) > 1 and tip != "none" else ""
                found.append(Hypothesis(name, k, model(k, prior, tip)))
    return found


def _starts(options: Namespace, models: list[Model], markers: Markers, noise: float) -> Callable[[Model], StartRule]:
    """Where the fits of each model start: cold, from the shipped checkpoint that fits, or from the one that is named."""
    if options.warm_start == "off":
        return lambda _: cold_start
    if options.warm_start == "auto":
        return lambda model: find_warm_start(model) or cold_start
    named = WarmStart.read(options.warm_start)
    reasons = [named.misfit(model, markers, noise) for model in models]
    if None not in reasons:
        nearest = min(range(len(models)), key=lambda k: abs(models[k].coordinates.size - 4 * named.card["contacts"]))
        raise InputError(f"--warm-start {options.warm_start}: {reasons[nearest]}")
    read = features(models[reasons.index(None)], markers, noise)
    outside = int((~named.known(markers, read)).sum())
    if outside:
        warnings.warn(f"{options.warm_start}: {outside} samples lie outside of what it knows and start cold", stacklevel=2)
    return lambda model: named if named.misfit(model) is None else cold_start


def _draw(path: str, robot: Robot, markers: Markers, result: Estimate, samples: list[str], profile: Profile | None) -> None:
    from ..plotting.estimate import draw

    drawable = torch.isfinite(result.base_wrench).all(-1).nonzero().flatten().tolist()
    if not drawable:
        warnings.warn(f"{path}: not written, because no sample has a fit to draw", stacklevel=2)
        return
    b = drawable[0]
    draw(path, robot, result.fit(b, profile), markers, b, f"{robot.name}, sample {samples[b]}: {result.message(b)}")
