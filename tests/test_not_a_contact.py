"""What two lateral contacts are made of that are none: a force at the tip, and a section that is not what the file says."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import torchrod as tr
from tests.problems import posed
from tests.robots import T, steel_rod
from torchrod.analysis.pipeline import Analysis, analyze, contact_hypotheses

S = torch.linspace(0.02, 0.4, 20, dtype=torch.float64)


def found(positions: torch.Tensor, noise: float, contacts: str | int = "auto") -> Analysis:
    problem = posed(S, positions, noise)
    return analyze(problem, contact_hypotheses(problem, contacts))


def noisy(p: torch.Tensor, noise: float) -> torch.Tensor:
    return p + noise * torch.randn(p.shape, generator=torch.Generator().manual_seed(2))


def test_an_oblique_push_on_the_tip_is_no_pair_of_contacts():
    """Dead tip forces of random size and direction, none nearly square to the rod, which one contact at the tip would explain."""
    random, B = torch.Generator().manual_seed(4), 6
    size, tilt = 0.4 + 0.8 * torch.rand(B, generator=random), 0.3 + 0.6 * torch.rand(B, generator=random)
    force = torch.stack([size * tilt.sin(), 0 * size, -size * tilt.cos()], -1)
    wrench = tr.PointWrenches(force[:, None], 0 * force[:, None], T([0.4]))
    a = found(noisy(tr.solve_shape(steel_rod(), (wrench,), None, S, B, 160).p, 5e-4), 5e-4)
    fit = a.estimate
    assert fit.tip is not None
    assert bool(fit.accepted.all())
    assert bool(fit.force.isnan().all())
    assert float((fit.tip[:, :3] - force).norm(dim=-1).max()) < 0.1
    assert all("force at the tip explains the shape with fewer contacts" in a.message(b) for b in range(B))


def test_two_pushes_stay_two_pushes():
    F, at = T([[[0.8, 0.1, 0.0], [0.3, -0.9, 0.0]], [[-0.7, 0.0, 0.0], [0.9, 0.6, 0.0]]]), T([[0.15, 0.32], [0.18, 0.36]])
    a = found(noisy(tr.solve_shape(steel_rod(), (tr.PointForces(F, at),), None, S, 2, 160).p, 4e-4), 4e-4)
    assert torch.isfinite(a.estimate.force[:, :, 0]).sum(-1).tolist() == [2, 2]
    assert a.estimate.tip is None
    assert not any("tip" in a.message(b) or "not a contact" in a.message(b) for b in range(2))


def tapered(taper: float, force: float, at: float) -> np.ndarray:
    """A planar elastica whose diameter falls to `taper` of 1.4 mm at the tip, a dead force along x at `at`; markers (20, 3)."""

    def bent(z_at: float, places: np.ndarray) -> np.ndarray:
        def rate(s: float, y: np.ndarray) -> list[float]:
            EI = 207e9 * np.pi / 64 * (1.4e-3 * (1 + (taper - 1) * s / 0.4)) ** 4
            turning = force * (z_at - y[2]) / EI if s < at else 0.0
            return [turning, np.sin(y[0]), np.cos(y[0])]

        return solve_ivp(rate, (0, 0.4), [0.0, 0.0, 0.0], t_eval=places, rtol=1e-9, atol=1e-11, max_step=5e-3).y

    z = brentq(lambda z: bent(z, np.array([at]))[2, -1] - z, 0.3 * at, at)
    _, x, height = bent(float(z), S.numpy())  # pyright: ignore[reportArgumentType]
    return np.stack([x, 0 * x, height], -1)


@pytest.mark.parametrize(("contacts", "least"), [("auto", 3), (1, 1)])
def test_a_couple_is_said_to_be_no_contact(contacts: str | int, least: int):
    cases = [(0.5, 0.2, 0.28), (0.45, 0.12, 0.3), (0.5, 0.1, 0.3), (0.48, 0.15, 0.27)]
    p = torch.tensor(np.stack([tapered(*case) for case in cases]))
    a = found(noisy(p, 5e-4), 5e-4, contacts)
    said = [a.message(b) for b in range(len(cases))]
    assert sum("not a contact near" in words for words in said) >= least, said
    assert not any("try more --contacts" in words for words in said if "not a contact" in words)
