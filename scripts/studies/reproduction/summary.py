"""The paper, ours and the bound in a row: the first table of the page, from the figures of the parts that ran."""

from typing import Any

from .cases import mean_error
from .printed_rows import READINGS, paper_means
from .tables import ABOUT, means

STUDY1 = {"clean": ("91", 2.1, 3.5, 0.08), "noise_1mm": ("-", None, 20.1, 0.53)}  # mm, N: the paper's; 91: 2.1 s at 23 ms each
NAMES = {"clean": "without noise", "noise_1mm": "1 mm noise"}


def summary(data: dict[str, Any]) -> list[str]:
    """Lines of Markdown; empty where neither Study 1 nor the tables ran."""
    rows = [*_study1(data["study1"]), *_paper_mode(data["study1"])] if "study1" in data else []
    rows += [*_tables(data["tables"])] if "tables" in data else []
    if not rows:
        return []
    head = "The bound is the mean |error| of an unbiased Gaussian estimator at the Cramer-Rao bound (its standard deviation times"
    return [
        "| | the paper | ours | bound |",
        "|---|---|---|---|",
        *rows,
        "",
        head + " sqrt(2 / pi)), averaged over the cases. Tables: the paper's estimates against its measurements, ours on "
        "digital twins of the same rows; two numbers where the sign of the actuation can be read in two ways.",
        "",
    ]


def _study1(data: dict[str, Any]) -> list[str]:
    rows = []
    for noise, (iterations, seconds, location, force) in STUDY1.items():
        ours, name = data[noise], f"Study 1, {NAMES[noise]}"
        bounds = [mean_error(data["cases"][f"bound_{what}_width_known"]) for what in ("location_m", "force_N")]
        rows.append(f"| {name}: converged | > 94 % | {100 * ours['converged']:.0f} % | |")
        if noise == "clean":
            rows.append(f"| {name}: iterations, mean | {iterations} | {ours['iterations_mean']:.1f} | |")
            rows.append(f"| {name}: time of one estimate | {seconds} s | {1e3 * ours['seconds_per_estimate']:.1f} ms | |")
            bounds = [0.0, 0.0]
        else:
            rows.append(f"| {name}: iterations, mean | not printed | {ours['iterations_mean']:.1f} | |")
        rows.append(
            f"| {name}: mean error of location | {location} mm | {1e3 * ours['location_m_mean']:.3f} mm "
            f"| {1e3 * bounds[0]:.3f} mm |"
        )
        rows.append(f"| {name}: mean error of force | {force} N | {ours['force_N_mean']:.4f} N | {bounds[1]:.4f} N |")
    return rows


def _paper_mode(data: dict[str, Any]) -> list[str]:
    """The paper's own recursion."""
    return [
        f"| Study 1, {NAMES[noise]}, paper mode: converged; errors | > 94 %; {STUDY1[noise][2]} mm, {STUDY1[noise][3]} N "
        f"| {100 * r['converged']:.0f} %, {r['iterations_mean']:.1f} iterations; {1e3 * r['location_m_mean']:.2f} mm, "
        f"{r['force_N_mean']:.3f} N | |"
        for noise, r in data["paper_mode"].items()
    ]


def _tables(rows: list[dict[str, Any]]) -> list[str]:
    lines = []
    for table in ABOUT:
        force, location = paper_means(table)
        for model, words in (("with_mismatch", "model 3 % wrong"), ("without_mismatch", "model exact")):
            ours = [means(rows, table, reading, model) for reading in READINGS]
            cells = " and ".join(f"{f:.3f} N / {100 * x:.2f} cm" for f, x in dict.fromkeys(ours))
            lines.append(f"| Table {table}: mean errors, {words} | {force:.3f} N / {100 * location:.2f} cm | {cells} | |")
    return lines
