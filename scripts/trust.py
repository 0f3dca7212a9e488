"""How far to trust an estimate: python scripts/trust.py [--parts NAME ..] [--samples N] [--out DIR] writes DIR/trust.md.

The paper's steel rod, 20 markers, 1 mm noise unless said otherwise: how often the 95 % intervals and the band of the load profile
hold the truth; what missing markers, markers that are off and an unknown noise cost; whether exchanged labels and a base frame that
is off are told; what such a base frame costs; what contacts that drag along the rod do; z-scores from the finest to the coarsest
noise; robots that are not quite as their file says. With --parts the other sections of the page stay as they are.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

from matplotlib.figure import Figure
from studies.trust import coverage, drag, frame, markers, mistakes, robots, scores, unknown_noise

HEAD = """\
# How far to trust an estimate

Made by `python scripts/trust.py`: the 400 mm steel rod of Study 1, 20 markers, 1 mm
noise unless said otherwise, the default settings with a cold start.
"""
PARTS = "coverage", "markers", "noise", "mistakes", "frame", "drag", "scores", "robots"
DRAWN = "coverage", "frame"  # in trust.png


def sections(page: str) -> dict[str, str]:
    """The sections of a page by their titles, in its order."""
    return {part.partition("\n")[0]: part.strip() for part in ("\n" + page).split("\n## ")[1:]}


def main() -> None:
    """Write the page and its figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--samples",
        type=int,
        default=1000,
        help="runs per row; missing markers take four times as many, z-scores and robots half, the base frame two fifths, noise "
        "and drag a fifth, mistakes a 25th",
    )
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="sections; coverage and frame go together")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[1] / "docs")
    options = parser.parse_args()
    if len(set(DRAWN) & set(options.parts)) == 1:
        parser.error("coverage and frame go together: they share trust.png")
    options.out.mkdir(parents=True, exist_ok=True)  # before the work that would be lost
    figure, samples, path = Figure(figsize=(11, 4.6), layout="constrained"), options.samples, options.out / "trust.md"
    left, right = figure.subplots(1, 2)
    every: dict[str, Callable[[], list[str]]] = {
        "coverage": lambda: coverage.run(samples, left),
        "markers": lambda: markers.run(samples),
        "noise": lambda: unknown_noise.run(max(samples // 5, 4)),
        "mistakes": lambda: mistakes.run(max(samples // 25, 4)),
        "frame": lambda: frame.run(max(2 * samples // 5, 5), right),
        "drag": lambda: drag.run(max(samples // 5, 4)),
        "scores": lambda: scores.run(max(samples // 2, 4)),
        "robots": lambda: robots.run(max(samples // 2, 4)),
    }
    kept = sections(path.read_text(encoding="utf-8")) if path.exists() and set(options.parts) != set(PARTS) else {}
    for name in (name for name in PARTS if name in options.parts):
        text = "\n".join(every[name]()).strip()
        print(text, flush=True)
        kept |= sections(text)
        path.write_text("\n".join([HEAD, *(f"## {part}\n" for part in kept.values())]), encoding="utf-8")
    if set(DRAWN) <= set(options.parts):
        figure.savefig(options.out / "trust.png", dpi=150)


if __name__ == "__main__":
    main()
