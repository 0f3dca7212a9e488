"""How far to trust an estimate: python scripts/trust.py [--samples N] [--out DIR] writes DIR/trust.md and DIR/trust.png.

The paper's steel rod, 20 markers, 1 mm noise unless said otherwise: how often the 95 % intervals and the band of the load profile
hold the truth; what missing markers, markers that are off and an unknown noise cost; whether exchanged labels and a base frame that
is off are told; what such a base frame costs; what contacts that drag along the rod do.
"""

import argparse
from pathlib import Path

from matplotlib.figure import Figure
from studies.trust import coverage, drag, frame, markers, mistakes, unknown_noise


def main() -> None:
    """Write the page and its figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--samples",
        type=int,
        default=1000,
        help="runs per row; missing markers take four times as many, the base frame two fifths, noise and drag a fifth, mistakes a "
        "25th",
    )
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[1] / "docs")
    options = parser.parse_args()
    lines = [
        "# How far to trust an estimate",
        "",
        "Made by `python scripts/trust.py`: the 400 mm steel rod of Study 1, 20 markers, 1 mm",
    ]
    lines += ["noise unless said otherwise, the default settings with a cold start.", ""]
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for part in (
        coverage.run(options.samples, left),
        markers.run(options.samples),
        unknown_noise.run(max(options.samples // 5, 4)),
        mistakes.run(max(options.samples // 25, 4)),
        frame.run(max(2 * options.samples // 5, 5), right),
        drag.run(max(options.samples // 5, 4)),
    ):
        lines += [*part, ""]
        print("\n".join(part), flush=True)
    figure.savefig(options.out / "trust.png", dpi=150)
    (options.out / "trust.md").write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
