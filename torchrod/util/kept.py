"""What has been worked out from tensors, kept for as long as they are as they were."""

from collections.abc import Callable
from itertools import count
from typing import TypeVar

import torch
from torch import Tensor

T = TypeVar("T")
_unknown = count(-1, -1)


def version(x: Tensor) -> int:
    """A number that changes when x is changed in place; a new one each time for a tensor of inference mode, which does not tell."""
    return next(_unknown) if x.is_inference() else x._version


def versions(*values: object) -> tuple[int, ...]:
    """Those of the tensors among some values."""
    return tuple(version(x) for x in values if isinstance(x, Tensor))


def kept(owner: object, name: str, x: Tensor, work_out: Callable[[Tensor], T]) -> T:
    """work_out(x), which the owner of x (a dataclass, frozen or not) keeps beside its fields until x is changed in place."""
    now, found = version(x), vars(owner).get(name)
    if found is None or found[0] != now:
        with torch.inference_mode(False):  # a tensor of inference mode must not be met by autograd later
            found = now, work_out(x)
        vars(owner)[name] = found
    return found[1]
