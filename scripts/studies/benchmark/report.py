"""The generated part of docs/performance.md: tables of what was measured."""

from pathlib import Path
from typing import Any

BEGIN, END = "<!-- benchmark: begin -->", "<!-- benchmark: end -->"
PAGE = f"# Performance\n\n{BEGIN}\n{END}\n"
LABELS = {
    "torchrod": "torchrod, compiled kernel",
    "torchrod, eager": "torchrod, eager torch",
    "numba": "numba",
    "jax": "JAX",
    "jax, tuned": "JAX, tuned",
    "scipy": "scipy `least_squares`",
}
MICRO = 1e6


def label(key: str) -> str:
    """How a path, with what follows it, is called."""
    path = max((name for name in LABELS if key == name or key.startswith(f"{name}, ")), key=len)
    return LABELS[path] + key[len(path) :]


def table(head: list[str], rows: list[list[str]]) -> list[str]:
    """In Markdown."""
    return ["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows)]


def micro(seconds: float | None) -> str:
    """Microseconds to three digits, or a dash."""
    if seconds is None:
        return "-"
    value = MICRO * seconds
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}"


def columns(by_path: dict[str, dict[str, float]]) -> list[str]:
    """All values along which the paths were measured."""
    return sorted({value for times in by_path.values() for value in times}, key=int)


def times_table(first: str, by_path: dict[str, dict[str, float]]) -> list[str]:
    """Microseconds per sample, paths down, values across."""
    values = columns(by_path)
    rows = [[label(name), *[micro(times.get(v)) for v in values]] for name, times in by_path.items() if times]
    return table([first, *[f"{int(v):,}" for v in values]], rows)


def bar_table(data: dict[str, Any]) -> list[str]:
    """The bars."""
    words = {True: "met", False: "**missed**", None: "-"}
    return table(["what", "measured", "bar", ""], [[b["what"], b["measured"], b["bar"], words[b["met"]]] for b in data["bars"]])


def ratio_table(data: dict[str, Any]) -> list[str]:
    """torchrod's compiled path over the others."""
    others = data["ratios"]["torchrod"]
    values = columns(others)
    rows = [[label(name), *[f"{r[v]:.3g}" if v in r else "-" for v in values]] for name, r in others.items() if r]
    return table(["torchrod's time over that of", *[f"{int(v):,}" for v in values]], rows)


def estimate_table(data: dict[str, Any]) -> list[str]:
    """Whole estimates."""
    rows = []
    for name, row in data["estimates"].items():
        share = "-" if row["kernel_share"] is None else f"{1 - row['kernel_share']:.2f}"
        cells = [label(name), f"{row['batch']:,}", f"{1 / row['seconds']:,.1f}", micro(row["seconds"])]
        rows.append([*cells, f"{row['iterations']:.1f}", f"{100 * row['converged']:.1f} %", share])
    return table(["start", "batch", "a second", "us each", "iterations", "converged", "outside the kernel"], rows)


def first_call_table(data: dict[str, Any]) -> list[str]:
    """Imports and first iterations."""
    rows = [[label(name), f"{row['import_s']:.2f}", f"{row['first_s']:.2f}"] for name, row in data["first_call"].items()]
    return table(["a fresh process", "import (s)", "first iteration, batch 256 (s)"], rows)


def memory_table(data: dict[str, Any]) -> list[str]:
    """Peaks."""
    rows = [
        [f"{int(batch):,}", f"{row['peak'] / 1e9:.2f}", f"{row['before'] / 1e9:.2f}", micro(row["seconds"] / int(batch))]
        for batch, row in data["memory"].items()
    ]
    return table(["whole estimates", "peak (GB)", "of which before (GB)", "us each, first call"], rows)


def agreement_table(data: dict[str, Any]) -> list[str]:
    """By how much the paths differ."""
    rows = []
    for name, d in data["agreement"].items():
        cells = [f"{d[what]:.1g}" if what in d else "-" for what in ("h", "H", "x", "Sigma", "force", "location", "cost")]
        rows.append([label(name), str(d["samples"]), *cells, f"{100 * d['elsewhere']:.0f} %"])
    head = ["against torchrod", "samples", "h (relative)", "H (relative)", "next x", "next Sigma (relative)"]
    return table([*head, "force (N)", "location (m)", "chi^2", "another minimum"], rows)


def generated(data: dict[str, Any], options: str) -> str:
    """Everything between the markers."""
    m, single = data["machine"], data["single"]
    floor = " or ".join(f"{micro(seconds)} us on {n} cores".replace(" 1 cores", " one core") for n, seconds in m["floor"].items())
    rate = ", ".join(f"{r / 1e9:.0f} Gflop/s on {n}" for n, r in m["dgemm"].items())
    one = ", ".join(f"{label(name)} {1e3 * s:.2f} ms" for name, s in single["estimate_s"].items())
    frames = single["frames"]
    film = f"first {1e3 * frames['first_s']:.2f} ms, then median {1e3 * frames['median_s']:.2f} ms, "
    film += f"99 % point {1e3 * frames['p99_s']:.2f} ms ({frames['count']} frames)"
    lines = [
        f"Made by `python scripts/benchmark.py{options}` on {m['processor']}, {m['cores']} cores; all of it comes from that run.",
        "",
        "An iteration is h, H, the normal equations and the filter's update: one Gaussian with registration (16 unknowns), 20",
        f"markers, 40 RK4 steps. Its floor is 0.37 Mflop at the rate of a large matrix product ({rate}): {floor}.",
    ]
    lines += ["Versions: " + ", ".join(f"{name} {version}" for name, version in m["versions"].items()) + "."]
    lines += ["", *bar_table(data), "", "![Time of an iteration](performance.png)", "", "### An iteration", ""]
    lines += [
        "Microseconds per sample, by batch (scipy: h and H by differences only):",
        "",
        *times_table("batch", data["iteration"]),
    ]
    lines += [
        "",
        *ratio_table(data),
        "",
        "The same samples in calls of every size, in turn (above: the fastest call), iterations and cold estimates:",
    ]
    lines += ["", *times_table("batch", data["linear"]), "", "Growth, microseconds per sample:"]
    for what, by_path in data["growth"].items():
        lines += ["", *times_table(what, by_path)]
    lines += ["", *times_table("cores", data["cores"]), "", "### Whole estimates", ""]
    lines += ["Study 1, 1 mm noise, 10 unknowns, markers to loads with covariance:", "", *estimate_table(data), ""]
    lines += [f"A batch of one: {one}. One frame after another: {film}.", "", "### First call, memory", ""]
    lines += [*first_call_table(data), "", *memory_table(data), "", "### The same answers", ""]
    lines += ["Largest differences from torchrod's compiled path; the benchmark stops where a peer disagrees:", ""]
    return "\n".join([*lines, *agreement_table(data), ""])


def write_page(path: Path, text: str) -> None:
    """Replace what is between the markers; the prose around them stays."""
    page = path.read_text(encoding="utf-8") if path.is_file() else PAGE
    before, rest = page.split(BEGIN, 1)
    after = rest.split(END, 1)[1]
    path.write_text(f"{before}{BEGIN}\n{text}{END}{after}", encoding="utf-8")
