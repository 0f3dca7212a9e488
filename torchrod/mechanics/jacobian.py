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


def moved_along(
    function: Callable[..., Float[Tensor, "B m"]], at: tuple[Tensor, ...], tangents: tuple[Float[Tensor, "n ..."], ...]
) -> tuple[Float[Tensor, "B m"], Float[Tensor, "B m n"]]:
    """Value, and the derivatives along n tangents, of a function of several tensors that move at once.

    Backwards twice: the pull-back J^T v is linear in v, and its own pull-back of a tangent t is J t. The same as torch.func.jvp,
    which works out in Python which shape the zero tangent has of everything that stays where it is: 50 ms a call, however few the
    samples.
    """
    with torch.enable_grad():
        leaves = [x.detach().requires_grad_() for x in at]
        value = function(*leaves)
        if not (value.requires_grad and len(tangents[0])):
            return value.detach(), value.new_zeros(*value.shape, len(tangents[0]))
        v = torch.zeros_like(value, requires_grad=True)
        pulled = torch.autograd.grad(value, leaves, v, create_graph=True, materialize_grads=True)
    used = [(p, t) for p, t in zip(pulled, tangents, strict=True) if p.requires_grad]
    (columns,) = torch.autograd.grad([p for p, _ in used], v, [t for _, t in used], is_grads_batched=True)
    return value.detach(), columns.movedim(0, -1)
