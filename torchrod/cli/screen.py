"""What a command says on the screen: after its files are written, and so that no screen can make it fail."""

import contextlib
import io
import os
import sys
from collections.abc import Iterator
from typing import TextIO

from ..util.errors import InputError
from ..util.files import reason


def one_line(text: str) -> str:
    """The text with line ends, and whatever else does not print, written out: names and paths may hold them."""
    return text if text.isprintable() else "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def tell(line: str) -> None:
    """A line on stderr, where there is one."""
    with contextlib.suppress(OSError, ValueError):
        if sys.stderr is not None:
            print(line, file=sys.stderr)  # noqa: T201


class _Held(io.StringIO):
    """Stands for standard output while a command runs."""

    def __init__(self, screen: TextIO | None):
        super().__init__()
        self._terminal = screen is not None and not screen.closed and screen.isatty()

    def isatty(self) -> bool:
        """As the screen that it stands for."""
        return self._terminal


@contextlib.contextmanager
def held_back() -> Iterator[None]:
    """Within it what is printed is kept, and printed at its end, however that is reached.

    A reader that has gone (`| head`) has seen enough. Errors: InputError where the text cannot be written, as on a full disk.
    """
    screen = sys.stdout
    with contextlib.redirect_stdout(_Held(screen)) as held:
        try:
            yield
        finally:
            text = held.getvalue()
            if text and screen is not None:
                _show(screen, text)


def _show(screen: TextIO, text: str) -> None:
    encoding = screen.encoding or "utf-8"
    try:
        screen.write(text.encode(encoding, "backslashreplace").decode(encoding))  # an ASCII terminal has no letter for a name
        screen.flush()
    except BrokenPipeError:
        _discard(screen)
    except OSError as error:
        _discard(screen)
        raise InputError(
            f"standard output: cannot be written {reason(error, 'check where it goes', 'check where it goes')}"
        ) from None


def _discard(screen: TextIO) -> None:
    """What is left in its buffer, or Python would try once more at the end and say so."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, screen.fileno())
        os.close(nowhere)
