"""What `torchrod simulate` and `torchrod simulate-dataset` do, once their arguments are known."""

import math
import re
import warnings
from itertools import pairwise
from pathlib import Path

import torch
from jsonargparse import Namespace
from torch import Tensor

from ..data.shards import has_shard, prepare_folder, write_manifest
from ..data.spec_file import read_dataset_spec
from ..data.workers import produce
from ..io import Shapes, read_robot, read_uncertainty, write_shapes
from ..mechanics.actuation import solve_displacement
from ..mechanics.loads import Load, PointForces, PointWrenches
from ..mechanics.robot import Robot
from ..mechanics.statics import MOST_STEPS, Equilibrium, solve_shape
from ..util.errors import InputError
from ..util.precision import DTYPE
from ..util.progress import bar
from ..util.status import Status
from .arguments import writable

DEFAULT_MARKERS = 20
MOST_MARKERS = 10_000


def simulate(options: Namespace) -> None:
    """torchrod simulate."""
    robot = read_robot(options.robot)
    L, T = robot.rod.length, len(robot.tendons)
    at = _places(options, L)
    _actuation(options, T)
    if not 0 <= options.seed < 2**63:
        raise InputError(f"--seed is {options.seed}; it must be from 0 to 2^63 - 1")
    if not (math.isfinite(options.noise) and options.noise >= 0):
        raise InputError(f"--noise is {options.noise}; it must be at least 0")
    if options.seed and not options.noise:
        warnings.warn("--seed has no effect: it is of the noise; add --noise", stacklevel=2)
    if options.steps is not None and not 1 <= options.steps <= MOST_STEPS:
        raise InputError(f"--steps is {options.steps}; it must be from 1 to {MOST_STEPS}")
    writable(options.out, (".csv",))
    s = torch.tensor(at, dtype=DTYPE)
    loads = _known_loads(options, L)
    if options.displacement:
        shape, tensions = _displaced(robot, loads, options.displacement, s, options.steps)
    else:
        tensions = torch.tensor([options.tension], dtype=DTYPE) if T else None
        shape = solve_shape(robot, loads, tensions, s, 1, options.steps)
    if Status(int(shape.status[0])) is not Status.CONVERGED:
        raise InputError(f"{options.robot}: {_why(options, robot, shape)}")
    noise = options.noise * torch.randn(shape.p.shape, generator=torch.Generator().manual_seed(options.seed), dtype=DTYPE)
    shapes = Shapes(s, shape.p + noise, ["0"], None, tensions)
    if (calibrated := read_uncertainty(options.robot).calibrated) is not None:
        shapes = shapes.measured(calibrated.zeta, calibrated.markers)
    write_shapes(options.out, shapes)
    tip = [f"{v * 1e3:.2f}" for v in shape.p[0, -1].tolist()]
    pulled = f", tensions {', '.join(f'{t:.3f}' for t in tensions[0].tolist())} N" if tensions is not None else ""
    print(f"{options.out}: {len(at)} markers, the last at ({', '.join(tip)}) mm{pulled}")  # noqa: T201


def _why(options: Namespace, robot: Robot, shape: Equilibrium) -> str:
    """Why there is no shape, in one sentence that names the load to look at."""
    load = _heaviest(options, robot)
    if not bool(shape.resolved[0]):
        return f"{load} bends or turns the rod more sharply than {MOST_STEPS} steps can follow; check its size and units"
    if bool(shape.only_unstable[0]):
        return f"under {load} only an unstable equilibrium was found, in which no rod stays; check its size and units"
    return f"no equilibrium was found under these loads, of which {load} is the largest; check their size and units"


def _heaviest(options: Namespace, robot: Robot) -> str:
    """The option, or the key of the robot file, whose load is the largest beside the rod's stiffness."""
    L, rod = robot.rod.length, robot.rod
    sizes = {
        "rod.gravity": L * float(robot.weight.norm()),
        **{f"--point {' '.join(row)}": math.hypot(*map(float, row[1:])) for row in options.point or []},
        f"--tip-force {_spoken(options.tip_force)}": math.hypot(*(options.tip_force or [0.0])),
        f"--tip-moment {_spoken(options.tip_moment)}": math.hypot(*(options.tip_moment or [0.0])) / L,
        f"--tension {_spoken(options.tension)}": sum(map(abs, options.tension or [])) * _reach(robot) / L,
        f"--displacement {_spoken(options.displacement)}": sum(map(abs, options.displacement or [])) * rod.force_scale / L,
    }
    return max(sizes, key=sizes.__getitem__)


def _reach(robot: Robot) -> float:
    """The largest offset of a tendon (m)."""
    return max((math.hypot(x, y) for t in robot.tendons.tendons for _, x, y in t.routing), default=0.0)


def _spoken(values: list[float] | None) -> str:
    return " ".join(f"{v:g}" for v in values or [])


def _places(options: Namespace, L: float) -> list[float]:
    """The markers (m) of --at or --markers."""
    if options.at is None:
        count = DEFAULT_MARKERS if options.markers is None else options.markers
        if not 1 <= count <= MOST_MARKERS:
            raise InputError(f"--markers is {count}; it must be from 1 to {MOST_MARKERS}")
        return [L * (i + 1) / count for i in range(count)]
    if options.markers is not None:
        raise InputError("--markers and --at both say where the markers are; give one of them")
    if any(not 0 <= s <= L for s in options.at) or any(b <= a for a, b in pairwise(options.at)):
        raise InputError(f"--at {options.at}: must increase and lie on the rod, 0 to {L} m")
    return options.at


def _actuation(options: Namespace, tendons: int) -> None:
    """Refuse anything but one tension or one displacement per tendon."""
    if options.tension and options.displacement:
        raise InputError("--tension and --displacement both say how the tendons are pulled; give one of them")
    name, values = ("--displacement", options.displacement) if options.displacement else ("--tension", options.tension or [])
    if len(values) != tendons:
        raise InputError(f"{name} has {len(values)} values but the robot has {tendons} tendons; give one per tendon")
    if not all(math.isfinite(v) for v in values) or (name == "--tension" and any(v < 0 for v in values)):
        raise InputError(f"{name} {values}: must be finite" + (" and at least 0 N" if name == "--tension" else ""))


def _displaced(
    robot: Robot, loads: tuple[Load, ...], displacement: list[float], s: Tensor, steps: int | None
) -> tuple[Equilibrium, Tensor]:
    """The shape with so much of every tendon pulled out, and what its load cells read (1, T) N."""
    answer = solve_displacement(robot, loads, torch.tensor([displacement], dtype=DTYPE), s, steps)
    offset, gain = (
        torch.tensor([getattr(t, f"tension_{k}") for t in robot.tendons.tendons], dtype=DTYPE) for k in ("offset", "gain")
    )
    reading = (answer.tension - offset) / gain
    if bool((reading < 0).any()):
        raise InputError("a slack tendon's load cell would read less than 0 N, by its tension_offset; set that to 0 to simulate")
    return answer.equilibrium, reading


def _point(row: list[float]) -> list[float]:
    """S, FX, FY, FZ of --point, which may leave out FZ. Errors: ValueError."""
    if not 3 <= len(row) <= 4:
        raise ValueError(f"{len(row)} given")
    return [*row, 0.0][:4]


def _known_loads(options: Namespace, L: float) -> tuple[Load, ...]:
    loads: list[Load] = []
    if options.point:
        try:
            rows = torch.tensor([_point([float(v) for v in row]) for row in options.point], dtype=DTYPE)
        except ValueError as error:
            raise InputError(f"--point takes three numbers, S FX FY, or four, S FX FY FZ: {error}") from None
        if not bool(torch.isfinite(rows).all()) or bool(((rows[:, 0] < 0) | (rows[:, 0] > L)).any()):
            raise InputError(f"--point {options.point}: S must lie on the rod, 0 to {L} m, and the force be finite")
        loads.append(PointForces(rows[:, 1:].unsqueeze(0), rows[:, 0].unsqueeze(0)))
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
    with bar(total, name, kept) as shown:
        produce(spec, folder, missing, options.workers or torch.get_num_threads(), options.scheduler, shown.update)
    digest = write_manifest(folder, spec)
    done = f"digest {digest}" if digest else f"the manifest follows when all {spec.shards} shards are there"
    print(f"{folder}: shards made {len(missing)}, kept {len(mine) - len(missing)}; {done}")  # noqa: T201
