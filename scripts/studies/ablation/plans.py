"""The thirteen case classes: which robots, loads, markers and noise, and how many samples."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from studies.reproduction.cases import L, S, steel_rod
from studies.reproduction.cases import study1 as draw_study1
from studies.reproduction.study2 import Study2
from studies.reproduction.study2 import study2 as draw_study2
from studies.reproduction.twins import MARKERS, one_tendon, two_tendons
from torchrod import GaussianCoordinates, Markers, Problem, Robot, Rod, Tendon, Tendons, Unknowns, cold_start, estimate

from .cases import MM, SEED, Case, Draw, Part, between, contact_part, drawn, log_between, with_noise

TOLD_CLEAN = 1e-4  # m: the noise the estimator is told where none was added
REFERENCE = Path(__file__).resolve().parents[3] / "tests" / "data" / "shape_reference.json"


def study1_part(noise: float, count: int) -> Part:
    """Study 1 of the paper, other draws than in docs/reproduction.md."""
    study = draw_study1(count, SEED)
    markers = Markers(S, with_noise(study.positions, noise, 0, SEED + 1), noise or TOLD_CLEAN)
    return contact_part(study.robot, markers, study.force.unsqueeze(1), study.location.unsqueeze(1))


@cache
def study2_oracle(count: int) -> tuple[Study2, Problem, Tensor]:
    """Study 2, the problem of three Gaussians with markers without noise, and the oracle's x (B, n).

    Three Gaussians cannot be the true load, so the oracle starts from the fit to markers without noise, told 1 mm: the best that
    could be known beforehand. (Told the clean case's 0.1 mm it would be that case's answer.)
    """
    study = draw_study2(count, SEED + 2)
    rod = study.robot.rod
    unknowns = Unknowns(GaussianCoordinates(3, rod.length, rod.force_scale, "distributed"))
    problem = Problem(study.robot, unknowns, [Markers(S, study.positions, MM)])
    return study, problem, estimate(problem, start=cold_start).x


def study2_part(noise: float, count: int) -> Part:
    """Study 2 with three Gaussians."""
    study, problem, oracle = study2_oracle(count)
    markers = Markers(S, with_noise(study.positions, noise, 0, SEED + 3), noise or TOLD_CLEAN)
    return Part(replace(problem, sensors=[markers]), study, oracle)


def nitinol() -> Robot:
    """A thin nitinol rod, 0.25 m, 1 mm: 0.19 N bends it as far as 1 N does the steel rod."""
    return Robot(Rod.circular(0.25, 1e-3, 60e9, 23.08e9))


def silicone() -> Robot:
    """A silicone rod as thick as a tenth of its length, as easy to bend as the steel rod; shear moves its tip by millimetres."""
    return Robot(Rod.circular(L, L / 10, 0.3e6, 0.1e6))


def nitinol_parts(count: int) -> tuple[Part, ...]:
    """12 markers, 0.5 mm and 1 mm noise, half of the samples each."""
    robot, f = nitinol(), nitinol().rod.force_scale
    draws = [Draw(between(0.5 * f, f), between(0.0625, 0.244), noise, markers=12) for noise in (0.5 * MM, MM)]
    return tuple(drawn(robot, draw, count // 2, SEED + 10 * k) for k, draw in enumerate(draws, 1))


def tendon_draw(robot: Robot, strongest: float) -> Draw:
    """0.5 N to the strongest push, beyond a fifth of the length, tensions up to 5 N, eight markers as on the paper's robots."""
    length = robot.rod.length
    return Draw(between(0.5, strongest), between(0.2 * length, length), 0.5 * MM, markers=MARKERS, tension=5.0)


def reference_robot(r: dict[str, Any]) -> Robot:
    """A robot of shape_reference.json; its weight per length (N/m) becomes a mass of 1 kg/m under that gravity."""
    rod = Rod.circular(r["length"], r["diameter"], r["youngs_modulus"], r["shear_modulus"], 1.0 if r["weight"] else 0.0)
    tendons = Tendons(tuple(Tendon.straight(x, y, end) for x, y, end in r["tendons"]))
    return Robot(rod, tendons, torch.tensor(r["weight"] or [0.0] * 3, dtype=torch.float64))


def reference_part(shape: dict[str, Any], draws: int, seed: int) -> Part:
    """One reference shape, `draws` draws of 1 mm noise."""

    def tensor(values: Any) -> Tensor:
        value = torch.tensor(values, dtype=torch.float64)
        return value.expand(draws, *value.shape)

    points = sorted(shape["points"], key=lambda p: p["s"])
    tension = tensor(shape["tensions"]) if shape["tensions"] else None
    markers = Markers(tensor(shape["s"])[0], with_noise(tensor(shape["positions"]), MM, 0, seed), MM)
    force, location = tensor([[p["fx"], p["fy"]] for p in points]), tensor([p["s"] for p in points])
    return contact_part(reference_robot(shape["robot"]), markers, force, location, tension)


def joined(parts: list[Part]) -> list[Part]:
    """Neighbours with the same robot and number of contacts as one part: one batch instead of many."""
    cuts = [0, *(i for i in range(1, len(parts)) if not alike(parts[i - 1], parts[i])), len(parts)]
    return [_cat(parts[a:b]) for a, b in pairwise(cuts)]


def alike(a: Part, b: Part) -> bool:
    """Whether two parts may share a batch."""
    one, two = a.problem.robot, b.problem.robot
    same_rod = one.rod.length == two.rod.length and torch.equal(one.rod.K_bt, two.rod.K_bt)
    return same_rod and len(one.tendons) == len(two.tendons) and a.problem.size == b.problem.size


def _cat(parts: list[Part]) -> Part:
    first = parts[0].problem
    tensions = [p.problem.tension for p in parts if p.problem.tension is not None]
    seen = [markers for p in parts if (markers := p.problem.markers) is not None]
    markers = replace(seen[0], positions=torch.cat([m.positions for m in seen]))
    problem = replace(first, sensors=[markers], tension=torch.cat(tensions) if tensions else None)
    truths = [p.truth for p in parts if isinstance(p.truth, tuple)]
    truth = (torch.cat([t[0] for t in truths]), torch.cat([t[1] for t in truths]))
    return Part(problem, truth, torch.cat([p.oracle for p in parts]))


def reference_parts(draws: int) -> tuple[Part, ...]:
    """The point-loaded shapes of an independent solver: steel and nitinol rods, the paper's tendon robots, two contacts."""
    shapes = [shape for shape in json.loads(REFERENCE.read_text(encoding="utf-8")) if shape["points"]]
    return tuple(joined([reference_part(shape, draws, SEED + 100 + k) for k, shape in enumerate(shapes)]))


STUDY1_PLACE = between(0.1, 0.39)
WIDE_PLACE = between(0.05, 0.4)


def _steel(draw: Draw, seed: int) -> Callable[[int], tuple[Part, ...]]:
    return lambda count: (drawn(steel_rod(), draw, count, SEED + seed),)


def _tendon(robot: Callable[[], Robot], strongest: float, seed: int) -> Callable[[int], tuple[Part, ...]]:
    return lambda count: (drawn(robot(), tendon_draw(robot(), strongest), count, SEED + seed),)


def _soft(count: int) -> tuple[Part, ...]:
    return (drawn(silicone(), Draw(between(0.5, 1.0), STUDY1_PLACE), count, SEED + 80),)


@dataclass(frozen=True)
class Plan:
    """How a case is made: its title, its parts from a count, the bar of warm / cold, how many samples in full and in --quick."""

    title: str
    parts: Callable[[int], tuple[Part, ...]]
    bar: float | None
    count: int = 500
    quick: int = 40
    repeats: bool = False  # the count is of draws of noise, the same loads every time
    outside: bool = False  # of what the checkpoints were trained for


CONTACTS, TENDONS, SMOOTH = 0.6, 0.5, 0.8  # the bars of warm / cold
PLANS = {
    "study1_clean": Plan("Study 1, no noise", lambda n: (study1_part(0.0, n),), CONTACTS),
    "study1_1mm": Plan("Study 1, 1 mm", lambda n: (study1_part(MM, n),), CONTACTS),
    "wide": Plan("0.05-5 N, 5-40 cm", _steel(Draw(log_between(0.05, 5.0), WIDE_PLACE), 20), CONTACTS),
    "two_contacts": Plan("two contacts, 0.5-5 N", _steel(Draw(between(0.5, 5.0), WIDE_PLACE, contacts=2), 30), CONTACTS),
    "study2_clean": Plan("Study 2, no noise", lambda n: (study2_part(0.0, n),), SMOOTH, 500, 16),
    "study2_1mm": Plan("Study 2, 1 mm", lambda n: (study2_part(MM, n),), SMOOTH, 500, 16),
    "nitinol": Plan("nitinol rod, 12 markers", nitinol_parts, CONTACTS),
    "one_tendon": Plan("one tendon, gravity", _tendon(one_tendon, 2.5, 40), TENDONS, 300, 24),
    "two_tendons": Plan("two tendons, gravity", _tendon(two_tendons, 3.5, 50), TENDONS, 300, 24),
    "reference": Plan("another solver's shapes", reference_parts, CONTACTS, 20, 4, True),
    "ood_force": Plan("outside: 5-10 N", _steel(Draw(between(5.0, 10.0), STUDY1_PLACE), 60), None, 200, 16, outside=True),
    "ood_missing": Plan("10 of 20 markers lost", _steel(Draw(between(0.5, 1.0), STUDY1_PLACE, missing=10), 70), None),
    "ood_stiffness": Plan("outside: thick soft rod", _soft, None, outside=True),
}


def make(name: str, quick: bool) -> Case:
    """The case of a name."""
    plan = PLANS[name]
    count = plan.quick if quick else plan.count
    return Case(name, plan.title, plan.parts(count), plan.bar, not plan.outside, count if plan.repeats else 1)
