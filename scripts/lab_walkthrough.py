"""From the files of measuring systems to loads: python scripts/lab_walkthrough.py [--cases NAME ...] simulates the exports, runs
the commands of docs/import.md on them, and prints the errors beside their Cramer-Rao bound.
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
from studies.lab_walkthrough import CASES, judged

from torchrod.cli import main as torchrod

MOST = 1.1  # times the bound


def main() -> int:
    """Simulate, run, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    options = parser.parse_args()
    torch.set_default_dtype(torch.float64)
    home, far = Path.cwd(), 0
    for name in options.cases:
        with tempfile.TemporaryDirectory() as folder:
            case = CASES[name](Path(folder))
            os.chdir(folder)
            start = time.process_time()
            for command in case.commands:
                with contextlib.redirect_stdout(io.StringIO()) as said:
                    if torchrod(command.split()):
                        return 2
                lines = said.getvalue().splitlines()
                print(f"torchrod {command}\n    {next((x for x in lines if x.endswith(' accepted')), lines[-1])}", flush=True)
            spent = time.process_time() - start
            found = judged(case, Path(folder, "loads.json"))
            os.chdir(home)
        parts = [
            f"{n} {e:.3g} {'N' if n.startswith('force') else 'm'} rms, {ratio:.2f} of the bound"
            for n, (e, ratio) in found.of.items()
        ]
        print(f"{name}: {100 * found.accepted:.1f} % accepted; {'; '.join(parts)}; {spent:.0f} s of CPU\n", flush=True)
        far += any(ratio > MOST for _, ratio in found.of.values())
    return 1 if far else 0


if __name__ == "__main__":
    sys.exit(main())
