"""From the files of measuring systems to loads: python scripts/lab_walkthrough.py [--cases NAME ...] simulates the exports, runs
the commands of docs/import.md on them, and prints the errors beside their Cramer-Rao bound. One take of 60 frames tells it to 9 %:
every case has further takes with other noise (--takes N), and what counts are the errors of all.
"""

import argparse
import contextlib
import io
import os
import sys
import tempfile
import time
from pathlib import Path

import torch
from studies.lab_walkthrough import CASES, MANY, TAKES, Errors, judged

from torchrod.cli import main as torchrod

MOST = 1.1  # times the bound


def take(name: str, seed: int) -> Errors | None:
    """Simulate a case and run its commands; what they say is printed of the first take. None where a command fails."""
    home = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        case = CASES[name](Path(folder), seed)
        os.chdir(folder)
        try:
            for command in case.commands:
                with contextlib.redirect_stdout(io.StringIO()) as said:
                    if torchrod(command.split()):
                        return None
                lines = said.getvalue().splitlines()
                if seed == 0:
                    summary = next((line for line in lines if line.endswith(" accepted")), lines[-1])
                    print(f"torchrod {command}\n    {summary}", flush=True)
        finally:
            os.chdir(home)
        return judged(case, Path(folder, "loads.json"))


def main() -> int:
    """Take after take, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--takes", type=int, help=f"of each case; by default {TAKES}, and 1 of what has {MANY} frames")
    options = parser.parse_args()
    torch.set_default_dtype(torch.float64)
    far = 0
    for name in options.cases:
        takes: list[Errors] = []
        start = time.process_time()
        while not takes or len(takes) < (options.takes or (1 if takes[0].frames >= MANY else TAKES)):
            found = take(name, len(takes))
            if found is None:
                return 2
            takes.append(found)
        spent, found = (time.process_time() - start) / len(takes), Errors.of_all(takes)
        parts = [f"{name}: {found.frames} frames, {100 * found.accepted:.1f} % accepted"]
        for n, (error, ratio) in found.of.items():
            each = ", ".join(f"{one.of[n][1]:.2f}" for one in takes)
            parts.append(f"{n} {error:.3g} {'N' if n.startswith('force') else 'm'} rms, {ratio:.2f} of the bound ({each})")
        print("; ".join([*parts, f"{spent:.0f} s of CPU a take"]), end="\n\n", flush=True)
        far += any(ratio > MOST for _, ratio in found.of.values())
    return 1 if far else 0


if __name__ == "__main__":
    sys.exit(main())
