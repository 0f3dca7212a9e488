"""Contacts that drag along the rod: a force F_z beside the lateral one, with a prior from the friction or free."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from tests.robots import steel_rod
from torchrod import (
    GaussianCoordinates,
    Markers,
    PointCoordinates,
    PointForces,
    Problem,
    Unknowns,
    analyze,
    contact_hypotheses,
    estimate,
    find_warm_start,
    read_dataset,
    sampled_intervals,
    simulate_shard,
    solve_shape,
)
from torchrod.cli import main
from torchrod.estimation.chart import Chart
from torchrod.mechanics.lie import rotate

L, MU = 0.4, 0.4
S = torch.linspace(L / 20, L, 20, dtype=torch.float64)


def pushes(cases: int, seed: int = 7) -> tuple[torch.Tensor, torch.Tensor]:
    """Forces (B, 1, 3) of 0.5 to 1 force scale that drag by N(0, (MU |F|)^2), and their places (B, 1)."""
    g, scale = torch.Generator().manual_seed(seed), steel_rod().rod.force_scale
    size, turn = scale * (0.5 + 0.5 * torch.rand(cases, 1, generator=g)), 2 * math.pi * torch.rand(cases, 1, generator=g)
    force = torch.stack([size * turn.cos(), size * turn.sin(), MU * size * torch.randn(cases, 1, generator=g)], -1)
    return force, L * (0.3 + 0.65 * torch.rand(cases, 1, generator=g))


def measured(force: torch.Tensor, place: torch.Tensor, noise: float) -> Markers:
    p = solve_shape(steel_rod(), (PointForces(force, place),), None, S, len(force)).p
    return Markers(S, p + noise * torch.randn(p.shape, generator=torch.Generator().manual_seed(3)), noise)


def problem_of(markers: Markers, friction: float | None, prior: str = "contact", count: int = 1) -> Problem:
    robot = steel_rod()
    return Problem(robot, Unknowns(GaussianCoordinates(count, L, robot.rod.force_scale, prior, friction=friction)), [markers])


def test_a_force_along_the_rod_bends_it_as_newton_has_it():
    """The shape under a lateral and an axial Gaussian against an integration of n' = -R f, m' = -p' x n in the base frame, by a
    scheme of order 8 that samples the density.
    """
    robot, family = steel_rod(), GaussianCoordinates(1, L, steel_rod().rod.force_scale, friction=MU)
    gamma = torch.tensor([[0.8, -0.3, 0.7, family.log_c, 1.4]])
    (load,) = family.loads(gamma)
    a, mu, c = load.a[0, 0].numpy(), float(load.mu[0, 0]), float(load.c[0, 0])  # pyright: ignore[reportAttributeAccessIssue]
    assert a[2] == pytest.approx(MU * math.hypot(a[0], a[1]) * 1.4, rel=1e-5)
    shape = solve_shape(robot, (load,), None, S, 1, 400)
    K_se, K_bt = (k.numpy() for k in (robot.rod.K_se, robot.rod.K_bt))

    def rate(s: float, y: np.ndarray) -> np.ndarray:
        R, n, m = y[3:12].reshape(3, 3), y[12:15], y[15:]
        v, u = np.linalg.solve(K_se, R.T @ n) + np.array([0, 0, 1]), np.linalg.solve(K_bt, R.T @ m)
        hat = np.array([[0, -u[2], u[1]], [u[2], 0, -u[0]], [-u[1], u[0], 0]])
        f = a * math.exp(-c * (s - mu) ** 2)
        return np.concatenate([R @ v, (R @ hat).ravel(), -R @ f, -np.cross(R @ v, n)])

    start = np.concatenate([np.zeros(3), np.eye(3).ravel(), shape.base_wrench[0].numpy()])
    exact = solve_ivp(rate, (0, L), start, "DOP853", S.numpy(), rtol=1e-11, atol=1e-13, max_step=L / 200)
    assert np.abs(exact.y[:3].T - shape.p[0].numpy()).max() < 1e-8
    assert np.abs(exact.y[12:, -1]).max() < 1e-7, "nothing acts beyond the tip"


FAMILIES = {
    "gaussian": lambda f: GaussianCoordinates(2, L, f, friction=MU),
    "gaussian, free": lambda f: GaussianCoordinates(1, L, f, locations=(0.3,), friction=math.inf),
    "points": lambda f: PointCoordinates(2, L, f, friction=MU),
    "points at known places": lambda f: PointCoordinates(1, L, f, (0.3,), friction=MU),
}


@pytest.mark.parametrize("kind", FAMILIES)
def test_entries(kind):
    family = FAMILIES[kind](steel_rod().rod.force_scale)
    mean, precision = family.prior()
    assert len(mean) == len(precision) == family.size == len(family.start())
    assert family.informative_priors == family.count * (kind.startswith("gauss") + ("free" not in kind))
    gamma = family.start() + 0.5
    again = family.rescaled(gamma, 2.0).unflatten(0, (family.count, -1))
    assert torch.equal(again[:, -1], torch.zeros(family.count)), "no drag where a fit is tried again"
    assert torch.allclose(again[:, :2], 2 * gamma.unflatten(0, (family.count, -1))[:, :2])


def test_coverage_and_what_it_costs():
    """95 % intervals of |F|, place and F_z hold where the friction is stated, and do not where loads are taken as normal."""
    force, place = pushes(150)
    markers, size = measured(force, place, 0.001 * L), force[..., :2].norm(dim=-1)
    held = {}
    for friction in (None, MU):
        fit = estimate(problem_of(markers, friction))
        assert (fit.status == 0).all()
        for name, interval, truth in (("F", fit.magnitude_interval, size), ("s", fit.location_interval, place)):
            held[name, friction] = float(((interval[..., 0] <= truth) & (truth <= interval[..., 1])).double().mean())
    assert fit.axial is not None
    assert fit.axial_std is not None
    inside = (fit.axial - force[..., 2]).abs() < 1.96 * fit.axial_std
    assert 0.89 < float(inside.double().mean()) <= 1
    assert 0.5 < float((fit.axial - force[..., 2]).std() / fit.axial_std.square().mean().sqrt()) < 1.3
    assert min(held["F", MU], held["s", MU]) > 0.9
    assert held["F", None] < 0.6
    assert held["s", None] < 0.75
    assert float(fit.iterations.double().mean()) < 10


def test_spread_of_the_axial_force_is_that_of_its_own_derivative():
    force, place = pushes(5)
    problem = problem_of(measured(force, place, 4e-4), MU)
    fit, family = estimate(problem), problem.unknowns.loads
    at, step = problem.state.loads.at, 1e-6 * torch.eye(family.size)
    gamma, C = fit.x[:, at], fit.covariance[:, at, at]
    up, down = (family.describe(gamma.unsqueeze(1) + sign * step).axial for sign in (1, -1))
    assert up is not None
    assert down is not None
    J = ((up - down) / 2e-6).squeeze(-1).unsqueeze(1)
    assert torch.allclose((J @ C @ J.mT).squeeze(-1).sqrt(), fit.axial_std, rtol=1e-6)  # pyright: ignore[reportArgumentType]


def test_a_push_without_drag_is_told_as_before():
    """Friction that nothing uses: a place within half a spread, wider spreads, and F_z = 0 +- mu |F|."""
    force, place = pushes(30)
    force[..., 2] = 0.0
    markers = measured(force, place, 0.0025 * L)
    plain, fit = estimate(problem_of(markers, None)), estimate(problem_of(markers, 0.05))
    assert ((plain.location - fit.location).abs() < 0.5 * plain.location_std).all()
    assert (fit.location_std > plain.location_std).all()
    assert fit.axial_std is not None
    assert (fit.axial_std < 0.051 * fit.magnitude).all()
    assert (fit.axial_std > 0.04 * fit.magnitude).all()


def test_number_of_loads_places_and_starts():
    """auto finds one and two of them; forces in the base frame hold F_z; the learned start serves with xi = 0."""
    force, place = pushes(6)
    two = torch.cat([force, force[:, :, [1, 0, 2]]], 1), torch.cat([0.12 + 0 * place, 0.3 + 0 * place], 1)
    p = torch.cat([solve_shape(steel_rod(), (PointForces(*f),), None, S, 6).p for f in ((force, place), two)])
    markers = Markers(S, p + 4e-4 * torch.randn(p.shape, generator=torch.Generator().manual_seed(3)), 4e-4)
    problem = problem_of(markers, MU)
    found = analyze(problem, contact_hypotheses(problem, "auto", friction=MU))
    fit, count = found.estimate, torch.isfinite(found.estimate.location).sum(-1)
    assert (count[:6] == 1).all()
    assert (count[6:] == 2).sum() >= 5
    assert fit.axial is not None
    assert torch.equal(fit.axial.isnan(), fit.location.isnan())
    there = fit.location[0, 0].clamp(0, L)
    own = problem.of(found.parts[1][0]).take(torch.tensor([0]))
    q = replace(own, sensors=[Markers(there.reshape(1), torch.zeros(1, 1, 3), 1.0)]).shape(fit.x[:1, : own.size], False).q
    pushed = torch.cat([fit.force[0, 0], fit.axial[0, :1]])
    assert torch.allclose(found.places.force[0, 0], rotate(q[0, 0], pushed), atol=1e-4 * float(pushed.norm()))
    one = problem.take(torch.arange(6))
    learned = find_warm_start(one)
    assert learned is not None
    start = learned(one)
    assert (start.origin == 1).all()
    assert torch.equal(start.x[:, 4], torch.zeros(6))
    cold = estimate(one)
    warm = estimate(one, start=learned)
    assert torch.allclose(warm.location, cold.location, atol=1e-4)
    assert warm.iterations.sum() < cold.iterations.sum()


@pytest.mark.parametrize("friction", [MU, math.inf])
def test_draws(friction):
    """Draws are worth having, their intervals of F_z as wide as those of the covariance where that is well known, and true."""
    force, place = pushes(16)
    problem = problem_of(measured(force, place, 1e-4), friction)
    fit = estimate(problem)
    chart = Chart.at(problem, fit.x)
    y = fit.x[:, None, : chart.size]
    y = y + 0.1 * torch.randn(16, 3, chart.size, generator=torch.Generator().manual_seed(1))
    again, log_det = chart.back(chart.to(y))
    assert torch.allclose(again, y, atol=1e-8)
    slope = torch.linalg.slogdet(chart.slope(y[:, 0]))[1]
    assert torch.allclose(log_det[:, 0], -slope, atol=1e-4)
    drawn = sampled_intervals(problem, fit)
    assert (drawn.k_hat < 0.7).sum() >= 13
    assert drawn.axial is not None
    assert fit.axial is not None
    assert fit.axial_std is not None
    half = 0.5 * (drawn.axial[..., 1] - drawn.axial[..., 0]) / 1.96
    assert 0.8 < float((half / fit.axial_std).median()) < 1.2
    inside = (drawn.axial[:, 0, 0] < force[:, 0, 2]) & (force[:, 0, 2] < drawn.axial[:, 0, 1])
    assert inside.sum() >= 13


ROD = """name = "rod"
[rod]
length = 0.4
diameter = 0.0014
youngs_modulus = 207e9
shear_modulus = 79e9
"""


@pytest.fixture
def files(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("r.toml").write_text(ROD)
    assert main(["simulate", "r.toml", "--point", "0.25", "0.6", "-0.3", "0.2", "--noise", "2e-5", "--out", "s.csv"]) == 0
    return tmp_path


def test_command_line_and_files(files, capsys):
    common = ["estimate", "r.toml", "s.csv", "--noise", "2e-5"]
    for suffix in ("json", "npz", "csv"):
        figure = ["--plot", "f.png"] if suffix == "json" else []
        assert main([*common, "--contact-friction", "0.5", "--out", f"r.{suffix}", *figure]) == 0
    assert "F_z (N)" in capsys.readouterr().out
    load = json.loads(Path("r.json").read_text())["results"][0]["loads"][0]
    z, std = load["force_axial_N"], load["std"]["force_axial_N"]
    assert len(load["force_local_N"]) == 2
    assert abs(z - 0.2) < 3 * std < 0.2
    assert load["magnitude_N"] == pytest.approx(math.hypot(*load["force_local_N"]))
    assert math.hypot(*load["force_base_N"]) == pytest.approx(math.hypot(*load["force_local_N"], z), rel=1e-6)
    with np.load("r.npz") as arrays:
        assert arrays["force_axial_N"][0, 0] == pytest.approx(z)
        assert arrays["force_axial_std_N"][0, 0] == pytest.approx(std)
    (row,) = csv.DictReader(Path("r.csv").read_text().splitlines())
    assert float(row["force_axial_N"]) == pytest.approx(z)
    assert float(row["force_axial_std_N"]) == pytest.approx(std)
    assert main([*common, "--axial", "--intervals", "sampled", "--out", "free.json"]) == 0
    free = json.loads(Path("free.json").read_text())["results"][0]["loads"][0]
    assert free["std"]["force_axial_N"] == pytest.approx(std, rel=0.1)
    low, high = free["interval_95"]["force_axial_N"]
    assert low < 0.2 < high
    for result in ("r.json", "r.npz"):
        assert main(["plot", "r.toml", "s.csv", result, "--out", "p.png"]) == 0
    assert main([*common, "--out", "plain.json"]) == 0
    assert "force_axial_N" not in Path("plain.json").read_text()


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (["estimate", "r.toml", "s.csv", "--contact-friction", "0"], "--contact-friction is 0.0; it must be a positive number"),
        (["estimate", "r.toml", "s.csv", "--contact-friction", "-0.1"], "--contact-friction is -0.1; it must be"),
        (["estimate", "r.toml", "s.csv", "--contact-friction", "0.2", "--axial"], "give one of them"),
        (["simulate", "r.toml", "--point", "0.2", "1", "--out", "x.csv"], "four, S FX FY FZ"),
        (["simulate", "r.toml", "--point", "0.2", "1", "0", "0", "1", "--out", "x.csv"], "four, S FX FY FZ"),
    ],
)
def test_bad_input(files, capsys, command, said):
    capsys.readouterr()
    assert main(command) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    with pytest.raises(ValueError, match=r"friction is -0.1"):
        PointCoordinates(1, L, 1.0, friction=-0.1)


SPEC = """
[dataset]
samples = 40
seed = 5
[loads]
force = [0.5, 1.0]
location = [0.3, 0.9]
family = "{family}"
{further}
[robot]
file = "r.toml"
"""


@pytest.mark.parametrize("family", ["point", "gaussian"])
def test_data_sets(files, capsys, family):
    """Drag changes nothing else of what is drawn, is recorded, and the shapes are those under it."""
    width = "" if family == "point" else "width = [0.01, 0.02]\n"
    for name, further in (("plain", width), ("drag", width + "contact_friction = 0.4")):
        Path(f"{name}.toml").write_text(SPEC.format(family=family, further=further))
        assert main(["simulate-dataset", f"{name}.toml", "--out", name, "--workers", "1"]) == 0
    plain, drag = read_dataset("plain", verify=True), read_dataset("drag", verify=True)
    assert plain.axial is None
    assert "contact_friction" not in plain.spec.record()
    assert drag.axial is not None
    for name in ("force", "location", "width"):
        assert torch.equal(getattr(plain, name), getattr(drag, name))
    share = drag.axial / drag.force.norm(dim=-1)
    assert 0.3 < float(share.std()) < 0.5
    assert set(simulate_shard(plain.spec, 0)) == set(simulate_shard(drag.spec, 0)) - {"axial"}
    R = drag.base_wrench[:, :3].norm(dim=-1)
    assert torch.allclose(R, torch.cat([drag.force[:, 0], drag.axial], -1).norm(dim=-1), rtol=2e-2)
    capsys.readouterr()
    Path("bad.toml").write_text(SPEC.format(family=family, further=width + "contact_friction = -1"))
    assert main(["simulate-dataset", "bad.toml", "--out", "bad"]) == 2
    assert "loads.contact_friction is -1.0; it must be positive" in capsys.readouterr().err
