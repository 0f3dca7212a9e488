"""What every sensor tells of a push: python scripts/sensors.py [--samples N] [--out DIR] writes DIR/sensor_coverage.md.

The paper's steel rod, pushes of 0.5 to 1 N at 10 to 39 cm, each sensor alone and some together: the errors and the spreads beside
their Cramer-Rao bound, and how often the 95 % intervals hold the truth.
"""

import argparse
import math
from pathlib import Path

import torch
from studies.sensors import CASES

ABOUT = """\
# What every sensor tells

Made by `python scripts/sensors.py`: the 400 mm steel rod of Study 1, {samples} pushes of 0.5 to 1 N at 10 to 39 cm a row, one contact
with a point-like prior, cold starts. The truth is the forward solve's under point forces; what a sensor reads of it and the noise are
worked out by the study, not by the library's sensors. In the rows with an uncertain stiffness every push bends a rod of its own,
which is stated under `[uncertainty]`; the tendons that rub pull with 3 and 1 N along a friction of 0.2.

Of accepted fits: root mean square error; the same over the Cramer-Rao bound, which comes from differences of the forward solve; the
mean of the posterior's standard deviation over the bound's; how often 95 % intervals hold the truth, those of draws (what `torchrod
estimate` reports by default, up to 100 samples of a robot that is taken as exact) and those of the covariance (`--intervals
gaussian`). On the robot that is only nearly known draws are of the first 100 pushes; where tendons rub one takes about a second, and
there are none here (the same noise as in the row without tendons, and so nearly the same figures). With {samples} pushes a share of 95 % is known to +-{error:.1f} % (one standard deviation).

| sensors | accepted % | force: error (mN) | over bound | spread over bound | draws hold % | covariance holds % | place: error (mm) | over bound | spread over bound | draws hold % | covariance holds % |
|---|---|---|---|---|---|---|---|---|---|---|---|"""  # noqa: E501


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
    lines = [ABOUT.format(samples=options.samples, error=1e2 * math.sqrt(0.95 * 0.05 / options.samples))]
    for name in options.cases:
        found = CASES[name]().coverage(options.samples, options.seed)
        cells = [f"{1e2 * found.accepted:.1f}"]
        for unit, of in ((1e3, found.force), (1e3, found.place)):
            cells += [f"{unit * of.error:.3g}", f"{of.over_bound:.2f}", f"{of.spread:.2f}"]
            cells += ["-" if math.isnan(of.drawn) else f"{1e2 * of.drawn:.1f}", f"{1e2 * of.covered:.1f}"]
        lines.append(f"| {name} | {' | '.join(cells)} |")
        print(lines[-1], flush=True)
    (options.out / "sensor_coverage.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
