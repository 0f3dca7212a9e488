"""Study 1: one point load, with and without noise: convergence, iterations, errors, efficiency, and errors along the rod."""

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from torchrod import Estimate, Status, estimate, paper_settings
from torchrod.estimation.solve import PAPER_GAIN

from .cases import Study, study1
from .paper_mode import STRICT, paper_lines, paper_problem

NOISE = 1e-3
ROWS = {"clean": (0.0, 1e-4), "noise_1mm": (NOISE, NOISE)}  # noise added, noise told
PRIORS = ("point", "contact", "none")


def figures_of(fit: Estimate, study: Study, seconds: float) -> dict[str, float]:
    """Means over the samples that converged; errors of magnitude and location."""
    done = fit.status == Status.CONVERGED
    location = (fit.location[:, 0] - study.location).abs()[done]
    force = (fit.magnitude[:, 0] - study.force.norm(dim=-1)).abs()[done]
    result = {"converged": float(done.double().mean()), "accepted": float(fit.accepted.double().mean())}
    result |= {"iterations_mean": float(fit.iterations[done].double().mean()), "seconds_per_estimate": seconds / len(done)}
    for name, error in (("location_m", location), ("force_N", force)):
        result |= {f"{name}_mean": float(error.mean()), f"{name}_median": float(error.median()), f"{name}_rmse": _rms(error)}
    return result


def _rms(x: Tensor) -> float:
    return float(x.square().mean().sqrt())


def paper_fit(study: Study, noise: float, gain: float | None = None) -> tuple[Estimate, float]:
    """Paper mode with and without noise, by its own criterion or by another one; and the seconds that it took."""
    problem = paper_problem(study.robot, study.noisy(noise, 1, NOISE))
    settings = paper_settings(problem)
    start = time.perf_counter()
    fit = estimate(problem, settings if gain is None else replace(settings, gain=gain))
    return fit, time.perf_counter() - start


def run(quick: bool, folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Every row of the study, its table and its figure. The data hold the point-like prior's row, and all in `rows`."""
    study, whole = study1(20 if quick else 100), study1(100)
    study.estimate(study.noisy(0.0, 1, 1e-4), "point")  # the first call pays for compiling and caches
    rows: dict[str, dict[str, dict[str, float]]] = {noise: {} for noise in ROWS}
    noisy: dict[str, Estimate] = {}
    for name, (noise, sigma) in ROWS.items():
        for prior in tqdm([*PRIORS, "paper mode"], desc=name, delay=1.0, leave=False):
            start = time.perf_counter()
            if prior == "paper mode":
                fit, seconds = paper_fit(whole, noise)
            else:
                fit = study.estimate(study.noisy(noise, 1, sigma), prior)
                seconds = time.perf_counter() - start
            rows[name][prior] = figures_of(fit, whole if prior == "paper mode" else study, seconds)
            if noise and prior != "paper mode":
                noisy[prior] = fit
    known, unknown = study.bound(NOISE, True), study.bound(NOISE, False)
    many = study.repeated(2 if quick else 10)
    for prior in tqdm(PRIORS, desc="efficiency", delay=1.0, leave=False):
        rows["noise_1mm"][prior] |= efficiency(many, prior)
    _figure(study, noisy, known, unknown, folder / "study1.png")
    lines = _table(rows, len(study.location))
    lines += ["", "Cramer-Rao bound at 1 mm noise (RMS over the cases): width known "]
    lines[-1] += f"{_rms(known[0]) * 1e3:.2f} mm, {_rms(known[1]):.4f} N; "
    lines[-1] += f"width unknown {_rms(unknown[0]) * 1e3:.2f} mm, {_rms(unknown[1]):.4f} N."
    lines += [
        "",
        f"Efficiency: RMS over {len(many.location)} runs of error / bound (width known), case by case. Beside it the RMS error",
    ]
    lines[-1] += " over the RMS bound, which the few cases near the base decide: there errors are large and skewed."
    lines += ["", "| prior | location | force | location, RMS over RMS | force, RMS over RMS |", "|---|---|---|---|---|"]
    lines += [_efficiency_line(prior, rows["noise_1mm"][prior]) for prior in PRIORS]
    lines += ["", "![Errors along the rod](study1.png)", ""]
    strict = {name: figures_of(paper_fit(whole, noise, STRICT * PAPER_GAIN)[0], whole, 0.0) for name, (noise, _) in ROWS.items()}
    full = {name: figures_of(paper_fit(whole, noise, 0.0)[0], whole, 0.0) for name, (noise, _) in ROWS.items()}
    lines += paper_lines({name: rows[name]["paper mode"] for name in ROWS}, strict, full)
    data: dict[str, Any] = {noise: {**rows[noise]["point"], "prior": "point", "rows": rows[noise]} for noise in ROWS}
    data["paper_mode"] = {name: rows[name]["paper mode"] for name in ROWS}
    data["paper_mode_strict"], data["paper_mode_gauss_newton"] = strict, full
    data["cases"] = {"location_m": study.location.tolist(), "force_N": study.force.norm(dim=-1).tolist()}
    for name, (location, force) in (("width_known", known), ("width_unknown", unknown)):
        data["cases"] |= {f"bound_location_m_{name}": location.tolist(), f"bound_force_N_{name}": force.tolist()}
    return data, lines


def efficiency(study: Study, prior: str) -> dict[str, float]:
    """RMS of error over bound, and RMS error over RMS bound, with 1 mm noise."""
    fit = study.estimate(study.noisy(NOISE, 2), prior)
    done = fit.status == Status.CONVERGED
    location = (fit.location[:, 0] - study.location)[done]
    force = (fit.magnitude[:, 0] - study.force.norm(dim=-1))[done]
    result = {}
    for name, error, bound in zip(("location", "force"), (location, force), study.bound(NOISE, True), strict=True):
        result[f"efficiency_{name}"] = _rms(error / bound[done])
        result[f"rms_over_rms_{name}"] = _rms(error) / _rms(bound[done])
    return result


def _table(rows: dict[str, dict[str, dict[str, float]]], cases: int) -> list[str]:
    head = f"{cases} cases (paper mode always 100). `paper mode` is the paper's own recursion, below."
    errors = "location mean / median / RMSE (mm) | force mean / median / RMSE (N)"
    lines = ["## Study 1", "", head, ""]
    lines += [f"| noise | prior | converged | accepted | iterations | {errors} | ms each |", "|---|---|---|---|---|---|---|---|"]
    return lines + [_line(noise, prior, row) for noise, by_prior in rows.items() for prior, row in by_prior.items()]


def _line(noise: str, prior: str, row: dict[str, float]) -> str:
    location = " / ".join(f"{1e3 * row[f'location_m_{k}']:.3f}" for k in ("mean", "median", "rmse"))
    force = " / ".join(f"{row[f'force_N_{k}']:.4f}" for k in ("mean", "median", "rmse"))
    share = f"{100 * row['converged']:.0f} % | {100 * row['accepted']:.0f} % | {row['iterations_mean']:.1f}"
    return f"| {noise} | {prior} | {share} | {location} | {force} | {1e3 * row['seconds_per_estimate']:.1f} |"


def _efficiency_line(prior: str, row: dict[str, float]) -> str:
    keys = ("efficiency_location", "efficiency_force", "rms_over_rms_location", "rms_over_rms_force")
    return f"| {prior} | " + " | ".join(f"{row[k]:.2f}" for k in keys) + " |"


def _figure(
    study: Study,
    noisy: dict[str, Estimate],
    known: tuple[Tensor, Tensor],
    unknown: tuple[Tensor, Tensor],
    path: Path,
) -> None:
    """Errors against the true location, with the bounds, 1 mm noise."""
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    order = torch.argsort(study.location)
    at = 1e3 * study.location
    for k, (label, unit, scale, least) in enumerate((("location error", "mm", 1e3, 0.05), ("force error", "N", 1.0, 3e-4))):
        axes = figure.add_subplot(1, 2, k + 1)
        for prior, colour in (("contact", "#0a7f8c"), ("point", "#c8102e")):
            fit = noisy[prior]
            error = fit.location[:, 0] - study.location if k == 0 else fit.magnitude[:, 0] - study.force.norm(dim=-1)
            # An error that happens to be tiny says nothing: it is drawn at the lower edge.
            axes.semilogy(at, (error.abs() * scale).clamp(min=least), "o", ms=3.5, color=colour, label=f"{prior} prior")
        for bound, style, name in ((known, "-", "width known"), (unknown, "--", "width unknown")):
            axes.semilogy(at[order], bound[k][order] * scale, style, color="#1b2a41", lw=1, label=f"bound, {name}")
        axes.set_ylim(bottom=least)
        axes.set_xlabel("true location (mm)")
        axes.set_ylabel(f"{label} ({unit}), 1 mm noise")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=150)
