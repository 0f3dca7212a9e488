"""The paper, ours and the bound in a row: the first table of the page, from the figures of the parts that ran."""

from typing import Any

from .cases import mean_error
from .tables import PAPER as TABLES

STUDY1 = {"clean": ("94 %", "91", 2.1, 3.5, 0.08), "noise_1mm": ("-", "-", None, 20.1, 0.53)}  # mm, N: the paper's
NAMES = {"clean": "without noise", "noise_1mm": "1 mm noise"}


def summary(data: dict[str, Any]) -> list[str]:
    """Lines of Markdown; empty where neither Study 1 nor the tables ran."""
    rows = [*_study1(data["study1"])] if "study1" in data else []
    rows += [*_tables(data["tables"])] if "tables" in data else []
    if not rows:
        return []
    head = "The bound is the mean |error| of an unbiased Gaussian estimator at the Cramer-Rao bound (its standard deviation times"
    return [
        "| | the paper | ours | bound |",
        "|---|---|---|---|",
        *rows,
        "",
        head + " sqrt(2 / pi)), averaged over the cases. The paper's tables are on its own rows, ours on twins (below).",
        "",
    ]


def _study1(data: dict[str, Any]) -> list[str]:
    rows = []
    for noise, (converged, iterations, seconds, location, force) in STUDY1.items():
        ours, name = data[noise], f"Study 1, {NAMES[noise]}"
        bounds = [mean_error(data["cases"][f"bound_{what}_width_known"]) for what in ("location_m", "force_N")]
        if noise == "clean":
            rows.append(f"| {name}: converged | {converged} | {100 * ours['converged']:.0f} % | |")
            rows.append(f"| {name}: iterations, mean | {iterations} | {ours['iterations_mean']:.1f} | |")
            rows.append(f"| {name}: time of one estimate | {seconds} s | {1e3 * ours['seconds_per_estimate']:.1f} ms | |")
            bounds = [0.0, 0.0]
        else:
            rows.append(
                f"| {name}: converged, iterations | not printed | {100 * ours['converged']:.0f} %, "
                f"{ours['iterations_mean']:.1f} | |"
            )
        rows.append(
            f"| {name}: mean error of location | {location} mm | {1e3 * ours['location_m_mean']:.3f} mm "
            f"| {1e3 * bounds[0]:.3f} mm |"
        )
        rows.append(f"| {name}: mean error of force | {force} N | {ours['force_N_mean']:.4f} N | {bounds[1]:.4f} N |")
    return rows


def _tables(data: dict[str, Any]) -> list[str]:
    rows = []
    for table, (force, location) in TABLES.items():
        ours = data[table]
        cells = [f"{row['force_N_mean']:.3f} N / {100 * row['location_m_mean']:.2f} cm" for row in (ours, ours["without_mismatch"])]
        bound = f"{ours['bound_force_N_mean']:.3f} N / {100 * ours['bound_location_m_mean']:.2f} cm"
        rows.append(f"| Table {table}: mean errors, model 3 % wrong | {force} N / {100 * location:.2f} cm | {cells[0]} | |")
        rows.append(f"| Table {table}: the same, model exact | | {cells[1]} | {bound} |")
    return rows
