"""The paper's coordinates: (11), its range, its start, and what makes no sense."""

import math
from typing import Any

import pytest
import torch

from tests.robots import T
from torchrod import GaussianLoads, InputError, PaperCoordinates

ARGUMENTS: dict[str, Any] = dict(width=0.02, eps=0.3, beta1=-0.01, beta2=0.43)


def centre(c: PaperCoordinates, eta: torch.Tensor) -> torch.Tensor:
    zero = 0 * eta
    (load,) = c.loads(torch.stack([zero, zero, eta, zero + 100.0], -1))
    assert isinstance(load, GaussianLoads)
    return load.mu[..., 0]


def test_the_centre_is_the_algebraic_sigmoid():
    """(11) by hand: between its bounds, rising, and with the slope that eps sets."""
    c = PaperCoordinates(1, 0.4, **ARGUMENTS)
    eta = torch.linspace(-30, 30, 121)
    mu = centre(c, eta)
    assert torch.allclose(mu, 0.22 * eta / (0.3 + eta**2).sqrt() + 0.21, rtol=1e-14)
    assert (mu.diff() > 0).all()
    assert mu[0] > -0.01
    assert mu[-1] < 0.43
    assert abs(float(centre(c, T(1e-6)) - centre(c, T(-1e-6))) / 2e-6 - 0.22 / math.sqrt(0.3)) < 1e-6
    assert torch.allclose(c.describe(torch.stack([eta, eta, eta, 0 * eta + 100.0], -1)).location[..., 0], mu)


def test_the_range_is_the_rod_unless_asked():
    c = PaperCoordinates(1, 0.4)
    assert c.range == (0.0, 0.4)
    assert torch.allclose(centre(c, T([-1e6, 0.0, 1e6])), T([0.0, 0.2, 0.4]), atol=1e-9)


def test_a_cold_start_is_spread_over_the_range():
    c = PaperCoordinates(3, 0.4, **ARGUMENTS)
    report = c.describe(c.start())
    assert torch.allclose(report.location, T([0.1, 0.21, 0.32]))
    assert torch.allclose(report.width, T([0.02, 0.02, 0.02]))
    assert (report.force == 0).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(eps=0.0), "eps is 0.0; give a positive number"),
        (dict(eps=-1.0), "eps is -1.0"),
        (dict(eps=math.nan), "eps is nan"),
        (dict(width=0.0), "width is 0.0"),
        (dict(beta1=0.3, beta2=0.3), "beta1 below"),
        (dict(beta1=0.5, beta2=0.3), "beta1 below"),
        (dict(beta2=math.inf), "finite"),
        (dict(beta1=math.nan), "finite"),
        (dict(beta1=400.0, beta2=800.0), "misses the rod"),
        (dict(beta1=-0.4, beta2=-0.1), "misses the rod"),
    ],
)
def test_nonsense_is_told(change, words):
    with pytest.raises(InputError, match=words):
        PaperCoordinates(1, 0.4, **{**ARGUMENTS, **change})
