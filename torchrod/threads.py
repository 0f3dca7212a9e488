"""How many threads torch works with."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread(wanted: bool = True) -> Iterator[None]:
    """Within it torch works on one thread, then as before; not wanted: no difference.

    A matrix of ten unknowns is not worth sharing: beside a busy neighbour the second thread keeps the first waiting for
    milliseconds.
    """
    before = torch.get_num_threads()
    if not wanted or before == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
