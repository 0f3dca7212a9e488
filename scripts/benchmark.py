"""How fast torchrod is, and beside what: python scripts/benchmark.py [--quick] [--json FILE] [--out DIR] [--paths NAME ...].

torchrod's paths against the same estimator written by hand in numba, JAX and scipy (`pip install -e '.[bench]'`), all in one run,
after a check that they give the same answers. Writes the generated part of DIR/performance.md (docs/ by default) and its picture,
and the figures as data to FILE. Needs an idle machine.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from studies import peers
from studies.benchmark.agreement import Disagreement, checked
from studies.benchmark.bars import bars, ratios
from studies.benchmark.figure import figure
from studies.benchmark.measure import (
    by_batch,
    by_cores,
    command_line,
    estimates,
    first_calls,
    growth,
    linearity,
    machine,
    memory,
    single,
    workers,
)
from studies.benchmark.plans import FULL, QUICK, Plan
from studies.benchmark.processes import TORCHROD, available
from studies.benchmark.report import generated, write_page
from tqdm import tqdm

ROOT = Path(__file__).resolve().parents[1]
PATHS = [*TORCHROD, *peers.PEERS]


def measured(names: list[str], plan: Plan, folder: Path, caches: Path) -> dict[str, Any]:
    """All figures. Errors: Disagreement where a path does not give torchrod's answers."""
    with tqdm(bar_format="{elapsed} {desc}") as bar:
        say = bar.set_description_str
        say("the machine's matrix product")
        data: dict[str, Any] = {"machine": machine(caches)}
        with workers(names, caches) as processes:
            say("the same answers?")
            data["agreement"] = checked(processes, folder)
            data["iteration"] = by_batch(processes, plan, folder, say)
            data["linear"] = linearity(processes, plan, folder, say)
            data["growth"] = growth(processes, plan, folder, say)
            data["estimates"] = estimates(processes, plan, folder, say)
            data["single"] = single(processes, plan, folder, say)
        data["cores"] = by_cores(names, plan, folder, caches, say)
        data["first_call"] = first_calls(names, plan, folder, caches, say)
        data["memory"] = memory(plan, folder, caches, say)
        data["command_line"] = command_line(plan, folder, say)
    data["ratios"] = ratios(data)
    data["bars"] = bars(data)
    return data


def main() -> int:
    """Measure, and write what was found; exit status 1 where a peer disagrees."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer batches and calls, two minutes")
    parser.add_argument("--json", type=Path, help="write the figures as data")
    parser.add_argument("--out", type=Path, default=ROOT / "docs", help="folder of page and picture")
    parser.add_argument("--paths", nargs="+", choices=PATHS, default=PATHS, help="which paths and peers, beside torchrod's kernel")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    chosen = [name for name in PATHS if name == "torchrod" or name in options.paths]
    names = [name for name in chosen if available(name)]
    for name in set(chosen) - set(names):
        print(f"{name} is not there and is left out", file=sys.stderr)
    try:
        with tempfile.TemporaryDirectory() as folder:
            data = measured(names, QUICK if options.quick else FULL, Path(folder), ROOT / "out" / "benchmark")
    except Disagreement as error:
        print(f"no table: {error}", file=sys.stderr)
        return 1
    if options.json:
        options.json.write_text(json.dumps(data, indent=1), encoding="utf-8")
    text = generated(data, " --quick" if options.quick else "")
    write_page(options.out / "performance.md", text)
    figure(data, options.out / "performance.png")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
