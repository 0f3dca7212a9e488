"""The page docs/warm_start.md and its figure, from the figures of the run."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from .measure import FURTHER, REPEATS, RESAMPLES, STARTS, TIMED_BATCH, WORSE

TIME_TELLS = 1.1  # smaller ratios of time are noise
ROOT = Path(__file__).resolve().parents[3]
COLOURS = {"cold": "#1b2a41", "warm": "#c8102e", "oracle": "#0a7f8c"}
MARKS = {"cold": "o", "warm": "D", "oracle": "s"}
LABELS = {"cold": "cold: no load", "warm": "warm: the network's guess", "oracle": "oracle: the true load"}

INTRO = """# The warm start

Made by `python scripts/ablation.py{options}`: every figure below is computed when the command runs.

A small network looks at the markers and guesses the loads; a forward solve fills in the base wrench, and the filter starts
there instead of from no load. The guess cannot do much harm: it is used only where it lies nearer to the data than a cold
start, and a fit from it that is not accepted is followed by a cold start (`iterations` counts both). The answer is a minimum
of the same cost, so what changes is the way there. `torchrod.find_warm_start(problem)` picks the checkpoint that serves a robot
and its number of loads, or none: then the start is cold.
"""
METHOD = """
The same cases are fitted from three starts. *Cold*: no load. *Warm*: the checkpoint. *Oracle*: the true load with the prior's
width and the base wrench of its equilibrium (Study 2, whose loads three Gaussians cannot be: the fit to markers without noise).
Iterations are evaluations of the model and its Jacobian, of all attempts and samples, whether they converged or not. The check
of a guess takes no evaluation of the model, because the forward solves have told the shapes; they are in the times. Brackets hold
95 % intervals: {resamples} bootstrap resamples of the cases, the starts paired (of the shapes for `reference`, where a shape is
used with several draws of noise).
"""


def cards(folder: Path) -> list[str]:
    """A table of the checkpoints, from their cards."""
    files = sorted(folder.glob("*.json"))
    if not files:
        return ["No checkpoint is present, so every warm start below is cold."]
    lines = ["| checkpoint | loads | width priors | robots | trained on |", "|---|---|---|---|---|"]
    return lines + [_card(json.loads(file.read_text(encoding="utf-8"))) for file in files]


def _card(card: dict[str, Any]) -> str:
    """One row: whom a checkpoint serves, and what it has seen. Forces in 4 EI / L^2, noise in L."""
    recipe, seen = card["recipe"], card["range"]["markers_seen"]
    robots = f"{card['tendons'][0]} to {card['tendons'][1]} tendons, weight" if card["active"] else "no tendons, no weight"
    force = f"{recipe['force'][0]:g} to {recipe['force'][1]:g} x 4 EI / L^2" + (" per L" if recipe["load"] == "smooth" else "")
    noise = f"noise {recipe['noise'][0]:g} to {recipe['noise'][1]:g} L"
    trained = f"{card['cases']:,} cases, {force}, {noise}, {seen[0]} to {seen[1]} markers"
    return f"| `{card['name']}` | {card['contacts']} ({recipe['load']}) | {', '.join(card['load_priors'])} | {robots} | {trained} |"


def bracket(value: float, bounds: list[float], scale: float = 1.0, digits: str = ".2f") -> str:
    """A value with its interval."""
    return f"{scale * value:{digits}} [{scale * bounds[0]:{digits}}, {scale * bounds[1]:{digits}}]"


def verdict(figures: dict[str, Any]) -> str:
    """Whether the bar of warm / cold is met, said plainly."""
    bar, ratio = figures["bar"], figures["ratio"]
    if bar is None:
        return "no bar"
    if ratio["warm_cold"] > bar:
        return f"**missed** (<= {bar:g})"
    sure = ratio["warm_cold_95"][1] <= bar
    return f"pass (<= {bar:g})" if sure else f"pass (<= {bar:g}), though the interval reaches beyond"


def iteration_table(data: dict[str, Any]) -> list[str]:
    """Iterations by start, and their ratios."""
    lines = [
        "| case | samples | warm started | cold | warm | oracle | warm / cold | bar | warm / oracle |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, f in data.items():
        counts = [
            f"{r['iterations_mean']:.2f} ({r['iterations_median']:.0f}, {r['iterations_95']:.0f})" for r in (f[s] for s in STARTS)
        ]
        r = f["ratio"]
        cells = [f"{f['title']} (`{name}`)", str(f["cases"]), f"{100 * f['warm']['warm_started']:.1f} %", *counts]
        cells += [bracket(r["warm_cold"], r["warm_cold_95"]), verdict(f), bracket(r["warm_oracle"], r["warm_oracle_95"])]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _counts(row: dict[str, Any]) -> str:
    return f"{row['iterations_mean']:.2f} ({row['iterations_median']:.0f}, {row['iterations_95']:.0f})"


def outcome_table(data: dict[str, Any]) -> list[str]:
    """What comes out: accepted, errors, cost."""
    lines = [
        "| case | converged | accepted | accepted, warm - cold (%) | location (mm) | warm - cold (mm) | force (N) |"
        " warm - cold (N) | dearer | cheaper |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, f in data.items():
        shares = [" / ".join(f"{100 * f[s][key]:.1f}" for s in STARTS) + " %" for key in ("converged", "accepted")]
        location = " / ".join(f"{1e3 * f[s]['location_m_mean']:.2f}" for s in STARTS)
        force = " / ".join(f"{f[s]['force_N_mean']:.4f}" for s in STARTS)
        d = f["difference"]
        cells = [f"`{name}`", *shares, bracket(d["accepted"], d["accepted_95"], 100.0, "+.1f")]
        cells += [location, bracket(d["location_m"], d["location_m_95"], 1e3, "+.3f")]
        cells += [force, bracket(d["force_N"], d["force_N_95"], 1.0, "+.5f")]
        cells += [f"{100 * f['worse']:.1f} %", f"{100 * f['better']:.1f} %"]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def cost_table(data: dict[str, Any]) -> list[str]:
    """The check of the convergence test, and times."""
    lines = [
        "| case | left to gain, cold | left to gain, warm | guess and check (ms) | reading in it (ms) | forward solve (ms) |"
        " cold start (ms) | one iteration (ms) | network and check (iterations) | all the guess adds | whole batch (s) |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, f in data.items():
        left = [_left(f["convergence"][s]) for s in ("cold", "warm")]
        t = f["time"]
        cells = [f"`{name}`", *left, *[f"{1e3 * t[k]:.1f}" for k in ("start_s", "read_s", "solve_s", "cold_s", "iteration_s")]]
        cells += [f"{_network(f):.2f}", f"{(t['start_s'] - t['cold_s']) / t['iteration_s']:.2f}"]
        cells.append(" / ".join(f"{f[s]['cpu_s']:.2f}" for s in STARTS))
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _network(figures: dict[str, Any]) -> float:
    """Network and check, the reading and the forward solve left out, in iterations."""
    return figures["time"]["network_s"] / figures["time"]["iteration_s"]


def _left(figures: dict[str, float | None]) -> str:
    return " / ".join("-" if value is None else f"{value:.4f}" for value in figures.values())


def _named(data: dict[str, Any], chosen: Callable[[dict[str, Any]], bool], note: Callable[[dict[str, Any]], str]) -> str:
    """The cases of which something holds, with a note on each, or none."""
    return ", ".join(f"`{name}`{note(figures)}" for name, figures in data.items() if chosen(figures)) or "none"


def _silent(_: dict[str, Any]) -> str:
    return ""


def _gap(f: dict[str, Any]) -> str:
    return f" ({100 * f['worse']:.1f} %, the largest by {f['above_max']:.2g})"


def _times(f: dict[str, Any]) -> str:
    return f" ({_slower(f):.2f} times)"


def _slower(f: dict[str, Any]) -> float:
    return f["warm"]["cpu_s"] / f["cold"]["cpu_s"]


def _share(key: str) -> Callable[[dict[str, Any]], str]:
    """How much an error changes, over the cold start's mean error; and where both starts end in one minimum, if not all do."""

    def note(f: dict[str, Any]) -> str:
        whole, same = (100 * f[which][key] / f["cold"][f"{key}_mean"] for which in ("difference", "same_minimum"))
        of_same = "" if f["same_minimum"]["share"] == 1 else f"; {same:+.2f} % where both end in the same minimum"
        return f" ({whole:+.2f} %{of_same})"

    return note


def findings(data: dict[str, Any]) -> list[str]:
    """What the tables say, in sentences computed from them."""

    def below_zero(key: str) -> Callable[[dict[str, Any]], bool]:
        return lambda f: f["difference"][f"{key}_95"][1] < 0

    def above_zero(key: str) -> Callable[[dict[str, Any]], bool]:
        return lambda f: f["difference"][f"{key}_95"][0] > 0

    def open_ended(which: str) -> Callable[[dict[str, Any]], bool]:
        return lambda f: any((c[which] or 0.0) >= WORSE for c in f["convergence"].values())

    found = [
        ("Bars of warm / cold missed", lambda f: f["bar"] is not None and f["ratio"]["warm_cold"] > f["bar"], _silent),
        ("No warm start was used", lambda f: f["warm"]["warm_started"] == 0, _silent),
        ("Warm took longer than cold, with the time of the guess", lambda f: _slower(f) > TIME_TELLS, _times),
        ("Network and check took an iteration or more", lambda f: _network(f) >= 1, _silent),
        ("Fewer iterations than the oracle*", lambda f: f["ratio"]["warm_oracle_95"][1] < 1, _silent),
        ("More iterations than the oracle*", lambda f: f["ratio"]["warm_oracle_95"][0] > 1, _silent),
        ("More iterations than cold*", lambda f: f["ratio"]["warm_cold_95"][0] > 1, _silent),
        ("Warm costs acceptance*", below_zero("accepted"), _silent),
        ("Warm gains acceptance*", above_zero("accepted"), _silent),
        ("Warm is less accurate in location*", above_zero("location_m"), _share("location_m")),
        ("Warm is more accurate in location*", below_zero("location_m"), _share("location_m")),
        ("Warm is less accurate in force*", above_zero("force_N"), _share("force_N")),
        ("Warm is more accurate in force*", below_zero("force_N"), _share("force_N")),
        (f"Some warm fit ends above the cold one by more than {WORSE}", lambda f: f["worse"] > 0, _gap),
        (f"Some converged fit had {WORSE} or more left to gain", open_ended("max"), _silent),
        (f"Some accepted fit had {WORSE} or more left to gain", open_ended("accepted_max"), _silent),
    ]
    return [f"- {what}: {_named(data, holds, note)}." for what, holds, note in found]


OUTCOMES = f"""Cold / warm / oracle. Mean |error|, contacts matched by location; Study 2: centroid of the load, and RMS of the
load carried up to s. Dearer, cheaper: the share of samples whose warm fit ends more than {WORSE} in chi^2 above or below the
cold one.
"""
COSTS = f"""Left to gain: what up to {FURTHER} further Gauss-Newton iterations take off chi^2 of the answers that had converged: the
largest / the 99 % point / the largest of accepted fits. (A fit that cannot explain the data has also converged when it would gain
less than 1e-6 of its chi^2, which may be more than {WORSE}.)

Times: CPU time of one thread, batch of {TIMED_BATCH}, the fastest of nine calls; guess and check: reading the markers, for
which the robot without the load must be known (a cold start), the network, the forward solve under its loads, which is where alpha
comes from, and the cost of both; network and check: timed by themselves. All the guess adds: guess and check less a cold start.
Whole batch, cold / warm / oracle: the fastest of {REPEATS} runs, everything included (the oracle gets its start for nothing).
"""


def page(data: dict[str, Any], options: str) -> str:
    """The whole page."""
    lines = [INTRO.format(options=options), *cards(ROOT / "checkpoints"), METHOD.format(resamples=f"{RESAMPLES:,}")]
    lines += ["![Iterations by case and start](warm_start.png)", "", "## Iterations", ""]
    lines += ["Mean (median, 95 % point). A bar is the largest warm / cold asked for: 0.6 for contacts, 0.5 for tendon robots,"]
    lines += ["0.8 for Study 2, none for the `ood_` cases (stronger loads and a softer rod than any in training; and lost markers,"]
    lines += ["which training has too).", "", *iteration_table(data), ""]
    lines += ["What the tables say. A star: where the whole 95 % interval says so; by chance alone about one in forty would.", ""]
    lines += [*findings(data), "", "## Outcomes", "", OUTCOMES, *outcome_table(data), "", "## Convergence and time", "", COSTS]
    return "\n".join([*lines, *cost_table(data), ""])


def figure(data: dict[str, Any], path: Path) -> None:
    """Mean iterations of every case by start, with 95 % whiskers."""
    rows = list(data.values())
    picture = Figure(figsize=(9, 1.7 + 0.42 * len(rows)), layout="constrained")
    axes = picture.add_subplot()
    for k, f in enumerate(rows):
        if k % 2:
            axes.axhspan(k - 0.5, k + 0.5, color="#f3f4f6", lw=0, zorder=0)
        text = f"{f['ratio']['warm_cold']:.2f}"
        axes.annotate(text, (1.06, k), xycoords=("axes fraction", "data"), va="center", ha="center", fontsize=9)
    for s, offset in zip(STARTS, (-0.2, 0.0, 0.2), strict=True):
        mean = [f[s]["iterations_mean"] for f in rows]
        low = [f[s]["iterations_mean"] - f[s]["iterations_mean_95"][0] for f in rows]
        high = [f[s]["iterations_mean_95"][1] - f[s]["iterations_mean"] for f in rows]
        y = [k + offset for k in range(len(rows))]
        style = {"fmt": MARKS[s], "ms": 5, "color": COLOURS[s], "capsize": 2, "lw": 1.2, "label": LABELS[s], "zorder": 3}
        axes.errorbar(mean, y, xerr=[low, high], **style)
    axes.set_xscale("log")
    most = max(f[s]["iterations_mean_95"][1] for f in rows for s in STARTS)
    ticks = [t for t in (1, 2, 3, 5, 10, 20, 30, 50, 100, 200) if t <= most]
    axes.set_xticks(ticks, [str(t) for t in ticks])
    axes.minorticks_off()
    axes.set_yticks(range(len(rows)), [f["title"] for f in rows])
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlabel("iterations of a fit, all attempts: mean over the cases with 95 % interval (logarithmic)")
    axes.annotate("warm /\ncold", (1.06, 1.01), xycoords="axes fraction", ha="center", va="bottom", fontsize=9)
    axes.grid(axis="x", alpha=0.3)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    picture.legend(loc="outside upper center", ncols=3, frameon=False)
    picture.savefig(path, dpi=150)
