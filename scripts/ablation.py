"""What the warm start is worth: python scripts/ablation.py [CASE ...] [--quick] [--json FILE] [--out DIR].

The same cases from a cold, a warm and an oracle's start, compared sample by sample. Writes DIR/warm_start.md (docs/ by default)
and its picture, and the figures as data to FILE.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from studies.ablation.measure import REPEATS, STARTS, compared, runs, start_times
from studies.ablation.plans import PLANS, make
from studies.ablation.report import figure, page
from tqdm import tqdm


def main() -> None:
    """Run the named cases, or all, and write what they found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", choices=[*PLANS, []], help="which cases; all by default")
    parser.add_argument("--quick", action="store_true", help="fewer samples, about a minute")
    parser.add_argument("--json", type=Path, help="write the figures as data")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[1] / "docs", help="folder of page and picture")
    options = parser.parse_args()
    torch.set_num_threads(1)  # two threads that wait for a busy neighbour would tell of the neighbour
    options.out.mkdir(parents=True, exist_ok=True)
    names = options.cases or list(PLANS)
    data: dict[str, Any] = {}
    with tqdm(total=len(names) * REPEATS * len(STARTS), desc="fits") as bar:
        for name in names:
            bar.set_postfix_str(name)
            case = make(name, options.quick)
            data[name] = compared(case, runs(case, bar.update)) | {"time": start_times(case.parts[0])}
            if options.json:
                options.json.write_text(json.dumps(data, indent=1), encoding="utf-8")
    said = "".join(f" {word}" for word in [*options.cases, *["--quick"] * options.quick])
    text = page(data, said)
    (options.out / "warm_start.md").write_text(text, encoding="utf-8")
    figure(data, options.out / "warm_start.png")
    print(text)


if __name__ == "__main__":
    main()
