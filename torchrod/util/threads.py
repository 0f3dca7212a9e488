"""How many threads torch works with, and how many the compiled kernel."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch

_before: ContextVar[int] = ContextVar("before")


def kernel_threads() -> int:
    """As many as torch has, or had before `one_thread`: the kernel brings its own."""
    return _before.get(torch.get_num_threads())


@contextmanager
def one_thread(wanted: bool = True, kernel: bool = False) -> Iterator[None]:
    """Within it torch works on one thread, then as before; not wanted: no difference. kernel: and so does the kernel.

    Small matrices are not worth sharing. Torch's second thread spins for milliseconds after each share, in the way of the kernel's
    own, and beside a busy neighbour it keeps the first waiting for as long.
    """
    before = torch.get_num_threads()
    if not wanted or before == 1:
        yield
        return
    token = _before.set(1 if kernel else before)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _before.reset(token)
