"""Keys by value: what has been worked out from tensors is kept by the numbers that they held, not by which tensors they were.

A tensor that is changed in place, through numpy or by whatever way, has another key; equal numbers have the same one, whatever
precision they came in.
"""

from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any

import torch
from torch import Tensor


@cache
def _names(kind: type) -> tuple[str, ...] | None:
    """The fields of a dataclass; None for another type."""
    return tuple(f.name for f in fields(kind)) if is_dataclass(kind) else None


def key(value: Any) -> Any:
    """Something hashable that equals that of another value where all numbers are equal.

    value: tensors, dataclasses and tuples of them, and whatever is hashable itself.
    """
    if isinstance(value, Tensor):
        return value.dtype, tuple(value.shape), value.detach().contiguous().numpy().tobytes()
    if isinstance(value, tuple):
        return tuple([key(v) for v in value])
    if (names := _names(type(value))) is not None:
        return type(value), *[key(getattr(value, name)) for name in names]
    try:
        hash(value)
    except TypeError:
        return object()  # an object of a user's own that cannot be told from another: nothing is kept of it
    return value


class Kept:
    """The last few results of a function, by key. Results outlive the call, so they are worked out outside of inference mode."""

    def __init__(self, most: int = 32):
        self._most, self._results = most, dict[Any, Any]()

    def __call__(self, of: Any, work_out: Any) -> Any:
        """work_out(), or what it returned the last time for the same key `of`."""
        found = self._results.pop(of, None)
        if found is None:
            with torch.inference_mode(False):
                found = work_out()
            while len(self._results) >= self._most:
                self._results.pop(next(iter(self._results)), None)
        self._results[of] = found  # the latest last
        return found
