"""Tables I-III of the paper on its printed rows, as digital twins, and Figure 6: three of the two-tendon cases in space.

tables.csv holds the printed rows: actuation as printed, the measured force and place, and the paper's estimate. `pair` groups the
two loads of a double case. The sign of the actuation is read in two ways: negative is pulled (Table III has only values <= 0, and
its tendons must be pulled), so that the positive values of Table I are a tendon let go; or its size alone, always pulled.
"""

import math
from pathlib import Path
from typing import Any

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.axes3d import Axes3D
from torch import Tensor
from tqdm import tqdm

from torchrod import Estimate, FittedRod, Robot, Status, draw_on

from .printed_rows import READINGS, TEXT, Case, mean_known, paper_means, printed, read_cases
from .twins import DIAMETER, MARKERS, MISMATCH, NOISE, TENSION_STD, Twin, one_tendon, twin, two_tendons

ABOUT = {
    "I": "1-DoF robot, one load",
    "II": "1-DoF robot, two loads",
    "III": "2-DoF robot, one or two loads",
}
MODELS = {"with_mismatch": MISMATCH, "without_mismatch": 0.0}
FIGURE6 = ("1", "4", "7")  # cases of Table III
MEASURED = "#e0a800"


def matched(case: Twin, fit: Estimate) -> tuple[Tensor, Tensor]:
    """Magnitude (B, K) N and location (B, K) m of the estimates in the order of the true loads, both sorted along the rod; NaN
    where the robot has no equilibrium or the fit did not converge.
    """
    rank, order = case.location.argsort(-1).argsort(-1), fit.location.argsort(-1)
    good = (case.solved & (fit.status == Status.CONVERGED)).unsqueeze(-1)
    force, location = (v.gather(1, order).gather(1, rank) for v in (fit.magnitude, fit.location))
    return torch.where(good, force, torch.nan), torch.where(good, location, torch.nan)


def spread(x: Tensor) -> dict[str, float | None]:
    """Median and 5-95 % of those that are numbers; None where none is."""
    if bool(x.isnan().all()):
        return {"median": None, "p5": None, "p95": None}
    low, middle, high = x.nanquantile(x.new_tensor([0.05, 0.5, 0.95])).tolist()
    return {"median": middle, "p5": low, "p95": high}


def found(case: Twin, fit: Estimate, draws: slice, load: int) -> dict[str, Any]:
    """What came of the draws of one row."""
    force, location = (v[draws, load] for v in matched(case, fit))
    error, off = (force - case.force[draws, load].norm(dim=-1)).abs(), (location - case.location[draws, load]).abs()
    none = bool(force.isnan().all())
    return {
        "simulated": float(case.solved[draws].double().mean()),
        "converged": float((case.solved & (fit.status == Status.CONVERGED))[draws].double().mean()),
        "accepted": float(fit.accepted[draws].double().mean()),
        "tension_N_mean": [None if math.isnan(t) else t for t in case.tension[draws].nanmean(0).tolist()],
        "slack": [float(v) for v in (case.tension[draws] <= 0).double().mean(0)],
        "force_N": spread(force),
        "location_m": spread(location),
        "force_error_N_mean": None if none else float(error.nanmean()),
        "location_error_m_mean": None if none else float(off.nanmean()),
    }


Fitted = dict[tuple[str, str, str, str], tuple[Twin, Estimate, slice]]  # by table, pair, reading and model


def fitted(cases: list[Case], draws: int) -> Fitted:
    """Every case under every reading, with and without mismatch: cases of one table and one number of loads go in one batch."""
    batches: dict[tuple[str, int], list[tuple[Case, str]]] = {}
    for case in cases:
        for reading in case.readings:
            batches.setdefault((case.table, len(case.rows)), []).append((case, reading))
    out: Fitted = {}
    for (table, _), members in tqdm(batches.items(), desc="tables", delay=1.0, leave=False):
        robot: Robot = two_tendons() if table == "III" else one_tendon()
        displacement = torch.tensor([case.pulled(reading) for case, reading in members], dtype=torch.float64)
        force, location = (torch.stack([getattr(case, name) for case, _ in members]) for name in ("force", "location"))
        for model, mismatch in MODELS.items():
            done = twin(robot, displacement, force, location, mismatch, draws, 1)
            fit = done.estimate()
            for i, (case, reading) in enumerate(members):
                out[case.table, case.pair, reading, model] = done, fit, slice(i * draws, (i + 1) * draws)
    return out


def run(quick: bool, folder: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """A dictionary for every printed row, and the tables; a quick run has fewer draws."""
    cases, draws = read_cases(), 4 if quick else 50
    fits = fitted(cases, draws)
    rows: list[dict[str, Any]] = []
    for case in cases:
        for load in range(len(case.rows)):
            row = printed(case, load) | {"draws": draws, "readings": {}}
            for reading in READINGS:
                same = reading not in case.readings
                of = "negative_is_pulled" if same else reading
                row["readings"][reading] = {"pulled_m": list(case.pulled(of)), "as_negative_is_pulled": same} | {
                    model: found(*fits[case.table, case.pair, of, model], load) for model in MODELS
                }
            rows.append(row)
    lines = [*_head(draws)]
    for table in ABOUT:
        lines += _table(table, [row for row in rows if row["table"] == table])
    _figure6(fits, folder / "figure6.png")
    lines += [
        "### Figure 6",
        "",
        "Three two-tendon cases of Table III, first draw: measured forces as yellow arrows, the estimated distribution in red,",
        "both",
        "pointing at the backbone. The paper does not say which rows it drew.",
        "",
    ]
    return rows, [*lines, "![Three two-tendon cases with measured and estimated loads](figure6.png)", ""]


def means(rows: list[dict[str, Any]], table: str, reading: str, model: str) -> tuple[float, float]:
    """Mean errors (N, m) of our twins over the printed rows of a table that could be simulated and fitted."""
    of = [row["readings"][reading][model] for row in rows if row["table"] == table]
    force, location = ([x[f"{key}_mean"] for x in of] for key in ("force_error_N", "location_error_m"))
    return mean_known(force), mean_known(location)


def _head(draws: int) -> list[str]:
    return [
        "## Tables I-III on the printed rows, digital twins",
        "",
        "The paper's experiments cannot be repeated here: each printed row is simulated, with the measured load as the truth, and",
        f"estimated from its {MARKERS} markers on the discs. {1e3 * NOISE:g} mm noise, {draws} draws a row, without and with "
        "errors of "
        f"{100 * MISMATCH:g} % (1 sigma)",
        "in stiffness, mass and each tension reading, drawn anew each time. As many contacts are fitted as there are loads, of",
        "point-like",
        f"width, the tensions known to {TENSION_STD:g} N. The paper's estimates are of real robots, whose model errors are",
        "other ones.",
        "",
        "1-DoF robot (Tables I and II): 0.4 m, 1.4 mm steel, one tendon at 7 mm to the last disc, 0.144 kg/m. 2-DoF robot",
        "(Table III):",
        "0.56 m, tendons at 25 mm to the tip and to the disc halfway, 0.252 kg/m. The diameter of its backbone is not printed.",
        "Ours is",
        f"{1e3 * DIAMETER:g} mm: the steel is then 0.039 of the 0.252 kg/m and 13 g are left for each disc (6 g on the 1-DoF "
        "robot, whose "
        "tendon is at",
        "7 mm), the weight turns the tip by 10 degrees, and the largest stroke by 69 degrees for 34 N.",
        "",
        "Actuation as printed (in cm, but only mm is possible). Two readings of its sign: **negative is pulled**, so that",
        "+11.5 and +5",
        "let the tendon go; or **size only**, always pulled. Where they differ, both are given. A tendon is slack where it is",
        "let go, and",
        "where the weight and the load bend the robot further than it is pulled. Not printed and our choice: the tendon of the",
        "gravity",
        "plane runs below the rod, in-plane loads hang down, out-of-plane ones pull sideways, those of Table III in between.",
        "",
    ]


def _table(table: str, rows: list[dict[str, Any]]) -> list[str]:
    lines = [f"### Table {table}: {ABOUT[table]}", ""]
    lines += ["| case | plane | printed (cm), reading | tension (N) | measured | the paper | ours with mismatch | ours without |"]
    lines += ["|---|---|---|---|---|---|---|---|"]
    for row in rows:
        for reading, name in READINGS.items():
            ours = row["readings"][reading]
            if ours["as_negative_is_pulled"]:
                continue
            both = row["readings"]["size_only"]["as_negative_is_pulled"]
            printed_cm = ", ".join(f"{a:g}" for a in row["actuation_printed"])
            cells = [f"{row['pair']}{'ab'[row['load'] - 1] if _doubles(rows, row) else ''}", row["plane"] or "-"]
            cells += [printed_cm if both else f"{printed_cm}: {name}", _tension(ours)]
            cells += [f"{row[f'{who}_N']:.2f} N, {100 * row[f'{who}_m']:.1f} cm" for who in ("measured", "paper")]
            cells += [_ours(ours[model]) for model in MODELS]
            lines.append("| " + " | ".join(cells) + " |")
    lines += ["", "Ours: median (5 to 95 %) of the draws. Mean errors over the rows:", ""]
    lines += ["| | force (N) | location (cm) |", "|---|---|---|"]
    lines += [f"| the paper, in its text | {TEXT[table][0]:.2f} | {100 * TEXT[table][1]:.2f} |"]
    force, location = paper_means(table)
    lines += [f"| the paper, of its printed rows | {force:.3f} | {100 * location:.2f} |"]
    for model in MODELS:
        for reading, name in READINGS.items():
            force, location = means(rows, table, reading, model)
            lines.append(f"| ours, {model.replace('_', ' ')}, {name} | {force:.3f} | {100 * location:.2f} |")
    share = min(r["readings"][reading]["with_mismatch"]["converged"] for r in rows for reading in READINGS)
    return [*lines, "", f"Least share of draws that converged in any row: {100 * share:.0f} %.", ""]


def _doubles(rows: list[dict[str, Any]], row: dict[str, Any]) -> bool:
    return sum(r["pair"] == row["pair"] for r in rows) > 1


def _tension(ours: dict[str, Any]) -> str:
    """Mean of each tendon, or that it is slack, or that there is no equilibrium."""
    row = ours["without_mismatch"]
    if row["simulated"] == 0:
        return "no equilibrium found: not simulated"
    return ", ".join("slack" if slack == 1 else f"{t:.1f}" for t, slack in zip(row["tension_N_mean"], row["slack"], strict=True))


def _ours(row: dict[str, Any]) -> str:
    if row["force_N"]["median"] is None:
        return "not simulated" if row["simulated"] == 0 else "did not converge"
    f, at = row["force_N"], {k: 100 * v for k, v in row["location_m"].items()}
    return f"{f['median']:.2f} ({f['p5']:.2f} to {f['p95']:.2f}) N, {at['median']:.1f} ({at['p5']:.1f} to {at['p95']:.1f}) cm"


def _figure6(fits: Fitted, path: Path) -> None:
    figure = Figure(figsize=(16, 6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = None
    for k, pair in enumerate(FIGURE6):
        case, fit, draws = fits["III", pair, "negative_is_pulled", "with_mismatch"]
        b, K = draws.start, case.force.shape[1]
        axes = figure.add_subplot(1, len(FIGURE6), k + 1, projection="3d")
        assert isinstance(axes, Axes3D)
        order, rank = fit.location[b].argsort(), case.location[b].argsort()
        shown = fit.fitted_rod(b)
        shown = FittedRod(shown.force[order], shown.location[order], shown.width[order], shown.base_wrench)
        truth = FittedRod(case.force[b][rank], case.location[b][rank], torch.zeros(K, dtype=torch.float64), case.base_wrench[b])
        draw_on(axes, case.robot, shown, case.told.positions[b], case.read[b], truth, MEASURED)
        axes.set_title(f"Table III, case {pair}\n{axes.get_title()}", fontsize=11, y=0.95)
    assert axes is not None
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=7, frameon=False)
    figure.savefig(path, dpi=110)
