"""C3D, binary, of most motion capture systems: read by ezc3d, the extra `c3d`."""

import importlib.util
import io
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from ...util.errors import InputError
from ..npz_file import UNREADABLE, read_arrays
from .layout import Layout
from .recording import Recording
from .text import unused

SECONDS = 600  # for what takes ezc3d one
MEMORY = 4 << 30  # bytes, and so many times the file's
TIMES = 50


def read(path: Path, content: bytes, layout: Layout) -> Recording:
    """Its points; analog channels are left aside."""
    if importlib.util.find_spec("ezc3d") is None:
        raise InputError(f"{path}: reading C3D needs ezc3d; pip install 'torchrod[c3d]', or export it as TRC")
    if content[1:2] != b"\x50":
        raise InputError(f"{path}: is not a C3D file; name the format that it is in")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "read.c3d"
        file.write_bytes(content)  # what was read once is what is parsed
        command = [sys.executable, str(Path(__file__).with_name("c3d_process.py")), str(file), str(MEMORY + TIMES * len(content))]
        try:
            done = subprocess.run(command, capture_output=True, timeout=SECONDS, check=True)
            arrays = read_arrays(io.BytesIO(done.stdout))
        except (subprocess.SubprocessError, *UNREADABLE) as error:
            said = error.stderr.decode(errors="replace") if isinstance(error, subprocess.CalledProcessError) else ""
            last = ([line.strip() for line in said.splitlines() if line.strip()] or [type(error).__name__])[-1][:120]
            raise InputError(f"{path}: is a damaged C3D file ({last}); export it again") from None
    points, rate = arrays["points"], float(arrays["rate"])
    named: dict[str, np.ndarray] = {}
    for i, label in enumerate(arrays["labels"].tolist()[: points.shape[1]]):
        named[unused(label, named)] = points[:, i].T
    if not named or not rate > 0:
        raise InputError(f"{path}: holds no points, or no frame rate; export its 3D data")
    return Recording(np.arange(points.shape[2]) / rate, named, units=str(arrays["units"]))
