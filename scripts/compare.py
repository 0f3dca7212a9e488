"""Do two checkouts of torchrod give the same answers, as fast? python scripts/compare.py OLD NEW [--speed] [--out DIR].

The command line is the contract: OLD makes shapes (`torchrod simulate-dataset`, fixed seeds), both estimate or calibrate from the
same files in processes of their own, with the same interpreter and a kernel of their own, and their JSON is compared.
DIR/compare.md holds the table, DIR/compare.json the numbers. Exit status 1 where answers differ by more than the tolerance.
--speed also times both, in turn, in one run: the command line, an iteration, whole estimates, single frames.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

NOISE, SEED = 1e-3, 20261127
ROD = """name = "steel rod"
[rod]
length = 0.4
diameter = 0.0014
youngs_modulus = 207e9
shear_modulus = 79e9
"""
TENDONS = ROD.replace("steel rod", "tendon robot") + "mass_per_length = {mass}\ngravity = [6.9, 0.0, -6.9]\n"
TENDONS += "".join(f"[[tendons]]\noffset = [{x}, {y}]\n" for x, y in ((0.008, 0.0), (-0.004, 0.006928), (-0.004, -0.006928)))
PUSH = 'family = "point"\nforce = [0.5, 1.0]\nlocation = [0.25, 0.975]\n'
WIDE = 'family = "gaussian"\nforce = [0.05, 5.0]\ndistribution = "log-uniform"\nlocation = [0.25, 0.975]\nwidth = [0.01, 0.25]\n'
NOTHING = 'family = "point"\nforce = [0.0, 0.0]\nlocation = [0.5, 0.5]\n'
TENSION = "[vary]\ntension = [0.5, 6.0]\n"
Arrays = dict[str, np.ndarray]


# ---- The two checkouts ----


@dataclass(frozen=True)
class Checkout:
    """A copy of one checkout's library, so that nothing is written into the checkout, and the folder that is its cache."""

    label: str
    path: Path
    cache: Path

    @classmethod
    def of(cls, label: str, checkout: Path, folder: Path) -> "Checkout":
        """Copy what is run; the kernel is built anew."""
        if not (checkout / "torchrod" / "__init__.py").is_file():
            raise SystemExit(f"{checkout} is no checkout of torchrod; give the folder that has torchrod/ in it")
        for part in ("torchrod", "checkpoints"):
            shutil.copytree(checkout / part, folder / label / part, ignore=shutil.ignore_patterns("__pycache__"))
        return cls(label, folder / label, folder / f"cache-{label}")

    def run(self, *arguments: str, folder: Path, module: bool = True, threads: int | None = 1) -> str:
        """python -m torchrod (or python) with these arguments, in a folder where nothing can be imported by accident.

        threads: None where they are not to be limited.
        """
        environment = os.environ | {"PYTHONPATH": str(self.path), "TORCHROD_CACHE": str(self.cache)}
        if threads is not None:
            environment["OMP_NUM_THREADS"] = str(threads)
        command = [sys.executable, *(["-m", "torchrod"] if module else []), *arguments]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{self.label} ({self.path}): {' '.join(command)}\n{done.stderr[-3000:]}")
        return done.stdout

    def prepare(self, folder: Path) -> str:
        """Wait for its kernel; refuse a Python that imports another torchrod. What serves: the kernel's name, or `torch path`."""
        where, library = json.loads(self.run("-c", KERNEL, folder=folder, module=False))
        if not Path(where).resolve().is_relative_to(self.path.resolve()):
            raise SystemExit(f"{self.label}: torchrod was imported from {where}, not from {self.path}")
        return Path(library).name if library else "torch path"


# The one place, beside `_api`, that knows names inside a checkout: where its compiled kernel is.
# Older ones build it beside other work unless they are told to wait.
KERNEL = """
import importlib, inspect, json, torchrod
found = None
for name in ("kernel", "fast"):
    try:
        library = importlib.import_module(f"torchrod.{name}").library
    except (ImportError, AttributeError):
        continue
    found = library(**({"wait": True} if "wait" in inspect.signature(library).parameters else {}))
    break
print(json.dumps([torchrod.__file__, None if found is None else found._name]))
"""


# ---- Shapes ----


def _dataset(old: Checkout, folder: Path, name: str, robot: str, samples: int, seed: int, loads: str, tension: str = "") -> Arrays:
    """Shapes of random loads by the OLD command line, with NOISE and without."""
    (folder / f"{name}-robot.toml").write_text(robot, encoding="utf-8")
    spec = f"[dataset]\nsamples = {samples}\nseed = {seed}\nnoise = {NOISE}\n"
    spec += f"[robot]\nfile = '{name}-robot.toml'\n[loads]\n{loads}{tension}"
    (folder / f"{name}.toml").write_text(spec, encoding="utf-8")
    old.run("simulate-dataset", f"{name}.toml", "--out", name, "--workers", "1", folder=folder)
    with np.load(folder / name / "shard-00000.npz") as shard:
        return {key: shard[key] for key in ("s", "positions", "positions_clean", "tension")}


@dataclass(frozen=True)
class Case:
    """What is asked of both checkouts: a command, a robot (TOML), shapes and options.

    loose: the mechanism may differ, so that only the bar in standard deviations holds, not the relative one.
    """

    name: str
    robot: str
    shapes: Arrays
    options: tuple[str, ...] = ()
    command: str = "estimate"
    loose: bool = False

    def write(self, folder: Path) -> list[str]:
        """Its files; the two that the command is given."""
        names = [f"{self.name}.robot.toml", f"{self.name}.shapes.npz"]
        (folder / names[0]).write_text(self.robot, encoding="utf-8")
        np.savez(folder / names[1], **self.shapes)  # pyright: ignore[reportArgumentType]
        return names


def _shapes(
    data: Arrays, key: str = "positions", positions: np.ndarray | None = None, tensions: np.ndarray | None = None
) -> Arrays:
    """SHAPES.npz of a data set, or of these positions and tensions at its markers."""
    tensions = data["tension"] if tensions is None else tensions
    shapes = {"s": data["s"], "positions": data[key] if positions is None else positions}
    return shapes | ({"tensions": tensions} if tensions.shape[1] else {})


def cases(old: Checkout, folder: Path) -> Iterator[Case]:
    """The cases, one after the other: the steel rod of Study 1, and a robot of three tendons with weight."""
    random = np.random.default_rng(SEED)
    tendons = TENDONS.format(mass=0.15)
    one = _dataset(old, folder, "one", ROD, 100, SEED, PUSH)
    yield Case("study 1, clean", ROD, _shapes(one, "positions_clean"), ("--noise", "1e-4", "--load-prior", "point"))
    yield Case("study 1, 1 mm", ROD, _shapes(one))
    yield Case("study 1, cold", ROD, _shapes(one), ("--warm-start", "off"))
    yield Case("width unknown", ROD, _shapes(one), ("--load-prior", "none"))
    yield Case("noise auto", ROD, _shapes(one), ("--noise", "auto"))
    yield Case("location known", ROD, _shapes(one), ("--location", "0.25"))
    wide = _dataset(old, folder, "wide", ROD, 100, SEED + 1, WIDE)
    yield Case("wide, 0.05 to 5 N", ROD, _shapes(wide), ("--load-prior", "distributed"))
    yield Case("width auto", ROD, _shapes(wide), ("--load-prior", "auto"))
    two = _dataset(old, folder, "two", ROD, 100, SEED + 2, "contacts = 2\nmin_gap = 0.2\n" + PUSH)
    yield Case("two contacts", ROD, _shapes(two), ("--contacts", "2"))
    none = _dataset(old, folder, "none", ROD, 20, SEED + 3, NOTHING)
    mixed = np.concatenate([none["positions"], one["positions"][:20], two["positions"][:20]])
    yield Case("contacts auto", ROD, _shapes(none, positions=mixed, tensions=mixed[:, :0, 0]), ("--contacts", "auto"))
    yield Case("unknown tip", ROD, _shapes(one), ("--unknown-tip", "force"))
    outliers = one["positions"].copy()
    for sample in outliers:
        for i in random.choice(len(sample), 2, replace=False):
            way = random.standard_normal(3)
            sample[i] += 0.05 * way / np.linalg.norm(way)
    yield Case("robust, outliers", ROD, _shapes(one, positions=outliers), ("--robust",))
    lost = one["positions"].copy()
    lost[random.random(lost.shape[:2]) < 0.3] = np.nan
    yield Case("missing markers", ROD, _shapes(one, positions=lost))
    off = Rotation.from_rotvec([0.02, -0.03, 0.04]).apply(one["positions"].reshape(-1, 3)).reshape(one["positions"].shape)
    off += [3e-3, -4e-3, 2e-3]
    yield Case("registration", ROD, _shapes(one, positions=off), ("--registration",))
    ten = _shapes(one, positions=off[:20], tensions=one["tension"][:20])
    yield Case("one frame", ROD, ten, ("--registration", "--one-frame"), loose=True)
    pulled = _dataset(old, folder, "tendons", tendons, 100, SEED + 4, PUSH, TENSION)
    yield Case("tendons, gravity", tendons, _shapes(pulled))
    read = np.maximum(pulled["tension"] + 0.2 * random.standard_normal(pulled["tension"].shape), 0.0)
    yield Case("tension std", tendons, _shapes(pulled, tensions=read), ("--tension-std", "0.2"))
    unloaded = _dataset(old, folder, "unloaded", tendons, 40, SEED + 5, NOTHING, TENSION)
    start = TENDONS.format(mass=0.1)
    yield Case("calibrate", start, _shapes(unloaded), (), "calibrate", loose=True)
    all_of_it = ("--youngs-modulus", "--tension-offset")
    yield Case("calibrate, all", start, _shapes(unloaded), all_of_it, "calibrate", loose=True)


# ---- Answers ----


@dataclass
class Difference:
    """The largest differences of one case: relative, by kind; in standard deviations; and samples that tell another story."""

    name: str
    loose: bool
    relative: dict[str, float] = field(default_factory=dict)
    in_std: float = 0.0
    samples: int = 0
    differ: dict[str, int] = field(default_factory=dict)

    def number(self, kind: str, old: Any, new: Any, least: float = 0.0) -> None:
        """Vectors by their norms: |new - old| / max(|old|, least); a number that only one of them knows is infinitely off."""
        a, b = (np.array(v, dtype=float).ravel() for v in (old, new))
        if a.shape != b.shape or (np.isnan(a) != np.isnan(b)).any():
            self.relative[kind] = np.inf
            return
        off, size = np.linalg.norm(np.nan_to_num(b - a)), max(float(np.linalg.norm(np.nan_to_num(a))), least)
        self.relative[kind] = max(self.relative.get(kind, 0.0), float(off / size) if off else 0.0)

    def deviation(self, old: Any, new: Any, std: Any) -> None:
        """A number's difference in its standard deviations."""
        if None not in (old, new, std) and new != old:
            self.in_std = max(self.in_std, abs(new - old) / std if std else np.inf)

    def story(self, old: dict[str, Any], new: dict[str, Any]) -> None:
        """Count what differs in words or whole numbers."""
        for key in ("status", "accepted", "iterations"):
            self.differ[key] = self.differ.get(key, 0) + (old[key] != new[key])

    def failure(self, tolerance: float, of_std: float) -> bool:
        """Whether it is more than is allowed. Numbers of iterations are told and not judged."""
        worst = self.in_std > of_std if self.loose else max(self.relative.values(), default=0.0) > tolerance
        return (
            worst or any(not np.isfinite(v) for v in self.relative.values()) or self.differ["status"] + self.differ["accepted"] > 0
        )


def _load(found: Difference, old: dict[str, Any], new: dict[str, Any]) -> None:
    for kind, key in (("force", "force_local_N"), ("location", "location_m"), ("width", "width_m")):
        found.number(kind, old[key], new[key])
    for key in ("magnitude_N", "location_m"):
        found.number("intervals", old["interval_95"][key], new["interval_95"][key])
        found.number("intervals", old["std"][key], new["std"][key])
        found.deviation(old[key], new[key], old["std"][key])


# Beside the loads: what a record may hold, and its size below which a difference counts as absolute.
BESIDE = {
    ("tip", "force_N"): 1e-3,
    ("tip", "moment_Nm"): 1e-4,
    ("registration", "translation_m"): 1e-4,
    ("registration", "rotation_rad"): 1e-3,
    ("noise", "noise_m"): 0.0,
    ("tensions", "tension_N"): 1e-2,
}


def compared(case: Case, old: dict[str, Any], new: dict[str, Any]) -> Difference:
    """The differences of two RESULT.json, or of two CALIBRATION.json."""
    found = Difference(case.name, case.loose)
    if case.command == "calibrate":
        found.samples = 1
        found.story(old, new)
        found.number("chi2", old["chi2"], new["chi2"], 1.0)
        for a, b in zip(old["parameters"], new["parameters"], strict=True):
            found.number("parameters", a["after"], b["after"], 0.0 if "offset" not in a["name"] else 1e-2)
            found.number("intervals", a["std"], b["std"])
            found.deviation(a["after"], b["after"], a["std"])
        return found
    found.samples = len(old["results"])
    for a, b in zip(old["results"], new["results"], strict=True):
        found.story(a, b)
        found.number("chi2", a["chi2"], b["chi2"], 1.0)
        for key in ("force_N", "moment_Nm"):
            found.number("base wrench", a["base_wrench"][key], b["base_wrench"][key], 1e-6)
        if len(a["loads"]) != len(b["loads"]):
            found.relative["force"] = np.inf
        for x, y in zip(a["loads"], b["loads"], strict=False):
            _load(found, x, y)
        for (table, key), least in BESIDE.items():
            if table in a or table in b:
                found.number("beside", a.get(table, {}).get(key), b.get(table, {}).get(key), least)
    return found


KINDS = ("force", "location", "width", "parameters", "intervals", "base wrench", "chi2", "beside")


def answers(old: Checkout, new: Checkout, folder: Path, only: str, say: Callable[[str], None]) -> list[Difference]:
    """Every case by both."""
    found = []
    for case in cases(old, folder):
        if only not in case.name:
            continue
        files, content = case.write(folder), []
        out = "--json" if case.command == "calibrate" else "--out"
        for checkout in (old, new):
            result = f"{case.name}.{checkout.label}.json"
            checkout.run(case.command, *files, *case.options, out, result, folder=folder)
            content.append(json.loads((folder / result).read_text(encoding="utf-8")))
        found.append(compared(case, *content))
        worst = max(found[-1].relative.values(), default=0.0)
        say(f"{case.name}: largest relative difference {worst:.1e}, other status, accepted, iterations {found[-1].differ}")
    return found


def table(found: Sequence[Difference], tolerance: float, of_std: float) -> list[str]:
    """The comparison as Markdown."""
    lines = ["| case | samples | " + " | ".join(KINDS) + " | in std | other status | accepted | iterations | |"]
    lines.append("|" + "---|" * (len(KINDS) + 7))
    for d in found:
        cells = [f"{d.relative[kind]:.1e}" if kind in d.relative else "" for kind in KINDS]
        cells += [f"{d.in_std:.1e}", *map(str, d.differ.values()), "DIFFERS" if d.failure(tolerance, of_std) else "agrees"]
        lines.append(f"| {d.name} | {d.samples} | {' | '.join(cells)} |")
    return lines


# ---- Speed ----


def _api(robot: str) -> tuple[Callable[..., object], Callable[[], Callable[[np.ndarray], object]], Any]:
    """The only function that knows the Python names of a checkout.

    estimate(s, positions, noise, **settings), follow() -> frame(positions), and s as a float32 tensor.
    """
    import torch

    import torchrod as tr

    here: Any = tr  # the names differ from checkout to checkout
    read = here.read_robot(robot)
    load = here.GaussianCoordinates(1, read.rod.length, read.rod.force_scale, "contact")
    s = torch.linspace(0.02, 0.4, 20)
    if hasattr(here, "Problem"):
        unknowns = here.Unknowns(load)

        def estimate(s: Any, positions: np.ndarray, noise: float, **settings: Any) -> object:
            markers = here.Markers(s, torch.from_numpy(positions), noise)
            return here.estimate(here.Problem(read, unknowns, [markers]), here.Settings(**settings))

        def follow() -> Callable[[np.ndarray], object]:
            tracker = here.Tracker(read, unknowns, s.double(), NOISE)
            return lambda positions: tracker(torch.from_numpy(positions))

        return estimate, follow, s
    model = here.Model(read, load)

    def estimate_before(s: Any, positions: np.ndarray, noise: float, **settings: Any) -> object:
        return here.estimate(model, here.Markers(s, torch.from_numpy(positions)), noise, here.Settings(**settings))

    def follow_before() -> Callable[[np.ndarray], object]:
        estimator = here.Estimator(model, s.double(), NOISE)
        return lambda positions: estimator(torch.from_numpy(positions))

    return estimate_before, follow_before, s


# No sample comes near its minimum in so few short steps, so that every one of them takes part in every iteration.
CREEP = {"step_limit": 0.02, "coarse": False, "restarts": ()}
FEW, MORE = 2, 12


def worker(robot: str, data: str) -> dict[str, float]:
    """Seconds of what is timed, in this process: the least of several repeats, as nothing makes a computation faster than it is."""
    import time

    estimate, follow, s = _api(robot)
    with np.load(data) as file:
        positions, film = file["positions"], file["film"]

    def least(call: Callable[[], object], repeats: int) -> float:
        call()
        taken = []
        for _ in range(repeats):
            begin = time.perf_counter()
            call()
            taken.append(time.perf_counter() - begin)
        return min(taken)

    found = {}
    for batch, repeats in ((256, 20), (4096, 3)):
        some = np.resize(positions, (batch, *positions.shape[1:]))
        few, more = (
            least(lambda some=some, n=n: estimate(s.double(), some, NOISE, **CREEP, max_iterations=n), repeats) for n in (FEW, MORE)
        )
        found[f"iteration, batch {batch}"] = (more - few) / (MORE - FEW)
        found[f"whole estimate, batch {batch}"] = least(lambda some=some: estimate(s.double(), some, NOISE), repeats)
    found["one shape"] = least(lambda: estimate(s.double(), positions[:1], NOISE), 40)
    found["one shape, s float32"] = least(lambda: estimate(s, positions[:1], NOISE), 40)
    frame, taken = follow(), []
    for seen in film:
        begin = time.perf_counter()
        frame(seen)
        taken.append(time.perf_counter() - begin)
    found["frame of a film, median"] = float(np.median(taken[5:]))
    return found


def _timed_commands(checkout: Checkout, folder: Path) -> dict[str, float]:
    import time

    example = Path(__file__).resolve().parents[1] / "docs" / "example"
    commands = {
        "torchrod --help": ["--help"],
        "torchrod estimate, docs/example/rod.csv": ["estimate", str(example / "rod.toml"), str(example / "rod.csv")],
        "torchrod estimate, 256 shapes": ["estimate", "timed-robot.toml", "many.npz", "--out", "many-out.npz"],
    }
    found = {}
    for name, arguments in commands.items():
        begin = time.perf_counter()
        checkout.run(*arguments, folder=folder, threads=None)
        found[name] = time.perf_counter() - begin
    return found


def speed(old: Checkout, new: Checkout, folder: Path, rounds: int, say: Callable[[str], None]) -> dict[str, dict[str, list[float]]]:
    """Seconds by what is timed and by checkout, one per round; the checkout that goes first changes from round to round."""
    one = _dataset(old, folder, "timed", ROD, 256, SEED, PUSH)
    random, end = np.random.default_rng(SEED), one["positions_clean"][:2]
    share = np.linspace(0, 1, 60)[:, None, None]
    film = (1 - share) * end[0] + share * (0.9 * end[0] + 0.1 * end[1]) + NOISE * random.standard_normal((60, *end[0].shape))
    np.savez(folder / "speed.npz", positions=one["positions"], film=film)
    np.savez(folder / "many.npz", s=one["s"], positions=one["positions"])
    found: dict[str, dict[str, list[float]]] = {}
    for i in range(rounds):
        for checkout in (old, new) if i % 2 == 0 else (new, old):
            say(f"speed, round {i + 1} of {rounds}, {checkout.label}")
            script = [str(Path(__file__).resolve()), "--worker", "timed-robot.toml", "speed.npz"]
            taken = _timed_commands(checkout, folder) | json.loads(checkout.run(*script, folder=folder, module=False, threads=None))
            for name, seconds in taken.items():
                found.setdefault(name, {}).setdefault(checkout.label, []).append(seconds)
    return found


def speed_table(found: dict[str, dict[str, list[float]]]) -> list[str]:
    """Seconds and ratios NEW / OLD of the rounds as Markdown."""
    lines = ["| timed | OLD (ms, median) | NEW (ms, median) | NEW / OLD: min | median | max |", "|" + "---|" * 6]
    for name, taken in found.items():
        old, new = (np.array(taken[label]) for label in ("old", "new"))
        ratio = new / old
        cells = [f"{1e3 * np.median(old):.3g}", f"{1e3 * np.median(new):.3g}"]
        lines.append(f"| {name} | {' | '.join(cells)} | {ratio.min():.2f} | {np.median(ratio):.2f} | {ratio.max():.2f} |")
    return lines


# ---- The command ----


def main() -> int:
    """Compare, write, and say whether they agree."""
    if sys.argv[1:2] == ["--worker"]:
        print(json.dumps(worker(*sys.argv[2:])))
        return 0
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--tolerance", type=float, default=1e-9, help="largest relative difference (1e-9)")
    parser.add_argument("--of-std", type=float, default=1e-3, help="of one frame and calibrate: in standard deviations (1e-3)")
    parser.add_argument("--only", default="", help="only cases whose name has this in it")
    parser.add_argument("--speed", action="store_true", help="time both, too")
    parser.add_argument("--rounds", type=int, default=5, help="of --speed (5)")
    parser.add_argument("--no-answers", action="store_true", help="only --speed")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder of compare.md and compare.json (out)")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)

    def say(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        old, new = (Checkout.of(label, getattr(options, label).resolve(), folder) for label in ("old", "new"))
        lines, content = ["# Two checkouts", ""], {}
        for checkout in (old, new):
            serves = checkout.prepare(folder)
            say(f"{checkout.label}: {getattr(options, checkout.label)}, {serves}")
            lines.append(f"{checkout.label.upper()}: {'the kernel' if serves != 'torch path' else serves}.")
        differences = [] if options.no_answers else answers(old, new, folder, options.only, say)
        failed = [d.name for d in differences if d.failure(options.tolerance, options.of_std)]
        if differences:
            lines += ["", "Largest relative differences (vectors by their norms; chi2 relative to 1 at least). Agreement: "]
            lines[-1] += f"{options.tolerance:g}, or, of one frame and calibrate, {options.of_std:g} standard deviations; "
            lines[-1] += "the same status and `accepted` in every sample. Numbers of iterations are told and not judged."
            lines += ["", *table(differences, options.tolerance, options.of_std)]
            content["answers"] = [vars(d) for d in differences]
        if options.speed:
            content["speed"] = speed(old, new, folder, options.rounds, say)
            lines += ["", f"{options.rounds} rounds, OLD and NEW in turn.", "", *speed_table(content["speed"])]
    (options.out / "compare.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (options.out / "compare.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    print("\n".join(lines))
    print(f"\n{len(failed)} of {len(differences)} cases differ{': ' + ', '.join(failed) if failed else ''}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
