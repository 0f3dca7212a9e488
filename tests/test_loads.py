"""Every load family: closed-form integrals against quadrature, and derivatives against finite differences."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.robots import T, steel_rod
from torchrod import FourierLoads, GaussianLoads, PointForces, PointWrenches, PolynomialLoads, forward_jacobian, shape_from_base
from torchrod.mechanics.loads import on_rod_fraction

L = 0.4


def families(x: torch.Tensor) -> dict:
    """One load of each family from eight numbers of about unit size, (..., 8)."""
    width = 0.5 / (0.01 + 0.02 * torch.sigmoid(x[..., 3:4])) ** 2
    at = L * torch.sigmoid(x[..., 2:3])
    force = x[..., 4:7].unsqueeze(-2)
    return {
        "gaussian": GaussianLoads(10 * x[..., :2].unsqueeze(-2), at, width),
        "fourier": FourierLoads(x[..., :4].unflatten(-1, (2, 2)), x[..., 4:6].unflatten(-1, (2, 1)), L),
        "point": PointForces(force, at),
        "polynomial": PolynomialLoads(x[..., :6].unflatten(-1, (2, 3)), L),
        "local wrench": PointWrenches(force, 0.1 * x[..., 5:8].unsqueeze(-2), T([0.17]), frame="local"),
        "base wrench": PointWrenches(force, 0.1 * x[..., 5:8].unsqueeze(-2), T([0.17]), frame="base"),
    }


NAMES = list(families(torch.zeros(8)))


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-2, 2), min_size=8, max_size=8), st.sampled_from(["gaussian", "fourier", "polynomial"]))
def test_integrals_of_a_density(numbers, name):
    """G and G2 are the first and second integral of density(), whatever the parameters."""
    load = families(T(numbers, dtype=torch.float64))[name]
    s = torch.linspace(0, L, 8001, dtype=torch.float64)
    stages = torch.stack([s[:-1], (s[:-1] + s[1:]) / 2, s[1:]], -1)
    integrals = load.integrals(stages, stages)
    f = load.density(stages.flatten()).unflatten(0, (-1, 3))
    h = s[1] - s[0]

    def simpson(y):
        return torch.cumsum(h / 6 * (y[:, 0] + 4 * y[:, 1] + y[:, 2]), 0)

    assert torch.allclose(integrals.G[:, 2], simpson(f), atol=1e-9)
    assert torch.allclose(integrals.G2[:, 2], simpson(integrals.G), atol=1e-9)
    assert (integrals.G[0, 0] == 0).all()
    assert (integrals.G2[0, 0] == 0).all()


def test_a_narrow_gaussian_becomes_a_point_force():
    s = T([[0.1, 0.1, 0.1], [0.3, 0.3, 0.3]])
    force = T([[0.3, -0.4, 0.0]])
    sigma = 1e-5
    narrow = GaussianLoads(force[:, :2] / (sigma * math.sqrt(2 * math.pi)), T([0.2]), T([0.5 / sigma**2])).integrals(s, s)
    point = PointForces(force, T([0.2])).integrals(s, s)
    for one, other in ((narrow.G, point.G), (narrow.G2, point.G2)):
        assert one is not None
        assert other is not None
        assert torch.allclose(one, other, atol=1e-9)


def test_net_force_is_the_papers_13_and_the_rod_feels_less_at_the_tip():
    load = GaussianLoads(T([[3.0, 4.0]]), T([0.4]), T([800.0]))
    tip = torch.full((1, 3), L)
    whole = load.integrals(tip, tip).G
    assert whole is not None
    felt = whole[0, 0, :2]
    assert torch.allclose(load.net_force()[0], T([3.0, 4.0]) * math.sqrt(math.pi / 800))
    assert torch.allclose(felt, load.net_force()[0] * on_rod_fraction(load.mu, load.c, L))
    assert abs(float(on_rod_fraction(load.mu, load.c, L)) - 0.5) < 1e-9


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_are_those_of_differences(name):
    """Forward-mode derivatives of the whole rod in every parameter, alpha included."""
    robot, s = steel_rod(), T([0.1, 0.25, 0.4])

    def h(x):
        shape = shape_from_base(robot, (families(x[..., :8])[name],), x[..., 8:] * T([1, 1, 1, 0.2, 0.2, 0.2]), None, s, 4)
        return torch.cat([shape.p.flatten(-2), shape.tip_residual], -1)

    x = T([[0.7, -0.4, 0.31, 0.2, 0.5, -0.6, 0.1, 0.4, 0.3, 0.2, 0.1, 0.3, -0.2, 0.1]])
    step = 1e-6 * torch.eye(x.shape[-1])
    slopes = (h(x + step) - h(x - step)) / 2e-6
    assert torch.allclose(slopes.mT, forward_jacobian(h, x)[1][0], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_at_zero_load_are_finite(name):
    robot, s = steel_rod(), T([0.1, 0.4])

    def h(x):
        return shape_from_base(robot, (families(x[..., :8])[name],), x[..., 8:], None, s, 8).p

    J = torch.func.jacfwd(h)(torch.zeros(1, 14))
    assert torch.isfinite(J).all()
    assert J[..., 8:].abs().max() > 0.1
