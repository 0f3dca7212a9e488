"""Estimate the loads of the shipped examples, whose shapes an independent solver made, and print them beside the true ones.

Each example goes through the command line, as a user's data would: torchrod estimate ROBOT.toml SHAPES.csv --out ... --plot ...
"""

import contextlib
import io
import json
import math
from pathlib import Path

from torchrod.cli import main

EXAMPLE = Path(__file__).resolve().parents[1] / "docs" / "example"
OUT = Path(__file__).resolve().parents[1] / "out"


def run(name: str, truth: list[list[dict[str, float]]]) -> None:
    """One example: estimate, then a line per load."""
    result = OUT / f"{name}.json"
    arguments = [str(EXAMPLE / f"{name}.toml"), str(EXAMPLE / f"{name}.csv"), "--contacts", str(len(truth[0]))]
    arguments += ["--noise", "1e-4", "--load-prior", "point", "--out", str(result), "--plot", str(OUT / f"{name}.png")]
    with contextlib.redirect_stdout(io.StringIO()):
        if main(["estimate", *arguments]) != 0:
            raise SystemExit(f"the example {name} was refused")
    content = json.loads(result.read_text())
    print(f"\n{content['robot']}\n{'sample':>8}{'true force':>14}{'estimated':>24}{'true location':>16}{'estimated':>26}  accepted")
    for sample, points in zip(content["results"], truth, strict=True):
        loads = sorted(sample["loads"], key=lambda load: load["location_m"])
        for load, point in zip(loads, sorted(points, key=lambda p: p["s"]), strict=True):
            force = f"{load['magnitude_N']:.4f} +- {load['std']['magnitude_N']:.4f} N"
            place = f"{1e3 * load['location_m']:.2f} +- {1e3 * load['std']['location_m']:.2f} mm"
            true_force, true_place = f"{math.hypot(point['fx'], point['fy']):.4f} N", f"{1e3 * point['s']:.2f} mm"
            accepted = "yes" if sample["accepted"] else "no"
            print(f"{sample['sample']:>8}{true_force:>14}{force:>24}{true_place:>16}{place:>26}  {accepted}")


if __name__ == "__main__":
    OUT.mkdir(exist_ok=True)
    for name, truth in json.loads((EXAMPLE / "truth.json").read_text()).items():
        run(name, truth)
    print(f"\nfigures and results: {OUT}")
