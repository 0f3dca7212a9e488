"""Files on the disk: read or written as a whole, and in one sentence what is wrong where that fails."""

import errno
import io
import os
import stat
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from .errors import InputError

MOST_LINKS = 40  # as the system: who follows more goes in a circle
REMEDIES = {
    errno.ENOSPC: "free some space on its disk",
    errno.EDQUOT: "free some space, your share of its disk is used up",
    errno.ENAMETOOLONG: "give a shorter name",
    errno.EROFS: "give a place that can be written to",
    errno.ELOOP: "mend the links on its way",
    errno.EISDIR: "give a file, not a folder",
}
DENIED = (errno.EACCES, errno.EPERM)


def reason(error: OSError, remedy: str, denied: str) -> str:
    """What is wrong, and what to do about it: `denied` without permission, `remedy` where the system's answer suggests nothing."""
    given = denied if error.errno in DENIED else REMEDIES.get(error.errno or 0, remedy)
    return f"({error.strerror or error}); {given}"


def _named(path: str | Path, done: str) -> None:
    """Refuse what no file can be called."""
    if "\0" in str(path):
        raise InputError(f"{path}: cannot be {done} (no file has a NUL in its name); check the path")


@contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Within it, an OSError says that this file cannot be read. Errors: InputError."""
    _named(path, "read")
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be read {reason(error, 'check the path', 'ask for the permission to read it')}") from None


@contextmanager
def writing(path: str | Path) -> Iterator[None]:
    """Within it, an OSError says that this file cannot be written. Errors: InputError."""
    _named(path, "written")
    try:
        yield
    except OSError as error:
        said = reason(error, "check the folder and the space on its disk", "choose a file in a folder that you may write to")
        raise InputError(f"{path}: cannot be written {said}") from None


def put(path: str | Path, write: Callable[[IO[bytes]], object]) -> None:
    """Write a file as a whole: beside its place, then moved there, so that a reader sees all of it or what was there before.

    Of a link to a file, the file is replaced. A device or a pipe is written to as it is. Errors: InputError naming path and remedy.
    """
    with writing(path):
        place = _place(Path(path))
        if place is not None:
            _replace(place, write)
            return
        whole = io.BytesIO()  # a pipe cannot be sought in, as archives and figures need it
        write(whole)
        with Path(path).open("wb") as file:
            file.write(whole.getbuffer())


def put_text(path: str | Path, text: str) -> None:
    """The same for a text, as UTF-8 with the line ends that it has."""
    put(path, lambda file: file.write(text.encode()))


def _place(path: Path) -> Path | None:
    """The file to replace, at the end of all links; None where it is none, or belongs to a process: /dev/stdout leads to /proc."""
    for _ in range(MOST_LINKS):
        path = Path(os.path.realpath(path.parent)) / path.name
        if path.parts[1:2] == ("proc",):
            return None
        try:
            mode = path.lstat().st_mode
        except FileNotFoundError:
            return path
        if not stat.S_ISLNK(mode):
            return path if stat.S_ISREG(mode) else None
        path = path.parent / path.readlink()
    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))


def _replace(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    there = path.exists()
    if there and not os.access(path, os.W_OK):  # replacing would go around its write protection
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    beside = path.with_name(f".{uuid.uuid4().hex}")  # short: the name itself may be as long as names can be
    try:
        with beside.open("xb") as file:
            write(file)
        if there:
            with suppress(OSError):  # not every file system has permissions
                beside.chmod(stat.S_IMODE(path.stat().st_mode))
        beside.replace(path)
    finally:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
