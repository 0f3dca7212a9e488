"""C3D, binary, of most motion capture systems: read by ezc3d, the extra `c3d`."""

import tempfile
from pathlib import Path

import numpy as np

from ...util.errors import InputError
from .layout import Layout
from .recording import Recording


def read(path: Path, content: bytes, layout: Layout) -> Recording:
    """Its points; analog channels are left aside."""
    try:
        import ezc3d
    except ImportError:
        raise InputError(f"{path}: reading C3D needs ezc3d; pip install 'torchrod[c3d]', or export it as TRC") from None
    if content[1:2] != b"\x50":
        raise InputError(f"{path}: is not a C3D file; name the format that it is in")
    with tempfile.NamedTemporaryFile(suffix=".c3d") as file:  # what was read once is what is parsed
        file.write(content)
        file.flush()
        try:
            found = ezc3d.c3d(file.name)
            of = found["parameters"]["POINT"]
            labels = [label for key in sorted(of, key=lambda k: (len(k), k)) if _is_labels(key) for label in of[key]["value"]]
            points, rate = found["data"]["points"][:3], float(of["RATE"]["value"][0])
            units = str(of["UNITS"]["value"][0])
        except (OSError, RuntimeError, ValueError, LookupError, TypeError, MemoryError) as error:
            said = next(iter(str(error).splitlines()), type(error).__name__)[:120]
            raise InputError(f"{path}: is a damaged C3D file ({said}); export it again") from None
    named = {label: points[:, i].T for i, label in enumerate(labels[: points.shape[1]])}
    if not named or not rate > 0:
        raise InputError(f"{path}: holds no points, or no frame rate; export its 3D data")
    return Recording(np.arange(points.shape[2]) / rate, named, units=units)


def _is_labels(key: str) -> bool:
    return key == "LABELS" or (key.startswith("LABELS") and key[6:].isdecimal())
