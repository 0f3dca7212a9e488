"""The compiled library: built from the C++ beside this file with the machine's own compiler, cached, and loaded with ctypes.

Where there is no compiler the torch path does the same, more slowly, and a warning says so once. A build takes about five seconds
and happens once per machine: it goes on by itself while the torch path serves, and whoever asks after it is finished gets the
library. TORCHROD_FAST=0 switches it off; TORCHROD_CACHE names another folder for it (default ~/.cache/torchrod).
"""

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import time
import warnings
from pathlib import Path

FOLDER = Path(__file__).parent
SOURCES = sorted([*FOLDER.glob("*.h"), *FOLDER.glob("*.cpp")])
FLAGS = ("-O3", "-march=native", "-std=c++17", "-shared", "-fPIC", "-fno-math-errno", "-pthread", "-Wno-psabi")
PATIENCE = 2.0  # s that a first estimate waits for a build
GIVE_UP = 300.0  # s after which a build is held to be dead


def _processor() -> str:
    """What -march=native depends on."""
    info = Path("/proc/cpuinfo")
    if not info.is_file():
        return platform.processor()
    return next((line for line in info.read_text().splitlines() if line.startswith(("flags", "Features"))), "")


@functools.lru_cache(maxsize=1)
def _compiler() -> str | None:
    return os.environ.get("CXX") or shutil.which("g++") or shutil.which("clang++")


@functools.lru_cache(maxsize=1)
def _target() -> Path:
    """Where the library of these sources, this compiler and this processor belongs."""
    folder = Path(os.environ.get("TORCHROD_CACHE") or Path.home() / ".cache" / "torchrod")
    parts = [source.read_bytes() for source in SOURCES]
    parts.append(repr((FLAGS, _compiler(), platform.machine(), _processor())).encode())
    return folder / f"kernel-{hashlib.sha256(b''.join(parts)).hexdigest()[:16]}.so"


@functools.lru_cache(maxsize=1)
def _builder() -> subprocess.Popen[str] | str:
    """The build, begun; or why it cannot be. It outlives this process, so that a short command leaves the library to the next."""
    target, compiler = _target(), _compiler()
    if compiler is None:
        return "no C++ compiler was found"
    part = target.with_suffix(f".{os.getpid()}")
    # Renamed when whole: another process sees the whole library or none.
    script = '"$1" $2 "$3" -o "$4" && mv "$4" "$5" || { rm -f "$4"; exit 1; }'
    command = ["/bin/sh", "-c", script, "sh", compiler, " ".join(FLAGS), str(FOLDER / "kernel.cpp"), str(part), str(target)]
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        return subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
        )
    except OSError as error:
        return str(error)


@functools.lru_cache(maxsize=1)
def _say_once(reason: str) -> None:
    warnings.warn(f"no compiled kernel ({reason}); the torch path, hundreds of times slower, is used", stacklevel=3)


@functools.lru_cache(maxsize=1)
def _load(path: Path) -> ctypes.CDLL:
    return ctypes.CDLL(str(path))


@functools.lru_cache(maxsize=1)
def _deadline() -> float:
    return time.monotonic() + PATIENCE


def library(wait: bool = False) -> ctypes.CDLL | None:
    """The compiled library; None, after one warning, where there cannot be one, and without a word while it is being built.

    wait: until the build is finished, however long it takes; otherwise PATIENCE seconds at most, all calls together.
    """
    if os.environ.get("TORCHROD_FAST", "1") == "0":
        return None
    target = _target()
    try:
        if target.is_file():
            return _load(target)
    except OSError as error:
        _say_once(str(error))
        return None
    builder = _builder()
    if isinstance(builder, str):
        _say_once(builder)
        return None
    try:
        left = GIVE_UP if wait else max(0.0, _deadline() - time.monotonic())
        builder.wait(left)
    except subprocess.TimeoutExpired:
        return None
    if target.is_file():
        return _load(target)
    assert builder.stderr is not None
    _say_once(_first_error(builder))
    return None


@functools.lru_cache(maxsize=1)
def _first_error(builder: subprocess.Popen[str]) -> str:
    assert builder.stderr is not None
    lines = [line.strip() for line in builder.stderr.read().splitlines() if line.strip()]
    return next((line for line in lines if "error" in line), lines[0] if lines else "the compiler failed")[:200]


def available() -> bool:
    """Whether the kernel serves now."""
    return library() is not None
