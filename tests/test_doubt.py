"""What is done about data that are not what they seem: outliers, an unknown noise, tensions that are known badly."""

import json
import math

import pytest
import torch

from tests.problems import posed
from tests.robots import T, steel_rod
from torchrod import (
    GaussianCoordinates,
    PointForces,
    Robot,
    Settings,
    Shapes,
    Tendon,
    Tendons,
    Unknowns,
    estimate,
    estimate_noise,
    estimate_noise_among,
    solve_shape,
    write_shapes,
)
from torchrod.analysis.noise import white, with_noise
from torchrod.cli import main

B, S = 200, torch.linspace(0.02, 0.4, 20, dtype=torch.float64)


def drawn(noise: float = 1e-3) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Markers, magnitude and location of single pushes like Study 1's."""
    g = torch.Generator().manual_seed(5)
    size, turn, at = (
        0.5 + 0.5 * torch.rand(B, generator=g),
        6.28 * torch.rand(B, generator=g),
        0.1 + 0.29 * torch.rand(B, 1, generator=g),
    )
    force = torch.stack([size * turn.cos(), size * turn.sin(), 0 * size], -1).unsqueeze(1)
    p = solve_shape(steel_rod(), (PointForces(force, at),), None, S, B).p
    return p + noise * torch.randn(p.shape, generator=g), size, at[:, 0]


def with_outliers(p: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Two of the twenty markers 50 mm off."""
    g = torch.Generator().manual_seed(6)
    bad = torch.rand(B, 20, generator=g).argsort(-1) < 2
    off = torch.nn.functional.normalize(torch.randn(p.shape, generator=g), dim=-1)
    return p + 0.05 * off * bad.unsqueeze(-1), bad


def contacts(most: int) -> list[Unknowns]:
    """None, one, ... of them."""
    return [Unknowns(GaussianCoordinates(k, 0.4, steel_rod().rod.force_scale)) for k in range(most + 1)]


def errors(fit, size, at) -> tuple[float, float]:
    return float((fit.magnitude[:, 0] - size).square().mean().sqrt()), float((fit.location[:, 0] - at).square().mean().sqrt())


@pytest.mark.many_fits
def test_outliers_are_named_and_cost_little():
    """With 10 % of the markers off by 50 mm, errors within 1.5 of clean."""
    p, size, at = drawn()
    dirty, bad = with_outliers(p)
    clean = estimate(posed(S, p))
    robust = estimate(posed(S, dirty), Settings(robust=10.0))
    assert robust.accepted.double().mean() > 0.98
    assert bool((robust.outlier | ~bad).all())
    assert float((robust.outlier & ~bad).double().mean()) < 0.004
    for mine, theirs in zip(errors(robust, size, at), errors(clean, size, at), strict=True):
        assert mine < 1.25 * theirs
    inside = ((robust.magnitude[:, 0] - size).abs() < 1.96 * robust.magnitude_std[:, 0]).double().mean()
    assert inside > 0.88
    assert not clean.outlier.any()


@pytest.mark.many_fits
def test_a_fit_that_leaves_most_markers_aside_is_not_accepted():
    p, _, _ = drawn()
    scattered = p[:20] + 0.05 * torch.randn(20, 20, 3, generator=torch.Generator().manual_seed(1))
    fit = estimate(posed(S, scattered), Settings(robust=10.0, restarts=()))
    assert not fit.accepted.any()


@pytest.mark.many_fits
def test_the_noise_is_found_and_what_it_costs_is_counted():
    for sigma in (2e-4, 4e-3):
        p, size, _ = drawn(sigma)
        problem = posed(S, p)
        noise, known = estimate_noise(problem)
        assert abs(float(noise.sigma.mean()) / sigma - 1) < 0.03
        assert abs(float(noise.sigma.std() / noise.std.mean()) - 1) < 0.2
        fit = estimate(with_noise(problem, known))
        told, plain = noise.judged(fit), estimate(posed(S, p, sigma))
        assert told.accepted.double().mean() > 0.98
        assert float((told.magnitude_std / fit.magnitude_std).min()) > 1.02
        assert abs(float((told.force - plain.force).norm(dim=-1).median())) < 0.2 * float(plain.magnitude_std.median())
        inside = ((told.magnitude[:, 0] - size).abs() < 1.96 * told.magnitude_std[:, 0]).double().mean()
        assert 0.88 < float(inside) < 0.99


@pytest.mark.many_fits
def test_the_noise_is_found_without_knowing_the_number_of_loads():
    """With a push, and without one, where the richest of the competing fits has nothing to hold on to."""
    g, candidates = torch.Generator().manual_seed(7), contacts(3)
    for positions in (
        drawn(2e-4)[0],
        T([0.0, 0.0, 1.0]) * S[:, None] + 2e-4 * torch.randn(B, 20, 3, generator=g),
    ):
        problem = posed(S, positions)
        noise, known = estimate_noise_among(problem, candidates)
        assert float(noise.sigma.max()) < 1.6 * 2e-4
        assert float(noise.sigma.min()) > 0.5 * 2e-4
        assert abs(float(noise.sigma.mean()) / 2e-4 - 1) < 0.03
        assert torch.equal(known, noise.sigma)


@pytest.mark.many_fits
def test_outliers_of_a_model_with_too_few_loads_do_not_tell_the_noise():
    """A robust fit without a load calls most markers outliers; what those leave is little, and no noise."""
    p = drawn()[0][:20]
    noise, _ = estimate_noise_among(posed(S, p), contacts(2), Settings(robust=10.0))
    assert noise.freedom.min() > 40
    assert 0.9 < (noise.sigma / 1e-3).mean() < 1.1 and noise.sigma.max() < 1.5e-3


@pytest.mark.many_fits
def test_the_noise_of_a_sample_does_not_depend_on_its_batch():
    """Rounds go on for the sake of others; a sample that has settled stays."""
    p = drawn()[0][:8]
    p[1:] += 4e-3 * torch.randn(7, 20, 3, generator=torch.Generator().manual_seed(3))
    together, _ = estimate_noise(posed(S, p))
    alone = [estimate_noise(posed(S, p[i : i + 1]))[0] for i in range(8)]
    assert torch.allclose(together.sigma, torch.cat([one.sigma for one in alone]), rtol=1e-6)


@pytest.mark.many_fits
def test_few_markers_tell_the_noise_by_the_richest_model_they_can(tmp_path, capsys):
    """Three markers cannot determine three loads; one of a sample's markers tells no noise at all, and the table says so."""
    (tmp_path / "robot.toml").write_text(
        'name = "rod"\n[rod]\nlength = 0.4\ndiameter = 0.0014\nyoungs_modulus = 207e9\nshear_modulus = 79e9\n'
    )
    few = drawn()[0][:2, [5, 11, 17]].clone()
    few[1, 1:] = torch.nan
    write_shapes(tmp_path / "shapes.csv", Shapes(S[[5, 11, 17]], few, ["three", "one"]))
    command = ["estimate", str(tmp_path / "robot.toml"), str(tmp_path / "shapes.csv"), "--noise", "auto", "--contacts", "auto"]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "three  converged     yes" in said
    assert said.count("noise (mm)") == 1
    assert "noise not known: too few markers" in said


@pytest.mark.many_fits
def test_a_smooth_residual_is_not_noise():
    """Two strong pushes fitted by one leave a residual that is alike from marker to marker; noise alone does not."""
    robot, at = steel_rod(), T([[0.12, 0.36]])
    p = solve_shape(robot, (PointForces(T([[[1.5, 0.0, 0.0], [-1.0, 0.4, 0.0]]]), at),), None, S, 1).p
    problem = posed(S, p)
    noise, known = estimate_noise(problem)
    assert not bool(noise.judged(estimate(with_noise(problem, known))).accepted[0])
    p, _, _ = drawn()
    assert white(estimate(posed(S, p))).double().mean() > 0.98


def pulled() -> Robot:
    tendons = Tendons((Tendon.straight(0.008, 0.0, 0.4), Tendon.straight(-0.004, 0.007, 0.4)))
    return Robot(steel_rod().rod, tendons)


@pytest.mark.many_fits
def test_tensions_move_within_their_sensors_errors():
    """An error of a tension passes for a force: only with the tensions in the state does the reported spread cover that."""
    robot, g = pulled(), torch.Generator().manual_seed(0)
    n, true = 100, T([[4.0, 2.0]]).expand(100, 2)
    force, at = T([[[0.4, -0.3, 0.0]]]).expand(n, 1, 3), T([[0.25]]).expand(n, 1)
    p = solve_shape(robot, (PointForces(force, at),), true, S, n).p
    p = p + 3e-4 * torch.randn(p.shape, generator=g)
    reading = true + 0.3 * torch.randn(n, 2, generator=g)
    loads = GaussianCoordinates(1, 0.4, robot.rod.force_scale, "point")
    exact = estimate(posed(S, p, 3e-4, robot, loads, reading))
    free = estimate(posed(S, p, 3e-4, robot, loads, reading, tension_std=0.3))
    along = force[:, 0, :2] / 0.5
    covered = []
    for fit in (exact, free):
        std = (along.unsqueeze(1) @ fit.load_covariance[:, 0, :2, :2] @ along.unsqueeze(-1)).squeeze().sqrt()
        off = ((fit.force[:, 0] - force[:, 0, :2]) * along).sum(-1)
        covered.append(float((off.abs() < 1.96 * std).double().mean()))
    assert covered[0] < 0.75
    assert 0.88 < covered[1] <= 1
    assert free.accepted.double().mean() > 0.97
    assert free.tension is not None
    assert free.tension_std is not None
    assert float((free.tension - true).square().mean().sqrt()) < 1.02 * float((reading - true).square().mean().sqrt())
    inside = ((free.tension - true).abs() < 1.96 * free.tension_std).double().mean()
    assert 0.88 < float(inside) <= 1


@pytest.mark.parametrize("suffix", ["json", "npz"])
@pytest.mark.many_fits
def test_the_command_says_all_of_it(tmp_path, capsys, suffix):
    (tmp_path / "robot.toml").write_text(
        'name = "rod"\n[rod]\nlength = 0.4\ndiameter = 0.0014\nyoungs_modulus = 207e9\nshear_modulus = 79e9\n'
        "[[tendons]]\noffset = [0.008, 0.0]\nends_at = 0.4\n[[tendons]]\noffset = [-0.004, 0.007]\nends_at = 0.4\n"
    )
    force, at = T([[[0.4, -0.3, 0.0]]]), T([[0.25]])
    p = solve_shape(pulled(), (PointForces(force, at),), T([[4.0, 2.0]]), S, 1).p
    p = p + 2e-4 * torch.randn(p.shape, generator=torch.Generator().manual_seed(2))
    p[0, 11] += T([0.0, 0.05, 0.0])
    write_shapes(tmp_path / "shapes.csv", Shapes(S, p, ["0"], tension=T([[4.0, 2.0]])))
    out = tmp_path / f"result.{suffix}"
    command = ["estimate", str(tmp_path / "robot.toml"), str(tmp_path / "shapes.csv"), "--robust", "--noise", "auto"]
    assert main([*command, "--tension-std", "0.2", "--load-prior", "point", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "left aside as outliers: markers 12" in said
    assert "tensions (N)" in said
    assert "noise (mm)" in said
    if suffix == "json":
        (result,) = json.loads(out.read_text())["results"]
        assert result["outliers"] == [12]
        assert abs(result["noise"]["noise_m"] / 2e-4 - 1) < 0.4
        assert len(result["tensions"]["std"]["tension_N"]) == 2
        assert math.isclose(result["loads"][0]["magnitude_N"], 0.5, rel_tol=0.1)


@pytest.mark.parametrize(
    ("option", "value", "said"), [("--noise", "much", "auto or"), ("--tension-std", "-1", "positive"), ("--noise", "7", "metres")]
)
def test_bad_values_are_refused_in_one_line(tmp_path, capsys, option, value, said):
    (tmp_path / "robot.toml").write_text(
        'name = "rod"\n[rod]\nlength = 0.4\ndiameter = 0.0014\nyoungs_modulus = 207e9\nshear_modulus = 79e9\n'
    )
    write_shapes(tmp_path / "shapes.csv", Shapes(S, torch.nn.functional.pad(S[:, None], (2, 0))[None], ["0"]))
    assert main(["estimate", str(tmp_path / "robot.toml"), str(tmp_path / "shapes.csv"), option, value]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
