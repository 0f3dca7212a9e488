"""Derivatives through the compiled kernel's operators: the first in every way that torch has, the second refused in every way."""

import pytest
import torch
from torch.autograd import forward_ad

from tests.robots import steel_rod
from tests.test_fast import needs_compiler
from tests.test_fit import B, case, close
from torchrod import GaussianCoordinates, Registration, kernel
from torchrod.estimation.evaluator import KernelEvaluator

pytestmark = needs_compiler


@pytest.fixture(scope="module")
def problem():
    torch.set_default_dtype(torch.float64)
    posed, x = case(steel_rod(), GaussianCoordinates(1, 0.4, 1.0), registration=Registration())
    tables = KernelEvaluator(posed, nu=4.0).tables(x)
    h, H = posed.linearized(x)
    return x, tables, h, H


def operator(x, tables, slopes=True):
    return torch.ops.torchrod.measure(x, torch.arange(B), slopes, tables.tensors, tables.counts, tables.numbers)


def cost(tables):
    return lambda x: (kernel.measured(x, torch.arange(B), tables) ** 2).sum()


def gradient(h, H):
    return 2 * (H.mT @ h.unsqueeze(-1)).squeeze(-1)


def test_first_derivatives_and_vmap_of_them(problem):
    x, tables, h, H = problem
    f, g = cost(tables), gradient(h, H)
    two = torch.stack([x, x])
    for transform in (torch.func.grad, torch.func.jacrev, torch.func.jacfwd):
        assert close(transform(f)(x), g)
        assert close(torch.func.vmap(transform(f))(two)[1], g)
    slope = torch.func.vmap(lambda x: torch.func.jvp(f, (x,), (x,))[1])(two)
    assert close(slope[1], (g * x).sum())


@pytest.mark.parametrize("outer", ["grad", "jacrev", "jacfwd"])
@pytest.mark.parametrize("inner", ["grad", "jacrev", "jacfwd"])
def test_second_derivatives_are_refused(problem, inner, outer):
    x, tables, _, _ = problem
    first = getattr(torch.func, inner)(cost(tables))
    with pytest.raises(RuntimeError, match="differentiable once"):
        getattr(torch.func, outer)(lambda x: first(x).sum())(x)


@pytest.mark.parametrize("way", ["measured", "operator"])
def test_a_backward_of_the_backward_is_refused(problem, way):
    x, tables, h, H = problem
    leaf = x.clone().requires_grad_()
    value = cost(tables)(leaf) if way == "measured" else (operator(leaf, tables)[0] ** 2).sum()
    (first,) = torch.autograd.grad(value, leaf, create_graph=True)
    assert close(first.detach(), gradient(h, H))
    with pytest.raises(RuntimeError, match="differentiable once"):
        torch.autograd.grad(first.sum(), leaf)


def test_a_pullback_is_differentiable_in_what_is_pulled_back(problem):
    x, tables, h, H = problem
    leaf, dh = x.clone().requires_grad_(), torch.ones_like(h).requires_grad_()
    (dx,) = torch.autograd.grad(kernel.measured(leaf, torch.arange(B), tables), leaf, dh, create_graph=True)
    assert close(torch.autograd.grad(dx.sum(), dh)[0], H.sum(-1))


def test_the_operator_refuses_what_it_cannot_differentiate(problem):
    x, tables, _, _ = problem
    leaf = x.clone().requires_grad_()
    for output in (1, 2):
        with pytest.raises(RuntimeError, match="differentiable once"):
            operator(leaf, tables)[output].sum().backward()
    with pytest.raises(RuntimeError, match="slopes=True"):
        operator(leaf, tables, slopes=False)[0].sum().backward()


@pytest.mark.filterwarnings("ignore")
def test_measured_may_be_compiled_whole_and_differentiated(problem):
    x, tables, h, H = problem
    f, leaf = cost(tables), x.clone().requires_grad_()
    torch.compile(f, backend="aot_eager", fullgraph=True)(leaf).backward()
    assert leaf.grad is not None
    assert close(leaf.grad, gradient(h, H))
    slope = torch.compile(lambda x: torch.func.jvp(f, (x,), (x,))[1], backend="aot_eager")(x)
    assert close(slope, (gradient(h, H) * x).sum())
    assert close(torch.compile(torch.func.grad(f), backend="aot_eager")(x), gradient(h, H))
    with forward_ad.dual_level():
        dual = torch.compile(lambda x: f(x), backend="aot_eager")(forward_ad.make_dual(x, x))
        tangent = forward_ad.unpack_dual(dual).tangent
        assert tangent is not None
        assert close(tangent, (gradient(h, H) * x).sum())


def test_normal_equations_of_several_x_at_once(problem):
    """Every one with the rows of its own samples."""
    x, tables, _, _ = problem

    def sums(x):
        return kernel.normal_equations(x, tables.tensors, tables.counts, tables.numbers)

    several = torch.stack([x, 0.9 * x, 1.1 * x], 1)
    for together, alone in zip(torch.func.vmap(sums, in_dims=1)(several), sums(0.9 * x), strict=True):
        assert torch.equal(together[1], alone)
