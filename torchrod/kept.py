"""Whether a tensor is as it was when something that is kept was worked out from it."""

from itertools import count

import torch

_unknown = count(-1, -1)


def version(x: torch.Tensor) -> int:
    """A number that changes when x is changed in place; a new one each time for a tensor of inference mode, which does not tell."""
    return next(_unknown) if x.is_inference() else x._version
