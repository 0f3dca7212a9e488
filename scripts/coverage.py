"""How often 95 % intervals hold the truth: python scripts/coverage.py [--cases N] [--forms N] [--only PART ..] [--out DIR].

It writes DIR/coverage.md. Each kind has the right model and random members. Shapes are of torchrod.solve_shape with point forces or
dead tip wrenches on four times the steps of the fit: another discretization and another load than the Gaussians that are fitted.
"""

import argparse
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import torch
from studies.coverage import bands, counted, told, untold
from studies.coverage.cases import COUNTED, TOLD

PARTS = ["told", "counted", "untold", "bands"]
HEAD = [
    "# Coverage of 95 % intervals",
    "",
    "Made by `python scripts/coverage.py`: the 400 mm steel rod, 20 markers, 0.1 % of the length as noise, and point forces",
    "of 0.5 to 2 force scales at 25 to 100 % of the length, unless said, on four times the steps of the fit. Of {cases}",
    "cases the share of an interval that holds in 95 % is known to {error:.1f} %.",
    "",
]


def parts(cases: int, forms: int) -> dict[str, tuple[list[str], Callable[[str, int], str], list[str], int]]:
    """By name: the head of a table, what makes a line, of what, and of how many."""
    return {
        "told": (told.HEAD, told.line, list(TOLD), cases),
        "counted": (counted.HEAD, counted.line, list(COUNTED), cases),
        "untold": (untold.HEAD, untold.line, list(untold.ROWS), cases),
        "bands": (bands.head(forms), bands.line, bands.ROWS, forms),
    }


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=500, help="of each kind")
    parser.add_argument("--forms", type=int, default=500, help="loads of each form, for the bands of f(s)")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[1] / "docs")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)  # before the work that would be lost
    error = 100 * (0.95 * 0.05 / options.cases) ** 0.5
    lines = [text.format(cases=options.cases, error=error) for text in HEAD]
    say: Callable[[str], None] = print
    with ProcessPoolExecutor(2, get_context("spawn"), torch.set_num_threads, (1,)) as pool:
        for name in options.only:
            head, line, rows, many = parts(options.cases, options.forms)[name]
            lines += head
            for found in pool.map(line, rows, [many] * len(rows)):
                lines.append(found)
                say(found)
                (options.out / "coverage.md").write_text("\n".join(lines).rstrip() + "\n")
            lines.append("")


if __name__ == "__main__":
    main()
