"""How often --contacts auto finds the right loads: python scripts/contacts.py [--samples N] [--out DIR] writes DIR/contacts.md.

The paper's steel rod, pushes of 0.5 to 2 N at 10 to 39 cm, several of them at least 8 cm apart, 1 mm noise unless said: how
many contacts; a contact or something at the tip (--unknown-tip); a contact or a distributed load (--load-prior auto).
"""

import argparse
import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from studies.reproduction.cases import L, steel_rod
from torchrod import (
    GaussianCoordinates,
    Hypothesis,
    Markers,
    PointForces,
    PointWrenches,
    Problem,
    Unknowns,
    solve_shape,
)
from torchrod.analysis.averaging import Averaged, average
from torchrod.analysis.count import selection
from torchrod.analysis.pipeline import learned_or_cold
from torchrod.mechanics.loads import Load

ROBOT = steel_rod()
NOISE, GAP, MOST = 1e-3, 0.08, 3
# Markers, noise (m), gap (m), and percent right that we ask for, for 0, 1, 2 .. contacts.
ASKED = ((20, NOISE, GAP, (97, 97, 95)), (8, NOISE, GAP, (97, 97, 92)), (20, 4e-4, 0.06, (99, 98, 97, 90)))

FALSE_ALARMS = (0.01, 0.02, 0.03, 0.05, 0.1)


@dataclass(frozen=True)
class Truth:
    """So many contacts, point forces or, of a named width, distributed; and perhaps a dead force of the same size at the tip."""

    contacts: int
    width: str = "point"
    tip: bool = False


def _uniform(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.rand(*shape, generator=generator, dtype=torch.float64)


def _loads(truth: Truth, samples: int, generator: torch.Generator, gap: float) -> tuple[Load, ...]:
    place = (0.1 + 0.29 * _uniform(generator, 20 * samples, truth.contacts)).sort(-1).values
    place = place[(place.diff(dim=-1) >= gap).all(-1)][:samples]
    size = 0.5 + 1.5 * _uniform(generator, samples, truth.contacts)
    angle = 2 * math.pi * _uniform(generator, samples, truth.contacts)
    force = torch.stack([size * angle.cos(), size * angle.sin()], -1)
    loads: tuple[Load, ...] = ()
    if truth.contacts and truth.width == "point":
        loads = (PointForces(torch.nn.functional.pad(force, (0, 1)), place),)
    elif truth.contacts:
        as_such = GaussianCoordinates(truth.contacts, L, ROBOT.rod.force_scale, truth.width)
        width = as_such.start().unflatten(0, (truth.contacts, 4))[:, 3].expand(samples, -1)
        gamma = torch.cat([force / ROBOT.rod.force_scale, torch.stack([torch.logit(place / L), width], -1)], -1)
        loads = as_such.loads(gamma.flatten(1))
    if truth.tip:
        way = torch.randn(samples, 3, generator=generator, dtype=torch.float64)
        push = (0.5 + 1.5 * _uniform(generator, samples, 1)) * way / way.norm(dim=-1, keepdim=True)
        loads = (
            *loads,
            PointWrenches(push.unsqueeze(1), torch.zeros_like(push).unsqueeze(1), torch.tensor([L], dtype=torch.float64)),
        )
    return loads


def cases(
    truth: Truth, markers: int, samples: int, seed: int, noise: float = NOISE, gap: float = GAP, exact: bool = False
) -> tuple[Markers, Tensor]:
    """Markers of random loads, with noise or, `exact`, only said to have it; what the loads come to (N, base frame)."""
    generator = torch.Generator().manual_seed(seed)
    s = torch.linspace(L / markers, L, markers, dtype=torch.float64)
    rod = solve_shape(ROBOT, _loads(truth, samples, generator, gap), None, s, samples, 80)
    drawn = torch.randn(rod.p.shape, generator=generator, dtype=torch.float64)
    return Markers(s, rod.p if exact else rod.p + noise * drawn, noise), rod.base_wrench[:, :3]


def _hypothesis(name: str, contacts: int, prior: str = "contact", tip: str = "none") -> Hypothesis:
    return Hypothesis(name, contacts, Unknowns(GaussianCoordinates(contacts, L, ROBOT.rod.force_scale, prior), tip))


COUNTS = [_hypothesis(str(k), k) for k in range(MOST + 1)]
TIPS = [_hypothesis(f"{k}{' + tip' * (tip != 'none')}", k, tip=tip) for k in range(MOST + 1) for tip in ("none", "force")]
WIDTHS = [
    _hypothesis(f"{k} {prior}" if k else "0", k, prior)
    for k in range(MOST + 1)
    for prior in (("contact", "distributed") if k else ("contact",))
]


def averaged(hypotheses: list[Hypothesis], markers: Markers) -> Averaged:
    """What the analysis of samples comes to."""

    def bar(total: int, what: str) -> AbstractContextManager[tqdm]:
        return tqdm(total=total, desc=what, delay=1.0, leave=False)

    problem = Problem(ROBOT, hypotheses[0].unknowns, [markers])
    found = selection(problem, hypotheses, start=learned_or_cold, bar=bar, thorough=True)
    return average(problem, hypotheses, found, bar=bar)


def chosen(hypotheses: list[Hypothesis], truth: Truth, seed: int, samples: int, noise: float) -> list[int]:
    """How many samples chose each hypothesis."""
    markers, _ = cases(truth, 20, samples, seed, noise)
    return torch.bincount(averaged(hypotheses, markers).evidence.choice, minlength=len(hypotheses)).tolist()


def _share(held: Tensor) -> str:
    return f"{100 * float(held.double().mean()):.0f} % of {len(held)}" if len(held) else "-"


def _row(*cells: object) -> str:
    row = "| " + " | ".join(map(str, cells)) + " |"
    print(row, flush=True)
    return row


def counts(samples: int) -> list[str]:
    """The confusion matrices of the number of contacts."""
    head = (
        "| markers, noise, gap | true | chosen 0 | 1 | 2 | 3 | right | asked for | resultant held, fewer told | right number told |"
    )
    lines = [head, "|" + "---|" * 10]
    for markers, noise, gap, asked in ASKED:
        for contacts, least in enumerate(asked):
            read, resultant = cases(Truth(contacts), markers, samples, 100 * markers + contacts, noise, gap)
            result = averaged(COUNTS, read)
            choice, interval = result.evidence.choice, result.intervals.resultant[:, 3]
            size, found = resultant.norm(dim=-1), torch.bincount(choice, minlength=MOST + 1).tolist()
            held = (interval[:, 0] <= size) & (size <= interval[:, 1])
            shares = [_share(held[choice < contacts]), _share(held[choice == contacts]) if contacts else "-"]
            of = f"{markers}, {1e3 * noise:g} mm, {1e3 * gap:g} mm"
            lines.append(_row(of, contacts, *found, f"{100 * found[contacts] / samples:.1f} %", f"{least} %", *shares))
    return lines


def told_apart(samples: int) -> list[str]:
    """How often any test at all tells three pushes from two, however the loads are distributed.

    Even one that is told both shapes, that of three pushes and the nearest of two, lambda = |p_3 - p_2|^2 / noise^2 apart, has the
    power Phi(lambda^(1/2) + Phi^-1(alpha)) at a false alarm rate alpha (Neyman & Pearson 1933).
    """
    markers, noise, gap, _ = ASKED[-1]
    exact, _ = cases(Truth(3), markers, samples, 100 * markers + 3, noise, gap, exact=True)
    problem = Problem(ROBOT, COUNTS[0].unknowns, [exact])
    nearest = selection(problem, COUNTS[:3], start=learned_or_cold).fit
    apart = (nearest.row_residual.square().sum(-1) / noise**2).sqrt()
    alarms = torch.tensor(FALSE_ALARMS, dtype=torch.float64)
    power = torch.special.ndtr(apart.unsqueeze(-1) + torch.special.ndtri(alarms)).mean(0)
    lines = [_row("two told as three", *(f"{100 * a:g} %" for a in FALSE_ALARMS)), "|" + "---|" * (len(FALSE_ALARMS) + 1)]
    return [*lines, _row("three told as three, at most", *(f"{100 * p:.1f} %" for p in power.tolist()))]


def _shares(rows: Sequence[tuple[str, str, list[int]]], names: list[str], samples: int, true: str) -> list[str]:
    """A table of shares: what is true, its hypothesis, and how many chose each; columns that nobody chose are left out."""
    shown = [i for i in range(len(names)) if any(found[i] for _, _, found in rows)]
    lines = [_row(true, *(names[i] for i in shown), "right"), "|" + "---|" * (len(shown) + 2)]
    for what, name, found in rows:
        cells = [f"{100 * found[i] / samples:.1f} %" for i in shown]
        lines.append(_row(what, *cells, f"{100 * found[names.index(name)] / samples:.1f} %"))
    return lines


def tips(samples: int) -> list[str]:
    """A contact, or something at the tip?"""
    rows = []
    for i, (what, name, truth) in enumerate(
        (
            ("nothing", "0", Truth(0)),
            ("a force at the tip", "0 + tip", Truth(0, tip=True)),
            ("one contact", "1", Truth(1)),
            ("one contact, and a force at the tip", "1 + tip", Truth(1, tip=True)),
        )
    ):
        rows += [(f"{what}, {1e3 * noise:g} mm", name, chosen(TIPS, truth, 5000 + i, samples, noise)) for noise in (1e-3, 2e-4)]
    return _shares(rows, [h.name for h in TIPS], samples, "true, noise")


def widths(samples: int) -> list[str]:
    """A contact, or a distributed load?"""
    rows = []
    for i, (what, name, truth) in enumerate(
        (
            ("one contact, sigma 10 mm", "1 contact", Truth(1, "contact")),
            ("one distributed load, sigma 100 mm", "1 distributed", Truth(1, "distributed")),
        )
    ):
        rows += [
            (f"{what}, {1e3 * noise:g} mm", name, chosen(WIDTHS, truth, 6000 + i, samples, noise)) for noise in (1e-3, 2e-4, 5e-5)
        ]
    return _shares(rows, [h.name for h in WIDTHS], samples, "true, noise")


def main() -> None:
    """Write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=300)
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[2] / "docs")
    options = parser.parse_args()
    lines = ["# How many contacts", "", "Made by `python scripts/contacts.py`: `--contacts auto` with the contact prior."]
    lines += [
        f"{options.samples} cases a row; pushes of 0.5 to 2 N at 100 to 390 mm of the 400 mm steel rod, several at least so far"
    ]
    lines += ["apart; the choice by probabilities, as up to 1,000 samples have it.", "", *counts(options.samples), ""]
    lines += [
        "Three pushes at 0.4 mm often bend the rod nearly as two do. What the best of tests can do, one that is told both shapes",
        "and only has to say which of them it sees:",
        "",
        *told_apart(options.samples),
        "",
    ]
    lines += [
        "## Something at the tip",
        "",
        "The same with `--unknown-tip force`: forces at the tip of 0.5 to 2 N in any direction, 20 markers.",
    ]
    lines += ["", *tips(options.samples), ""]
    lines += ["## A contact or a distributed load", "", "The same with `--load-prior auto`, one load, 20 markers."]
    lines += ["", *widths(options.samples), ""]
    (options.out / "contacts.md").write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")
