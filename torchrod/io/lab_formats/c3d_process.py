"""Run as a process of its own (c3d.py): ezc3d takes its process down with some damaged files, or asks for all memory.

python c3d_process.py FILE MEMORY writes an NPZ of the points to its standard output, within so many bytes of memory.
"""

import contextlib
import io
import sys

import ezc3d
import numpy as np


def main() -> None:
    """Read, and write what was read."""
    path, memory = sys.argv[1], int(sys.argv[2])
    with contextlib.suppress(ImportError, ValueError, OSError):  # no such limit on this system
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    found = ezc3d.c3d(path)
    of = found["parameters"]["POINT"]
    keys = [key for key in of if key == "LABELS" or (key.startswith("LABELS") and key[6:].isdecimal())]
    labels = [label for key in sorted(keys, key=lambda k: (len(k), k)) for label in of[key]["value"]]
    whole = io.BytesIO()
    points, rate, units = found["data"]["points"][:3], float(of["RATE"]["value"][0]), str(of["UNITS"]["value"][0])
    np.savez(whole, points=points, labels=np.array(labels, dtype=str), rate=rate, units=units)
    sys.stdout.buffer.write(whole.getvalue())


if __name__ == "__main__":
    main()
