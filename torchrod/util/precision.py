"""float64 for physics, whatever precision numbers come in."""

from typing import overload

import torch
from torch import Tensor

DTYPE = torch.float64


@overload
def as_float64(x: Tensor) -> Tensor: ...
@overload
def as_float64(x: None) -> None: ...
def as_float64(x: Tensor | None) -> Tensor | None:
    """The same numbers in float64; the tensor itself where it is of that type."""
    return None if x is None else x.to(DTYPE)


def plain(x: Tensor) -> bool:
    """Whether the numbers of a tensor can be looked at: not within torch.func's transforms, where they stand for others."""
    return not torch._C._functorch.is_functorch_wrapped_tensor(x)  # pyright: ignore[reportAttributeAccessIssue]


class Float64:
    """A frozen dataclass whose tensors of numbers are made float64; flags stay flags. Errors: ValueError for complex numbers."""

    def __post_init__(self):
        for name, value in vars(self).items():
            if isinstance(value, Tensor) and value.is_complex():
                raise ValueError(f"{type(self).__name__}.{name} is complex; give real numbers")
            if isinstance(value, Tensor) and value.dtype not in (DTYPE, torch.bool):
                object.__setattr__(self, name, value.to(DTYPE))
