"""Derivatives and batching rules of the operators in fitting.py, for autograd, torch.func and torch.compile.

The kernel knows h and H = dh/dx, and nothing of how H moves. So h is differentiable once, in x and in nothing else, and whoever
asks for more gets a RuntimeError instead of a number: H is an output that counts as differentiable, and has no derivative.

- `measured`: backward and torch.autograd.grad; grad, vjp, jvp, jacrev and jacfwd of torch.func, and vmap of these. In torch.compile
  with fullgraph its values and backward; what torch.func does to it within a compiled function is left to eager torch.
- torchrod::measure with `slopes`, of h: backward and torch.autograd.grad, compiled as well; vmap of its values over x and index.
  Torch has neither grad nor jvp of torch.func for an operator: the one is an error, the other gives zeros. Use `measured`.
  A compiled function that returns its H or centre line has to detach them.
- torchrod::normal_equations: vmap and torch.compile of its values; no derivative.
"""

from typing import Any, NoReturn

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd import forward_ad

from .fitting import FitTables, measure, normal_equations


def _refuse() -> NoReturn:
    raise RuntimeError(
        "the compiled kernel is differentiable once, and only h(x): second derivatives, and those of H and of the centre line, "
        "need the torch path (Model.h)"
    )


def _batched(many: int, dims: tuple, *tensors: Tensor) -> list[Tensor]:
    """With the dimension that is mapped over in front, in all of them."""
    return [x.expand(many, *x.shape) if d is None else x.movedim(d, 0) for x, d in zip(tensors, dims[: len(tensors)], strict=True)]


@measure.register_vmap
def _(info, in_dims, x, index, slopes, tensors, counts, numbers):
    """The batch of batches is one batch; what is known along the rod does not differ between them."""
    if any(d is not None for d in in_dims[3]):
        raise RuntimeError("torchrod::measure: only x and index can be mapped over; call it in a loop")
    x, index = _batched(info.batch_size, in_dims, x, index)
    out = measure(x.flatten(0, 1), index.flatten(), slopes, tensors, counts, numbers)
    return tuple(o.unflatten(0, x.shape[:2]) for o in out), (0, 0, 0)


@normal_equations.register_vmap
def _(info, in_dims, x, tensors, counts, numbers):
    """One by one: the samples of every batch have the same rows of the tables."""

    def at(i: int, x: Tensor, d: int | None) -> Tensor:
        return x if d is None else x.select(d, i)

    each = [
        normal_equations(at(i, x, in_dims[0]), [at(i, t, d) for t, d in zip(tensors, in_dims[1], strict=True)], counts, numbers)
        for i in range(info.batch_size)
    ]
    return tuple(torch.stack(parts) for parts in zip(*each, strict=True)), (0,) * 5


def _keep_slopes(ctx, inputs, output):
    ctx.set_materialize_grads(False)  # None tells what nobody has differentiated
    ctx.save_for_backward(output[1])
    ctx.tables = len(inputs[3])


def _pull_back(ctx, dh, dH, dline):
    """The gradient in x, H^T dh."""
    (H,) = ctx.saved_tensors
    if dH is not None or dline is not None:
        _refuse()
    if H.shape[-1] == 0:
        raise RuntimeError("torchrod::measure has a derivative only with slopes=True")
    return None if dh is None else (H * dh.unsqueeze(-1)).sum(-2), None, None, [None] * ctx.tables, None, None


measure.register_autograd(_pull_back, setup_context=_keep_slopes)


class _Product(torch.autograd.Function):
    """sum(H v) over a dimension: a Function, so that forward mode can refuse to take along how H moves."""

    @staticmethod
    def forward(H, v, dim):  # pyright: ignore[reportIncompatibleMethodOverride]
        return (H * v.unsqueeze(-3 - dim)).sum(dim)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.set_materialize_grads(False)
        H, v, ctx.dim = inputs
        ctx.save_for_backward(H, v)
        ctx.save_for_forward(H)

    @staticmethod
    def backward(ctx, d):  # pyright: ignore[reportIncompatibleMethodOverride]
        (H, v), other = ctx.saved_tensors, -3 - ctx.dim
        return d.unsqueeze(ctx.dim) * v.unsqueeze(other), _Product.apply(H, d, other), None

    @staticmethod
    def jvp(ctx, dH, dv, _):  # pyright: ignore[reportIncompatibleMethodOverride]
        if dH is not None:
            _refuse()
        return _Product.apply(ctx.saved_tensors[0], dv, ctx.dim)

    @staticmethod
    def vmap(info, in_dims, H, v, dim):  # pyright: ignore[reportIncompatibleMethodOverride]
        return _Product.apply(*_batched(info.batch_size, in_dims, H, v), dim), 0


class _Measured(torch.autograd.Function):
    """h(x) with dh = H dx, in both modes; and H, so that a second derivative comes by here again."""

    @staticmethod
    def forward(x, index, tensors, counts, numbers):  # pyright: ignore[reportIncompatibleMethodOverride]
        h, H, _ = measure(x, index, True, tensors, counts, numbers)
        return h, H

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(output[1])
        ctx.save_for_forward(output[1])

    @staticmethod
    def backward(ctx, dh, dH):  # pyright: ignore[reportIncompatibleMethodOverride]
        if dH is not None:
            _refuse()
        return None if dh is None else _Product.apply(ctx.saved_tensors[0], dh, -2), None, None, None, None

    @staticmethod
    def jvp(ctx, dx, *_):  # pyright: ignore[reportIncompatibleMethodOverride]
        (H,) = ctx.saved_tensors
        return _Product.apply(H, dx, -1), torch.full_like(H, torch.nan)  # unknown: _Product refuses it

    @staticmethod
    def vmap(info, in_dims, x, index, tensors, counts, numbers):  # pyright: ignore[reportIncompatibleMethodOverride]
        x, index = _batched(info.batch_size, in_dims, x, index)
        h, H = _Measured.apply(x.flatten(0, 1), index.flatten(), tensors, counts, numbers)  # pyright: ignore[reportGeneralTypeIssues]
        return (h.unflatten(0, x.shape[:2]), H.unflatten(0, x.shape[:2])), (0, 0)


def _plain() -> bool:
    """Whether no transform of torch.func and no forward mode is under way."""
    within: Any = torch._C
    return within._functorch.maybe_current_level() is None and forward_ad._current_level < 0


def measured(x: Float[Tensor, "b n"], index: Int[Tensor, " b"], tables: FitTables) -> Float[Tensor, "b z"]:
    """h(x) of the samples `index`, differentiable once in x: by autograd, and by every transform of torch.func and vmap of it.

    Errors: RuntimeError for a second derivative in x, whichever way it is asked for.
    """
    arguments = (x, index, tables.tensors, tables.counts, tables.numbers)
    if not torch.compiler.is_compiling():
        return _Measured.apply(*arguments)[0]  # pyright: ignore[reportOptionalSubscript]
    if _plain():
        return measure(*arguments[:2], True, *arguments[2:])[0]
    # The operator has no forward mode, and the compiler drops that of a Function or cannot trace it: left to eager torch.
    eagerly: Any = torch.compiler.disable(_Measured.apply)
    return eagerly(*arguments)[0]
