"""The compiled library: built from the C++ beside this file with the machine's own compiler, cached, and loaded with ctypes.

Where there is no compiler the torch path does the same, more slowly, and a warning says so once. A build takes about five seconds
and happens once per machine: it goes on by itself while the torch path serves, and whoever asks after it is finished gets the
library. TORCHROD_FAST=0 switches it off; TORCHROD_CACHE names another folder for it (default ~/.cache/torchrod).
"""

import contextlib
import ctypes
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
import threading
import time
import uuid
import warnings
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).parent
SOURCES = sorted([*FOLDER.glob("*.h"), *FOLDER.glob("*.cpp")])
FLAGS = ("-O3", "-march=native", "-std=c++17", "-shared", "-fPIC", "-fno-math-errno", "-pthread", "-Wno-psabi")
PATIENCE = 2.0  # s that a first estimate waits for a build
GIVE_UP = 300.0  # s after which a build is held to be dead

# Renamed when whole: another process sees the whole library or none. What the compiler has printed goes when it has succeeded, and
# last, so that the build is over once it is gone; it stays, under a name known to all, when it has failed. What nobody has loaded
# for so many days (`_load` keeps the time), of other sources, compilers and processors, goes with a success.
SCRIPT = """
PATH=$PATH:/usr/bin:/bin
part=$1 target=$2 messages=$3 log=$4
shift 4
if "$@" -o "$part" && mv -f "$part" "$target"; then
    find "${target%/*}" -maxdepth 1 -type f -name "kernel-*" ! -path "$target" -mtime +90 -exec rm -f {} +
    rm -f "$log" "$messages"
else
    rm -f "$part"
    mv -f "$messages" "$log"
fi
"""
_starting = threading.Lock()
_loaded: list[ctypes.CDLL] = []  # the library, once it is there: to look for its file takes as long as to fit a few samples


def _unlock() -> None:
    """In a process that was forked while another thread of its parent held the lock."""
    global _starting
    _starting = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_unlock)


@dataclass(frozen=True)
class _Build:
    """A build that has begun, by the process `owner`; the file of its messages is there as long as it goes on."""

    process: subprocess.Popen[bytes]
    messages: Path
    owner: int


def _processor() -> str:
    """What -march=native depends on."""
    info = Path("/proc/cpuinfo")
    if not info.is_file():
        return platform.processor()
    return next((line for line in info.read_text().splitlines() if line.startswith(("flags", "Features"))), "")


@functools.lru_cache(maxsize=1)
def _compiler() -> str | None:
    """As a shell would read it, so that CXX may be "ccache g++"."""
    given = os.environ.get("CXX", "").strip()
    return given or next((shlex.quote(found) for name in ("g++", "clang++") if (found := shutil.which(name))), None)


def _own_temporary_folder() -> Path:
    """Below the folder for temporary files, where anybody may write: it has to be this user's alone, for code is run from it."""
    folder = Path(tempfile.gettempdir()) / f"torchrod-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    about = folder.lstat()
    if about.st_uid != os.getuid() or about.st_mode & 0o022:
        raise PermissionError(f"{folder} is open to other users, and there is no home folder; set TORCHROD_CACHE")
    return folder


def _folder() -> Path:
    given = os.environ.get("TORCHROD_CACHE")
    try:
        return Path(given) if given else Path.home() / ".cache" / "torchrod"
    except RuntimeError:  # a container's user may have no home
        return _own_temporary_folder()


@functools.lru_cache(maxsize=1)
def _target() -> Path:
    """Where the library of these sources, this compiler and this processor belongs."""
    parts = [source.read_bytes() for source in SOURCES]
    parts.append(repr((FLAGS, _compiler(), platform.machine(), _processor())).encode())
    return _folder() / f"kernel-{hashlib.sha256(b''.join(parts)).hexdigest()[:16]}.so"


def _log(target: Path) -> Path:
    """What the compiler printed when it last failed."""
    return target.with_suffix(".log")


@functools.lru_cache(maxsize=1)
def _builder(target: Path) -> _Build | str:
    """The build, begun; or why it cannot be. It outlives this process, so that a short command leaves the library to the next."""
    compiler = _compiler()
    if compiler is None:
        return "no C++ compiler was found"
    try:
        words = shlex.split(compiler)
    except ValueError as error:
        return f"CXX={compiler}: {error}"
    # No process number: containers that share a home have the same ones.
    name = f"{target.stem}.{uuid.uuid4().hex}"
    part, messages = target.with_name(f"{name}.part"), target.with_name(f"{name}.messages")
    files = [str(path) for path in (part, target, messages, _log(target))]
    command = ["/bin/sh", "-c", SCRIPT, "sh", *files, *words, *FLAGS, str(FOLDER / "kernel.cpp")]
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with messages.open("wb") as stderr:  # not a pipe, which a talkative compiler fills, or finds closed
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=stderr, start_new_session=True
            )
    except OSError as error:
        return str(error)
    return _Build(process, messages, os.getpid())


def _ended(build: _Build, seconds: float) -> bool:
    """Whether the build ends within this time."""
    if build.owner == os.getpid():
        try:
            build.process.wait(seconds)
        except subprocess.TimeoutExpired:
            return False
        return True
    # This process was forked while its parent's build was under way: another's child cannot be waited for.
    end = time.monotonic() + seconds
    while build.messages.exists():
        if time.monotonic() >= end:
            return False
        time.sleep(0.02)
    return True


@functools.lru_cache(maxsize=1)
def _say_once(reason: str) -> None:
    warnings.warn(f"no compiled kernel ({reason}); the torch path, hundreds of times slower, is used", stacklevel=3)


@functools.lru_cache(maxsize=1)
def _load(path: Path) -> ctypes.CDLL | str:
    """The library, or why it cannot be loaded."""
    try:
        loaded = ctypes.CDLL(str(path))
    except OSError as error:
        return str(error)
    with contextlib.suppress(OSError):  # a cache that may only be read
        os.utime(path)
    return loaded


@functools.lru_cache(maxsize=1)
def _deadline() -> float:
    return time.monotonic() + PATIENCE


@functools.lru_cache(maxsize=1)
def _first_error(log: Path) -> str:
    text = log.read_text(errors="replace") if log.is_file() else ""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return next((line for line in lines if "error" in line), lines[0] if lines else "the compiler failed")[:200]


def _found(wait: bool) -> ctypes.CDLL | str | None:
    """The library, why there cannot be one, or None while it is being built."""
    target = _target()
    if not target.is_file():
        with _starting:  # two threads that ask at once must not both begin
            build = _builder(target)
        if isinstance(build, str):
            return build
        if not _ended(build, GIVE_UP if wait else max(0.0, _deadline() - time.monotonic())):
            return f"the compiler has not finished in {GIVE_UP:.0f} s" if wait else None
        if not target.is_file():
            return _first_error(_log(target))
    return _load(target)


def library(wait: bool = False) -> ctypes.CDLL | None:
    """The compiled library; None, after one warning, where there cannot be one, and without a word while it is being built.

    wait: until the build is finished, however long it takes; otherwise PATIENCE seconds at most, all calls together.
    """
    if os.environ.get("TORCHROD_FAST", "1") == "0":
        return None
    if _loaded:
        return _loaded[0]
    try:
        found = _found(wait)
    except OSError as error:
        found = str(error)
    if isinstance(found, str):
        _say_once(found)
        return None
    if found is not None:
        _loaded.append(found)
    return found


def available() -> bool:
    """Whether the kernel serves now."""
    return library() is not None
