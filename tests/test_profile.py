"""The load profile: what it is for every family, how often its band holds the truth, and its way through files and figures."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.conftest import reference
from tests.problems import unknowns_of
from tests.robots import T, csv_of, steel_rod, toml_of
from torchrod import (
    FourierCoordinates,
    GaussianCoordinates,
    Markers,
    PointCoordinates,
    PointForces,
    Problem,
    Settings,
    SmoothCoordinates,
    Unknowns,
    analyze,
    contact_hypotheses,
    estimate,
    load_profile,
    shape_from_base,
    solve_shape,
)
from torchrod.cli import main
from torchrod.cli.estimate import _drawn_rod
from torchrod.estimation.load_profile import DRAWS, band_of_draws, joined_profile
from torchrod.io import read_fit

S20 = torch.linspace(0.02, 0.4, 20, dtype=torch.float64)


def contact(force: list[float], place: float, noise: float = 1e-3) -> Markers:
    shape = solve_shape(steel_rod(), (PointForces(T([[[*force, 0.0]]]), T([[place]])),), None, S20, 1)
    return Markers(S20, shape.p, noise)


def drawn(count: int) -> tuple[Problem, torch.Tensor]:
    """Contacts as the prior has them, with 1 mm noise."""
    robot, generator = steel_rod(), torch.Generator().manual_seed(5)
    unknowns = unknowns_of(robot)
    size, angle, place = torch.rand(3, count, generator=generator)
    size, angle = (0.5 + 0.5 * size) / robot.rod.force_scale, 2 * math.pi * angle
    log_c = unknowns.loads.prior()[0][3] + torch.randn(count, generator=generator)
    gamma = torch.stack([size * angle.cos(), size * angle.sin(), torch.logit(0.25 + 0.7 * place), log_c], -1)
    p = solve_shape(robot, unknowns.loads.loads(gamma), None, S20, count, 80).p
    return Problem(robot, unknowns, [Markers(S20, p + 1e-3 * torch.randn(p.shape, generator=generator), 1e-3)]), gamma


@pytest.mark.many_fits
def test_the_band_holds_the_truth():
    problem, gamma = drawn(200)
    fit = estimate(problem)
    profile = load_profile(problem, fit.x, fit.covariance)
    assert profile is not None
    f = problem.unknowns.loads.loads(gamma)[0].density(profile.s)
    assert f is not None
    truth = torch.cat([f[..., :2], f.norm(dim=-1, keepdim=True)], -1)
    high = profile.band[..., 2, 1]
    there = high > 0.05 * high.amax(-1, keepdim=True)
    held = ((profile.band[..., 0] <= truth) & (truth <= profile.band[..., 1]))[there].double().mean(0)
    assert (held > 0.91).all()
    assert (held < 0.99).all()
    alone = load_profile(problem, fit.x[7:8], fit.covariance[7:8])
    assert alone is not None
    assert torch.allclose(alone.band[0], profile.band[7], rtol=1e-9, atol=1e-12)


def test_the_band_of_draws_is_their_quantiles():
    """Pointwise, for bells, near and far from their places, and for a series: against the density in double precision."""
    s, generator = torch.linspace(0, 0.4, 31, dtype=torch.float64), torch.Generator().manual_seed(2)
    for family in (GaussianCoordinates(2, 0.4, 1.0), FourierCoordinates(2, 0.4, 1.0)):
        gamma = family.start() + 0.7 * torch.randn(3, DRAWS, family.size, generator=generator, dtype=torch.float64)
        f = family.loads(gamma)[0].density(s)
        assert f is not None
        f = f[..., :2]
        values = torch.cat([f, f.norm(dim=-1, keepdim=True)], -1).numpy()
        expected = torch.from_numpy(np.moveaxis(np.quantile(values, [0.025, 0.975], axis=1), 0, -1))
        found = band_of_draws(family, gamma, s)
        assert found is not None
        assert ((found - expected).abs() < 1e-5 * expected.abs().amax((1, 2, 3), keepdim=True)).all()


def test_a_series_as_one_load_has_its_force_and_moment_at_once():
    """By the trapezoid on a fine grid; of no net force it lies on the rod, and of none in the middle."""
    series = FourierCoordinates(2, 0.4, 1.5)
    gamma = torch.randn(40, series.size, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    gamma[:, 0] += 6.0  # a mean that keeps the place on the rod
    s = torch.linspace(0.0, 0.4, 20001, dtype=torch.float64)
    f = series.loads(gamma)[0].density(s)
    assert f is not None
    net, report = torch.trapezoid(f[..., :2], s, dim=-2), series.describe(gamma)
    along = (f[..., :2] * net.unsqueeze(-2)).sum(-1) / net.norm(dim=-1, keepdim=True)
    place = torch.trapezoid(along * s, s, dim=-1) / net.norm(dim=-1)
    assert (report.force[:, 0] - net).abs().max() < 1e-3
    inside = (place > 0) & (place < 0.4)
    assert int(inside.sum()) > 30 and (report.location[:, 0] - place)[inside].abs().max() < 1e-4
    assert ((report.location >= 0) & (report.location <= 0.4)).all()
    assert float(series.describe(series.start()).location) == pytest.approx(0.2)


def test_a_series_is_its_own_profile_and_points_have_none():
    robot, markers = steel_rod(), contact([0.5, -0.2], 0.25, 1e-4)
    series = FourierCoordinates(3, 0.4, robot.rod.force_scale)
    problem = Problem(robot, Unknowns(series), [markers])
    fit = estimate(problem)
    profile = load_profile(problem, fit.x, fit.covariance, 41)
    assert profile is not None
    net = torch.trapezoid(profile.f[0], profile.s, dim=0)
    assert torch.allclose(net, fit.force[0, 0], atol=1e-3)
    density = series.loads(fit.x[:, : series.size])[0].density(profile.s)
    assert density is not None
    assert torch.allclose(profile.f, density[..., :2])
    assert (profile.band[..., :2, 0] < profile.f).all()
    assert (profile.band[..., :2, 1] > profile.f).all()
    points = problem.of(Unknowns(PointCoordinates(1, 0.4, robot.rod.force_scale)))
    there = estimate(points)
    assert load_profile(points, there.x, there.covariance) is None
    assert joined_profile(points, [(points.unknowns, torch.arange(1))], there.x, there.covariance) is None


def test_no_load_no_band_and_no_knowledge():
    """Without loads the profile is zero; a fit that has not converged has a profile without a band."""
    robot, markers = steel_rod(), contact([0.5, -0.2], 0.25)
    none = Problem(robot, unknowns_of(robot, 0), [markers])
    fit = estimate(none)
    profile = load_profile(none, fit.x, fit.covariance)
    assert profile is not None
    assert not profile.band.any()
    one = none.of(unknowns_of(robot))
    hasty = estimate(one, Settings(max_iterations=2, restarts=()))
    profile = load_profile(one, hasty.x, hasty.covariance)
    assert profile is not None
    assert profile.f.isfinite().all()
    assert profile.band.isnan().all()


def test_the_covariance_of_magnitude_and_location():
    """The diagonal is the reported spread; on this rod a push farther out is weaker, so they are correlated negatively."""
    unknowns = Unknowns(GaussianCoordinates(1, 0.4, 1.0))
    fit = estimate(Problem(steel_rod(), unknowns, [contact([0.5, -0.2], 0.25)]))
    C = fit.magnitude_location_covariance[0, 0]
    assert torch.allclose(C.diagonal().sqrt(), torch.stack([fit.magnitude_std[0, 0], fit.location_std[0, 0]]))
    assert C[0, 1] < 0
    assert torch.linalg.eigvalsh(C).min() > 0


def test_files_and_figures(tmp_path):
    """JSON and NPZ carry the same profile, on one line, and the figure is drawn from either as it was after the estimate."""
    case = next(c for c in reference("shape") if c["name"] == "passive-point-0")
    robot, shape = str(tmp_path / "robot.toml"), str(tmp_path / "shape.csv")
    Path(robot).write_text(toml_of(case["robot"], "rod"))
    Path(shape).write_text(csv_of(case))
    first = tmp_path / "first.png"
    for out, options in (("result.json", ["--plot", str(first)]), ("result.npz", [])):
        figure, result = tmp_path / f"{out}.png", str(tmp_path / out)
        assert main(["estimate", robot, shape, "--contacts", "auto", "--noise", "1e-3", "--out", result, *options]) == 0
        assert main(["plot", robot, shape, result, "--out", str(figure)]) == 0
        assert figure.stat().st_size > 50_000
    assert first.stat().st_size > 50_000
    text = (tmp_path / "result.json").read_text()
    assert len(text.splitlines()) < 150
    (record,) = json.loads(text)["results"]
    stored = record["profile"]
    f, band = np.array(stored["f_local_N_per_m"]), stored["band_95"]
    assert f.shape == (101, 2)
    assert np.array(band["magnitude"]).shape == (101, 2)
    with np.load(tmp_path / "result.npz") as arrays:
        assert np.allclose(arrays["profile_f"][0], f, atol=1e-4 * np.abs(f).max())
        assert np.allclose(arrays["profile_band"][0, :, 1], band["fy"], atol=1e-4 * np.abs(band["fy"]).max())
        assert np.allclose(arrays["magnitude_location_covariance"][0, 0], record["loads"][0]["covariance"])
    peak = stored["s_m"][int(np.linalg.norm(f, axis=1).argmax())]
    assert abs(peak - record["loads"][0]["location_m"]) < 3e-3
    del record["profile"]
    (tmp_path / "old.json").write_text(json.dumps({"robot": "rod", "results": [record]}))
    assert read_fit(tmp_path / "old.json", str(record["sample"])).profile is None


def test_the_rod_that_is_drawn_is_the_one_that_was_fitted():
    """Under a load of any form as well, which was once drawn as a Gaussian with its force, place and width: up to 90 mm off."""
    robot = steel_rod()
    s = torch.linspace(0.02, 0.4, 20)
    pushes = PointForces(T([[[0.8, 0.1, 0.0], [0.1, -0.5, 0.0]]]), T([[0.15, 0.33]]))
    p = solve_shape(robot, (pushes,), None, s, 1, 80).p
    for loads in (SmoothCoordinates(0.4, robot.rod.force_scale, 2.0, 0.4), GaussianCoordinates(2, 0.4, robot.rod.force_scale)):
        problem = Problem(robot, Unknowns(loads), [Markers(s, p, 1e-3)])
        fit = estimate(problem)
        drawn = fit.fitted_rod(0, load_profile(problem, fit.x, fit.covariance))
        shape = shape_from_base(robot, drawn.loads(0.4), drawn.base_wrench.unsqueeze(0), None, s, 80)
        assert (shape.p - fit.centre_line).abs().max() < 1e-3


def test_the_whisker_is_the_interval_of_the_result():
    """Of draws where there are any: once it was that of the covariance, a tenth as wide."""
    robot = steel_rod()
    s = torch.linspace(0.02, 0.4, 20)
    p = solve_shape(robot, (PointForces(T([[[0.5, 0.2, 0.0]]]), T([[0.22]])),), None, s, 1, 80).p
    problem = Problem(
        robot, unknowns_of(robot), [Markers(s, p + 1e-3 * torch.randn(p.shape, generator=torch.Generator().manual_seed(1)), 1e-3)]
    )
    found = analyze(problem, contact_hypotheses(problem, 1, "auto"), sampled=True)
    drawn = _drawn_rod(found, 0).location_interval
    assert drawn is not None and found.intervals is not None
    assert torch.equal(drawn, found.intervals.location[0])
    assert not torch.allclose(drawn, found.estimate.location_interval[0], rtol=1e-3)
