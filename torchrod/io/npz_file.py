"""Arrays from an NPZ archive that anybody may have written."""

import lzma
import struct
import tokenize
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import IO

import numpy as np

# What zip, its compressions, NumPy's header and JSON raise over bytes that are not theirs.
UNREADABLE = (
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,
    OSError,
    EOFError,
    MemoryError,
    RuntimeError,
    SyntaxError,
    tokenize.TokenError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
)


def read_arrays(file: str | Path | IO[bytes]) -> dict[str, np.ndarray]:
    """Every array of an NPZ by its name; nothing is unpickled. Errors: one of UNREADABLE where the bytes are none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what NumPy thinks of an odd header is said by whoever refuses it
        with np.load(file, allow_pickle=False) as archive:
            return {name: np.asarray(archive[name]) for name in archive.files}


def why(error: BaseException) -> str:
    """The first line of what an error says, or its name."""
    return next((line.strip()[:120] for line in str(error).splitlines() if line.strip()), type(error).__name__)
