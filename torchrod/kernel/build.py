"""The compiled library: built from the C++ beside this file with the machine's own compiler, kept in a folder, loaded with ctypes.

The first call that needs the library builds it and waits, about 20 s once per machine; `torchrod build` does it beforehand. Where
there is no compiler the torch path serves, more slowly, and one warning says so. TORCHROD_FAST=0 switches the library off;
TORCHROD_CACHE names another folder for it (default ~/.cache/torchrod).

Code is run from that folder. So a library is loaded only if folder and file belong to this user or root, nobody else may write to
them, no parent lets every user put another folder in its place, and the file has the checksum that was written beside it when it
was built.

This module imports nothing but the standard library: pip's build runs it before torch is there (hatch_build.py).
"""

import contextlib
import ctypes
import functools
import hashlib
import multiprocessing
import os
import platform
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

FOLDER = Path(__file__).parent
SOURCES = sorted([*FOLDER.glob("*.h"), *FOLDER.glob("*.cpp")])
FLAGS = ("-O3", "-march=native", "-std=c++17", "-shared", "-fPIC", "-fno-math-errno", "-pthread", "-Wno-psabi")
GIVE_UP = 300.0  # s after which a compiler, or another process that builds, is held to be dead
KEPT = 90 * 24 * 3600.0  # s after which a library that nobody has loaded is deleted
LINE = "torchrod: compiling the kernel (once per machine, about 20 s)"

Check = Callable[[ctypes.CDLL], str | None]  # what is wrong with a library; None: nothing
_asking = threading.Lock()
_found: list[ctypes.CDLL | str] = []  # the library, or why there is none, once that is known: a look at the files takes 1 ms


class RefusedError(Exception):
    """A folder or a file from which no code may be run."""


def _unlock() -> None:
    """In a process that was forked while another thread of its parent held the lock."""
    global _asking
    _asking = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_unlock)


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


def _folder() -> Path:
    """Where libraries are kept, with no symbolic link in it."""
    given = os.environ.get("TORCHROD_CACHE")
    try:
        return Path(given or Path.home() / ".cache" / "torchrod").resolve()
    except RuntimeError:  # a container's user may have no home
        return (Path(tempfile.gettempdir()) / f"torchrod-{os.getuid()}").resolve()


@functools.lru_cache(maxsize=1)
def target() -> Path:
    """The file of the library of these sources, this compiler and this processor."""
    parts = [source.read_bytes() for source in SOURCES]
    parts.append(repr((FLAGS, _compiler(), platform.machine(), _processor())).encode())
    return _folder() / f"kernel-{hashlib.sha256(b''.join(parts)).hexdigest()[:16]}.so"


def _checksum(library: Path) -> Path:
    """The file of its SHA-256."""
    return library.with_suffix(".sha256")


def _log(library: Path) -> Path:
    """What the compiler printed when it last failed."""
    return library.with_suffix(".log")


def _own(about: os.stat_result, path: Path, remedy: str) -> None:
    """Errors: RefusedError where a user other than this one and root owns the path or may write to it."""
    if about.st_uid not in (os.getuid(), 0):
        raise RefusedError(f"{path} belongs to another user; {remedy}")
    if about.st_mode & 0o022:
        raise RefusedError(f"other users may write to {path}; check what is in it, then chmod go-w {shlex.quote(str(path))}")


def _own_folder(folder: Path) -> None:
    """Errors: RefusedError for a folder that others can fill or replace."""
    _own(folder.stat(), folder, "set TORCHROD_CACHE to a folder of your own")
    for parent in folder.parents:
        mode = parent.stat().st_mode
        if mode & 0o002 and not mode & stat.S_ISVTX:
            raise RefusedError(f"any user can replace {folder}, for anybody may write to {parent}; set TORCHROD_CACHE")


def _made(folder: Path) -> None:
    """Make a folder and its parents where they are not there, for this user alone whatever the umask."""
    for path in (*reversed(folder.parents), folder):
        try:
            path.mkdir(mode=0o700)
        except FileExistsError:
            continue
        except OSError:
            if not path.is_dir():  # a root folder that may only be read
                raise
        else:
            path.chmod(0o700)


def _whole(library: Path) -> bool:
    """Whether the file is there as it was built. Errors: RefusedError for one that others may have written."""
    try:
        handle = os.open(library, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    except OSError as error:
        raise RefusedError(f"{library}: {error.strerror}; delete it") from None
    with os.fdopen(handle, "rb") as file:
        _own(os.fstat(handle), library, "delete it")
        try:
            expected = _checksum(library).read_text().strip()
        except (OSError, UnicodeDecodeError):
            return False
        return hashlib.sha256(file.read()).hexdigest() == expected


def _loaded(library: Path, check: Check) -> ctypes.CDLL | str:
    """The library, or what is wrong with it."""
    try:
        found = ctypes.CDLL(str(library))
    except OSError as error:
        return str(error)
    return check(found) or found


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """While no other process builds in the folder; where it cannot be locked (some network file systems) two may, to no harm."""
    import fcntl

    handle, end = os.open(folder, os.O_RDONLY | os.O_CLOEXEC), time.monotonic() + GIVE_UP
    try:
        while time.monotonic() < end:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                time.sleep(0.05)
            except OSError:
                break
        yield
    finally:
        with contextlib.suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_UN)  # a fork has the handle as well: to close it alone would not release the lock
        os.close(handle)


def _run(command: list[str], messages: Path) -> int:
    """The exit status of a compiler, whose processes end with the wait for it: Ctrl-C leaves none behind."""
    path = os.pathsep.join(filter(None, (os.environ.get("PATH"), "/usr/bin", "/bin")))
    with messages.open("wb") as stderr:  # not a pipe, which a talkative compiler fills
        files = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": stderr}
        process = subprocess.Popen(command, env=os.environ | {"PATH": path}, start_new_session=True, **files)
    try:
        return process.wait(GIVE_UP)
    except BaseException:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        raise


def _first_error(messages: Path) -> str:
    text = messages.read_text(errors="replace")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return next((line for line in lines if "error" in line), lines[0] if lines else "the compiler failed")[:200]


def _clear(library: Path) -> None:
    """Delete what nobody has loaded for long: of other sources, compilers and processors, and what a killed build has left."""
    for path in library.parent.glob("kernel-*"):
        with contextlib.suppress(OSError):
            if path.stem != library.stem and time.time() - path.lstat().st_mtime > KEPT:
                path.unlink()


def _built(library: Path, check: Check) -> ctypes.CDLL | str:
    """Compile, check and load; what fails never takes the library's name."""
    compiler = _compiler()
    if compiler is None:
        return "no C++ compiler was found"
    try:
        words = shlex.split(compiler)
    except ValueError as error:
        return f"CXX={compiler}: {error}"
    # No process number: containers that share a home have the same ones. dlopen knows a library by its name, so that only one of a
    # new name is certainly read anew.
    part = library.with_name(f"{library.stem}.{uuid.uuid4().hex}.part")
    messages = part.with_suffix(".messages")
    try:
        if _run([*words, *FLAGS, str(FOLDER / "kernel.cpp"), "-o", str(part)], messages) != 0 or not part.is_file():
            messages.replace(_log(library))
            return _first_error(_log(library))
        part.chmod(0o700)
        digest = hashlib.sha256(part.read_bytes()).hexdigest()
        found = _loaded(part, check)
        if isinstance(found, str):
            return found
        beside = part.with_suffix(".sha256")
        beside.write_text(digest + "\n")
        beside.chmod(0o600)
        beside.replace(_checksum(library))
        part.replace(library)
        _log(library).unlink(missing_ok=True)
        _clear(library)
        return found
    except subprocess.TimeoutExpired:
        return f"the compiler has not finished in {GIVE_UP:.0f} s"
    finally:
        for path in (part, messages):
            path.unlink(missing_ok=True)


def _say() -> None:
    """The one line about the wait; not in each process of a pool."""
    if sys.stderr is not None and multiprocessing.parent_process() is None:
        print(LINE, file=sys.stderr, flush=True)  # noqa: T201


def _sound(library: Path, check: Check) -> ctypes.CDLL | None:
    """The library as it lies in the folder; None: it has to be built."""
    _own_folder(library.parent)
    if not _whole(library) or isinstance(found := _loaded(library, check), str):
        return None
    for path in (library, _checksum(library)):
        with contextlib.suppress(OSError):  # a folder that may only be read
            os.utime(path)
    return found


def _search(check: Check) -> ctypes.CDLL | str:
    if os.name != "posix":
        return "it is built on Linux and macOS only"
    try:
        library = target()
        if library.parent.is_dir() and (found := _sound(library, check)) is not None:
            return found
        if _compiler() is None:
            return "no C++ compiler was found"
        _say()
        _made(library.parent)
        _own_folder(library.parent)
        with _alone(library.parent):
            return _sound(library, check) or _built(library, check)
    except (OSError, RefusedError) as error:
        return str(error)


def find(check: Check) -> ctypes.CDLL | str:
    """The library, built where it is not there or fails the check, or why there is none; the same answer at every call."""
    if not _found:
        with _asking:  # two threads that ask at once must not both build
            if not _found:
                _found.append(_search(check))
    return _found[0]


def off() -> bool:
    """Whether TORCHROD_FAST=0 switches the kernel off."""
    return os.environ.get("TORCHROD_FAST", "1") == "0"
