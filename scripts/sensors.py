"""What every sensor tells of a push: python scripts/sensors.py [--samples N] [--out DIR] writes DIR/sensor_coverage.md.

The paper's steel rod, pushes of 0.5 to 1 N at 10 to 39 cm, each sensor alone and some together: the errors and the spreads beside
their Cramer-Rao bound, and how often the 95 % intervals hold the truth.
"""

import argparse
from pathlib import Path

import torch
from studies.sensors import CASES


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=500, help="pushes per row")
    parser.add_argument("--seed", type=int, default=11, help="of pushes and noise")
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES), help="rows of the table")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[1] / "docs")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)  # before the work that would be lost
    torch.set_default_dtype(torch.float64)
    lines = [
        "# What every sensor tells",
        "",
    ]
    for name in options.cases:
        found = CASES[name]().coverage(options.samples, options.seed)
        cells = [f"{1e2 * found.accepted:.1f}"]
        for unit, of in ((1e3, found.force), (1e3, found.place)):
            cells += [f"{unit * of.error:.3g}", f"{of.over_bound:.2f}", f"{of.spread:.2f}"]
            cells += [f"{1e2 * of.drawn:.1f}", f"{1e2 * of.covered:.1f}"]
        lines.append(f"| {name} | {' | '.join(cells)} |")
        print(lines[-1], flush=True)
    (options.out / "sensor_coverage.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
