"""What each command does, once its arguments are known."""

import math
import re
import warnings
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import torch
from jsonargparse import Namespace
from tqdm import tqdm

from .coordinates import GaussianCoordinates
from .errors import InputError
from .estimator import Settings
from .estimator import estimate as run_estimate
from .features import features
from .io import (
    RESULT_SUFFIXES,
    Shapes,
    has_shard,
    prepare_folder,
    read_dataset_spec,
    read_fit,
    read_robot,
    read_shapes,
    write_manifest,
    write_result,
    write_shapes,
)
from .loads import Load, PointForces, PointWrenches
from .measurement import Markers, Model
from .production import produce
from .result import Estimate
from .robot import Robot
from .rod import DTYPE
from .selection import select_count
from .starts import StartRule, cold_start
from .statics import solve_shape
from .status import Status
from .warmstart import WarmStart, find_warm_start

MAX_CONTACTS = 3
FIGURE_SUFFIXES = (".png", ".pdf", ".svg")


def _positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"{name} is {value}; it must be a positive number")


def _writable(path: str | None, suffixes: tuple[str, ...]) -> None:
    """Refuse before the work, not after it."""
    if path is None:
        return
    if Path(path).suffix not in suffixes:
        raise InputError(f"{path}: cannot write this kind of file; let its name end in {' or '.join(suffixes)}")
    if not Path(path).resolve().parent.is_dir():
        raise InputError(f"{path}: its folder does not exist; create it first")
    if Path(path).is_dir():
        raise InputError(f"{path}: is a folder; give a file name")


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
    if not 1e-9 <= options.noise <= 1:
        raise InputError(f"--noise is {options.noise}; it must be a standard deviation in metres, from 1e-9 to 1")
    _positive("--steps", options.steps)
    _positive("--max-iterations", options.max_iterations)
    _writable(options.out, RESULT_SUFFIXES)
    _writable(options.plot, FIGURE_SUFFIXES)
    count = _count(options, robot)
    rod, locations = robot.rod, tuple(options.location) if options.location else None

    def model(k: int) -> Model:
        coordinates = GaussianCoordinates(k, rod.length, rod.force_scale, options.load_prior, locations)
        return Model(robot, coordinates, options.registration, steps=options.steps)

    settings = Settings(max_iterations=options.max_iterations)
    models = [model(k) for k in (range(MAX_CONTACTS + 1) if count is None else [count])]
    start_of = _starts(options, models, shapes.markers)
    try:
        if count is None:
            result = select_count(models, shapes.markers, options.noise, settings, _bar, start_of)
        else:
            with _bar(len(shapes.samples), f"{count} contact{'s' * (count != 1)}") as bar:
                result = run_estimate(models[0], shapes.markers, options.noise, settings, start_of(models[0]), bar.update)
    except ValueError as error:
        raise InputError(f"{options.shapes}: {error}") from None
    print(_report(result, shapes.samples))  # noqa: T201
    if options.out:
        write_result(options.out, result, shapes.samples, robot.name)
    if options.plot:
        _draw(options.plot, robot, shapes.markers, result, shapes.samples)


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


def _report(result: Estimate, samples: list[str]) -> str:
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
        if not result.accepted[b]:
            notes.append(f"sample {name}: {result.message(b)}")
    return "\n".join([*lines, *notes])


def _draw(path: str, robot: Robot, markers: Markers, result: Estimate, samples: list[str]) -> None:
    from .plot import draw

    drawable = torch.isfinite(result.base_wrench).all(-1).nonzero().flatten().tolist()
    if not drawable:
        warnings.warn(f"{path}: not written, because no sample has a fit to draw", stacklevel=2)
        return
    b = drawable[0]
    draw(path, robot, result.fit(b), markers, b, f"{robot.name}, sample {samples[b]}: {result.message(b)}")


def simulate(options: Namespace) -> None:
    """torchrod simulate."""
    robot = read_robot(options.robot)
    L, T = robot.rod.length, len(robot.tendons)
    if options.at is None and not 1 <= options.markers <= 10_000:
        raise InputError(f"--markers is {options.markers}; it must be from 1 to 10000")
    at = options.at if options.at is not None else [L * (i + 1) / options.markers for i in range(options.markers)]
    if any(not 0 <= s <= L for s in at) or any(b <= a for a, b in pairwise(at)):
        raise InputError(f"--at {at}: must increase and lie on the rod, 0 to {L} m")
    tension = options.tension or []
    if len(tension) != T:
        raise InputError(f"--tension has {len(tension)} values but the robot has {T} tendons; give one per tendon")
    if any(not (math.isfinite(t) and t >= 0) for t in tension):
        raise InputError(f"--tension {tension}: must be at least 0 N and finite")
    if not 0 <= options.seed < 2**63:
        raise InputError(f"--seed is {options.seed}; it must be from 0 to 2^63 - 1")
    if not (math.isfinite(options.noise) and options.noise >= 0):
        raise InputError(f"--noise is {options.noise}; it must be at least 0")
    _writable(options.out, (".csv",))
    s = torch.tensor(at, dtype=DTYPE)
    tensions = torch.tensor([tension], dtype=DTYPE) if T else None
    shape = solve_shape(robot, _known_loads(options, L), tensions, s, 1)
    status = Status(int(shape.status[0]))
    if status is not Status.CONVERGED:
        raise InputError(f"{options.robot}: no equilibrium was found under these loads; check their size and units")
    noise = options.noise * torch.randn(shape.p.shape, generator=torch.Generator().manual_seed(options.seed), dtype=DTYPE)
    write_shapes(options.out, Shapes(Markers(s, shape.p + noise, None, tensions), ["0"]))
    tip = [f"{v * 1e3:.2f}" for v in shape.p[0, -1].tolist()]
    print(f"{options.out}: {len(at)} markers, the last at ({', '.join(tip)}) mm")  # noqa: T201


def _known_loads(options: Namespace, L: float) -> tuple[Load, ...]:
    loads: list[Load] = []
    if options.point:
        try:
            rows = torch.tensor([[float(v) for v in row] for row in options.point], dtype=DTYPE)
        except ValueError as error:
            raise InputError(f"--point takes three numbers, S FX FY: {error}") from None
        if not bool(torch.isfinite(rows).all()) or bool(((rows[:, 0] < 0) | (rows[:, 0] > L)).any()):
            raise InputError(f"--point {options.point}: S must lie on the rod, 0 to {L} m, and the force be finite")
        force = torch.cat([rows[:, 1:], torch.zeros_like(rows[:, :1])], -1)
        loads.append(PointForces(force.unsqueeze(0), rows[:, 0].unsqueeze(0)))
    if options.tip_force or options.tip_moment:
        wrench = torch.tensor([options.tip_force or [0.0] * 3, options.tip_moment or [0.0] * 3], dtype=DTYPE)
        if not bool(torch.isfinite(wrench).all()):
            raise InputError("--tip-force and --tip-moment must be finite")
        loads.append(PointWrenches(wrench[:1].unsqueeze(0), wrench[1:].unsqueeze(0), torch.tensor([L], dtype=DTYPE)))
    return tuple(loads)


def _every_nth(shard: str | None, count: int) -> range:
    """The shards of job I of N; all of them without --shard."""
    if shard is None:
        return range(count)
    job = re.fullmatch(r"(\d{1,9})/(\d{1,9})", shard, re.ASCII)
    if job is None or not int(job[1]) < int(job[2]):
        raise InputError(f"--shard is {shard!r}; it must be I/N, job I of N, with I from 0 to N - 1")
    return range(int(job[1]), count, int(job[2]))


def simulate_dataset(options: Namespace) -> None:
    """torchrod simulate-dataset."""
    spec = read_dataset_spec(options.spec, options.samples, options.seed)
    mine, folder = _every_nth(options.shard, spec.shards), Path(options.out)
    if options.workers is not None and options.scheduler is not None:
        raise InputError("--workers are processes on this machine and --scheduler is a cluster; give one of them")
    if options.workers is not None and options.workers < 1:
        raise InputError(f"--workers is {options.workers}; it must be at least 1")
    prepare_folder(folder, spec)
    missing = [index for index in mine if not has_shard(folder, spec, index)]
    kept = sum(spec.samples_in(index) for index in mine) - sum(spec.samples_in(index) for index in missing)
    total, name = sum(map(spec.samples_in, mine)), f"{len(mine)} shards"
    with tqdm(
        total=total, initial=kept, desc=name, unit="sample", unit_scale=True, delay=1.0, leave=False, dynamic_ncols=True
    ) as bar:
        produce(spec, folder, missing, options.workers or torch.get_num_threads(), options.scheduler, bar.update)
    digest = write_manifest(folder, spec)
    done = f"digest {digest}" if digest else f"the manifest follows when all {spec.shards} shards are there"
    print(f"{folder}: shards made {len(missing)}, kept {len(mine) - len(missing)}; {done}")  # noqa: T201


def plot(options: Namespace) -> None:
    """torchrod plot."""
    from .plot import draw

    robot = read_robot(options.robot)
    shapes = read_shapes(options.shapes, robot)
    sample = options.sample or shapes.samples[0]
    if sample not in shapes.samples:
        raise InputError(f"{options.shapes}: has no sample {sample}; choose one of its samples with --sample")
    _writable(options.out, FIGURE_SUFFIXES)
    fit = read_fit(options.result, sample)
    draw(options.out, robot, fit, shapes.markers, shapes.samples.index(sample), f"{robot.name}, sample {sample}")
