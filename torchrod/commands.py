"""What each command does, once its arguments are known."""

import math
import warnings
from collections.abc import Callable
from dataclasses import replace

import torch
from jsonargparse import Namespace
from tqdm import tqdm

from .arguments import noise_std, positive, writable
from .calibrate_command import calibrate
from .coordinates import GaussianCoordinates
from .diagnosis import Diagnosis, diagnose
from .errors import InputError
from .estimator import Settings
from .estimator import estimate as run_estimate
from .features import features
from .frame import STEPS as FRAME_STEPS
from .frame import common_frame
from .io import (
    RESULT_SUFFIXES,
    read_fit,
    read_robot,
    read_shapes,
    write_result,
)
from .measurement import Markers, Model
from .observability_command import observability
from .profile import Profile, joined_profile
from .result import Estimate, Evidence
from .robot import Robot
from .selection import Hypothesis, select
from .simulate_command import simulate, simulate_dataset
from .starts import StartRule, cold_start
from .status import Status
from .warmstart import WarmStart, find_warm_start

__all__ = ["calibrate", "estimate", "observability", "plot", "simulate", "simulate_dataset"]

MAX_CONTACTS = 3
FIGURE_SUFFIXES = (".png", ".pdf", ".svg")


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


def estimate(options: Namespace) -> None:
    """torchrod estimate."""
    robot = read_robot(options.robot)
    shapes = read_shapes(options.shapes, robot)
    noise_std(options.noise)
    positive("--steps", options.steps)
    positive("--max-iterations", options.max_iterations)
    writable(options.out, RESULT_SUFFIXES)
    writable(options.plot, FIGURE_SUFFIXES)
    if options.one_frame and not options.registration:
        raise InputError("--one-frame says that all samples share what --registration estimates; give --registration as well")
    count = _count(options, robot)
    rod, locations = robot.rod, tuple(options.location) if options.location else None

    def model(k: int, prior: str, tip: str) -> Model:
        coordinates = GaussianCoordinates(k, rod.length, rod.force_scale, prior, locations)
        return Model(robot, coordinates, options.registration, steps=options.steps, tip=tip)

    settings = Settings(max_iterations=options.max_iterations)
    candidates = _hypotheses(options, count, model)
    try:
        start_of = _starts(options, [c.model for c in candidates], shapes.markers)
        result, evidence = _fitted(candidates, shapes.markers, options.noise, settings, start_of)
        markers, fitted_by = shapes.markers, _fitted_by(candidates, evidence, len(shapes.samples))
        if options.one_frame:
            with _bar(FRAME_STEPS * len(shapes.samples), "base frame") as bar:
                frame = common_frame(fitted_by, markers, options.noise, result, settings, bar.update)
            markers = frame.corrected(markers)
            candidates = [replace(c, model=replace(c.model, registration=False)) for c in candidates]
            result, evidence = _fitted(candidates, markers, options.noise, settings, start_of)
            fitted_by = _fitted_by(candidates, evidence, len(shapes.samples))
            result = frame.widened(fitted_by, markers, options.noise, result)
    except ValueError as error:
        raise InputError(f"{options.shapes}: {error}") from None
    diagnosis = diagnose(fitted_by, markers, options.noise, result, settings)
    print(_report(result, shapes.samples, diagnosis))  # noqa: T201
    if options.out or options.plot:
        profile = joined_profile(fitted_by, result.x, result.covariance)
        if options.out:
            write_result(options.out, result, shapes.samples, robot.name, evidence, profile, diagnosis)
        if options.plot:
            _draw(options.plot, robot, shapes.markers, result, shapes.samples, profile)


def _fitted(
    candidates: list[Hypothesis], markers: Markers, noise: float, settings: Settings, start_of: Callable[[Model], StartRule]
) -> tuple[Estimate, Evidence | None]:
    """The fit by the only model there is, or by the one that each sample asks for."""
    if len(candidates) > 1:
        return select(candidates, markers, noise, settings, start_of, _bar)
    only = candidates[0]
    with _bar(len(markers.positions), f"{only.contacts} contact{'s' * (only.contacts != 1)}") as bar:
        return run_estimate(only.model, markers, noise, settings, start_of(only.model), bar.update), None


def _fitted_by(candidates: list[Hypothesis], evidence: Evidence | None, samples: int) -> list[tuple[Model, torch.Tensor]]:
    """Every model with the samples that it was chosen for."""
    choice = torch.zeros(samples, dtype=torch.int64) if evidence is None else evidence.choice
    return [(c.model, (choice == h).nonzero().squeeze(-1)) for h, c in enumerate(candidates)]


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


def _starts(options: Namespace, models: list[Model], markers: Markers) -> Callable[[Model], StartRule]:
    """Where the fits of each model start: cold, from the shipped checkpoint that fits, or from the one that is named."""
    if options.warm_start == "off":
        return lambda _: cold_start
    if options.warm_start == "auto":
        return lambda model: find_warm_start(model) or cold_start
    named = WarmStart.read(options.warm_start)
    reasons = [named.misfit(model, markers, options.noise) for model in models]
    if None not in reasons:
        nearest = min(range(len(models)), key=lambda k: abs(models[k].coordinates.size - 4 * named.card["contacts"]))
        raise InputError(f"--warm-start {options.warm_start}: {reasons[nearest]}")
    read = features(models[reasons.index(None)], markers, options.noise)
    outside = int((~named.known(markers, read)).sum())
    if outside:
        warnings.warn(f"{options.warm_start}: {outside} samples lie outside of what it knows and start cold", stacklevel=2)
    return lambda model: named if named.misfit(model) is None else cold_start


def _bar(total: int, what: str) -> tqdm:
    """A progress bar on stderr, shown where there is more than a second of work."""
    return tqdm(total=total, desc=what, unit="sample", delay=1.0, leave=False, dynamic_ncols=True)


def _report(result: Estimate, samples: list[str], diagnosis: Diagnosis) -> str:
    """The table on the screen: one line per load."""
    columns = f"{'force (N)':>20}{'F_x (N)':>10}{'F_y (N)':>10}{'location (mm)':>20}{'rms (mm)':>10}"
    lines = [f"{'sample':>8}  {'status':<13} {'ok':<4}{'load':>4}{columns}"]
    notes = []
    for b, name in enumerate(samples):
        status = Status(int(result.status[b])).label
        ok = "yes" if result.accepted[b] else "no"
        rms = float(result.rms_residual[b]) * 1e3
        present = [k for k in range(result.force.shape[1]) if status == "invalid" or not math.isnan(float(result.force[b, k, 0]))]
        for k in present or [None]:
            head = f"{name:>8}  {status:<13} {ok:<4}" if k in (0, None) else " " * 28
            if k is None:
                lines.append(f"{head}{'-':>4}{'no load':>20}{'':>40}{rms:>10.3f}")
                continue
            force = f"{float(result.magnitude[b, k]):.4f} +- {float(result.magnitude_std[b, k]):.4f}"
            place = f"{float(result.location[b, k]) * 1e3:.1f} +- {float(result.location_std[b, k]) * 1e3:.1f}"
            fx, fy = result.force[b, k].tolist()
            lines.append(f"{head}{k + 1:>4}{force:>20}{fx:>10.4f}{fy:>10.4f}{place:>20}{rms:>10.3f}")
        if result.tip is not None and result.tip_covariance is not None:
            std = result.tip_covariance[b].diagonal().sqrt().tolist()
            both = [f"{v:.4f} +- {s:.4f}" for v, s in zip(result.tip[b].tolist(), std, strict=True) if s > 0 or math.isnan(s)]
            lines.append(f"{'':>28} tip, base frame: force (N) {', '.join(both[:3])}" + _moment(both[3:]))
        if not result.accepted[b] or diagnosis.message(b):
            notes.append(f"sample {name}: {result.message(b)} {diagnosis.message(b)}".rstrip())
    return "\n".join([*lines, *notes])


def _moment(values: list[str]) -> str:
    return f"; moment (N m) {', '.join(values)}" if values else ""


def _draw(path: str, robot: Robot, markers: Markers, result: Estimate, samples: list[str], profile: Profile | None) -> None:
    from .plot import draw

    drawable = torch.isfinite(result.base_wrench).all(-1).nonzero().flatten().tolist()
    if not drawable:
        warnings.warn(f"{path}: not written, because no sample has a fit to draw", stacklevel=2)
        return
    b = drawable[0]
    draw(path, robot, result.fit(b, profile), markers, b, f"{robot.name}, sample {samples[b]}: {result.message(b)}")


def plot(options: Namespace) -> None:
    """torchrod plot."""
    from .plot import draw

    robot = read_robot(options.robot)
    shapes = read_shapes(options.shapes, robot)
    sample = options.sample or shapes.samples[0]
    if sample not in shapes.samples:
        raise InputError(f"{options.shapes}: has no sample {sample}; choose one of its samples with --sample")
    writable(options.out, FIGURE_SUFFIXES)
    fit = read_fit(options.result, sample)
    draw(options.out, robot, fit, shapes.markers, shapes.samples.index(sample), f"{robot.name}, sample {sample}")
