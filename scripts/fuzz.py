"""Damaged files of every kind: python scripts/fuzz.py [--inputs N] [--kinds KIND ...] reads N of each kind, and fails where one is
neither read nor refused in one sentence. A failure is told with the seed that makes it again (--seed).
"""

import argparse
import sys
import tempfile
import traceback
from collections import Counter
from pathlib import Path

from studies.fuzz import sound, trial

from torchrod import read_robot
from torchrod.util.progress import bar

MOST_TOLD = 5  # failures of a kind, each of another place in the code


def main() -> int:
    """Damage and read."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=10_000, help="files of each kind")
    parser.add_argument("--kinds", nargs="+", help="by default all")
    parser.add_argument("--seed", type=int, default=0, help="of the first file; the next have the next seeds")
    options = parser.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        kinds = sound(folder)
        if unknown := set(options.kinds or ()) - set(kinds):
            parser.error(f"unknown kinds {', '.join(sorted(unknown))}; known: {', '.join(kinds)}")
        robot = read_robot(folder / "plain.toml")
        for kind in options.kinds or kinds:
            content, refused, told = (folder / kinds[kind]).read_bytes(), 0, Counter()
            with bar(options.inputs, kind) as shown:
                for seed in range(options.seed, options.seed + options.inputs):
                    try:
                        refused += trial(folder, kind, kinds[kind], content, robot, seed)
                    except Exception as error:
                        place = traceback.extract_tb(error.__traceback__)[-1]
                        told[f"{type(error).__name__} at {place.filename}:{place.lineno}"] += 1
                        if told.total() == len(told) <= MOST_TOLD:
                            print(f"{kind}, seed {seed}:\n{traceback.format_exc(limit=-8)}", file=sys.stderr, flush=True)
                    shown.update(1)
            failed += told.total()
            said = "".join(f"\n    {count} x {what}" for what, count in told.most_common())
            print(f"{kind}: {options.inputs} files, {refused} refused, {told.total()} failed{said}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
