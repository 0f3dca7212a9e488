"""Jacobians of batched functions by forward-mode automatic differentiation."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import jvp, vmap


def forward_jacobian(
    function: Callable[[Float[Tensor, "B n"]], Float[Tensor, "B m"]], x: Float[Tensor, "B n"]
) -> tuple[Float[Tensor, "B m"], Float[Tensor, "B m n"]]:
    """Value (B, m) and Jacobian (B, m, n) of a function that maps each sample's n numbers to m numbers by itself.

    The function is batched already, so one unit tangent serves every sample at once: torch.func.vmap over the n tangents of
    torch.func.jvp, in which the primal is computed once. No second vmap over samples is needed.
    """

    def column(e: Float[Tensor, " n"]) -> tuple[Tensor, Tensor]:
        value, tangent, *_ = jvp(function, (x,), (e.expand_as(x).contiguous(),))
        return value, tangent

    value, columns = vmap(column, out_dims=(None, 0))(torch.eye(x.shape[-1], dtype=x.dtype))  # pyright: ignore[reportArgumentType]
    return value, columns.movedim(0, -1)


def pointwise_jacobian(
    function: Callable[[Float[Tensor, "... n"]], Float[Tensor, "... m"]], x: Float[Tensor, "B n"]
) -> tuple[Float[Tensor, "B m"], Float[Tensor, "B m n"]]:
    """The same for a function of any leading dimensions that knows nothing of the batch: one backward pass for all of its outputs.

    The primal is computed once more for every output, which for the few cheap operations it is meant for costs less than
    torch.func's transforms.
    """
    with torch.no_grad():
        value = function(x)
    m = value.shape[-1]
    with torch.enable_grad():
        leaf = x.detach().expand(m, *x.shape).contiguous().requires_grad_()
        each = function(leaf).diagonal(dim1=0, dim2=-1)
        rows = torch.autograd.grad(each.sum(), leaf)[0] if m else leaf.detach()
    return value, rows.movedim(0, 1)
