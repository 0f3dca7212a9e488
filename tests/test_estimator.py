"""The estimator on simulated robots: accuracy, independence of the batch, and what it does with incomplete data."""

import math
from dataclasses import replace

import pytest
import roma
import torch

from tests.problems import posed, unknowns_of
from tests.robots import T, steel_rod
from tests.study import study1
from torchrod import (
    FourierCoordinates,
    GaussianCoordinates,
    InputError,
    Markers,
    Origin,
    PaperCoordinates,
    PointCoordinates,
    PointForces,
    Problem,
    Registration,
    Settings,
    Start,
    Status,
    Unknowns,
    estimate,
    paper_settings,
    solve_shape,
)
from torchrod.estimation import solve as estimator
from torchrod.estimation.result import Z95, _interval
from torchrod.estimation.solve import linearize


@pytest.mark.parametrize(
    ("noise", "sigma", "prior", "millimetres", "newtons"),
    [(0.0, 1e-4, "point", 0.1, 0.001), (1e-3, 1e-3, "point", 5.5, 0.05), (1e-3, 1e-3, "contact", 5.5, 0.05)],
)
def test_study_1(noise, sigma, prior, millimetres, newtons):
    """Every case converges and is accepted, in 7.2 iterations in the mean (7.6 with NEAR = 1), well within the paper's errors."""
    study = study1(100)
    fit = study.estimate(noise, prior, sigma)
    assert (fit.status == Status.CONVERGED).all()
    assert fit.accepted.all()
    assert fit.iterations.double().mean() <= 7.5
    assert (fit.location[:, 0] - study.location).abs().mean() <= millimetres * 1e-3
    assert (fit.force[:, 0] - study.force).norm(dim=-1).mean() <= 2 * newtons
    assert (fit.magnitude[:, 0] - study.force.norm(dim=-1)).abs().mean() <= newtons


def test_the_reported_spread_is_the_observed_one():
    """Study 1 with 1 mm noise: normalized errors of location and magnitude have about unit variance."""
    study = study1(100)
    fit = study.estimate(1e-3, "point", 1e-3)
    location = (fit.location[:, 0] - study.location) / fit.location_std[:, 0]
    magnitude = (fit.magnitude[:, 0] - study.force.norm(dim=-1)) / fit.magnitude_std[:, 0]
    for z in (location, magnitude):
        assert 0.8 < z.square().mean().sqrt() < 1.2
    C = fit.log_covariance[:, 0]
    assert torch.allclose(C[:, 0, 0].sqrt(), fit.magnitude_std[:, 0] / fit.magnitude[:, 0])
    assert torch.allclose(C[:, 2, 2].sqrt(), fit.location_std[:, 0] / fit.location[:, 0])
    known = fit.magnitude_std < 0.4 * fit.magnitude
    assert known.double().mean() > 0.9
    for interval, value in ((fit.magnitude_interval, fit.magnitude), (fit.location_interval, fit.location)):
        assert (interval[..., 0] < value).all()
        whole = known & (interval[..., 1] < fit.rod_length.unsqueeze(-1)) if value is fit.location else known
        assert torch.allclose(interval.prod(-1).sqrt()[whole], value[whole]), "symmetric in the logarithm where well known"


def test_the_interval_of_a_force_that_is_not_there_reaches_zero():
    s = torch.linspace(0.02, 0.4, 20)
    straight = torch.zeros(1, 20, 3)
    straight[..., 2] = s
    fit = estimate(posed(s, straight))
    assert fit.accepted[0]
    assert fit.magnitude[0, 0] < fit.magnitude_std[0, 0]
    assert fit.magnitude_interval[0, 0, 0] == 0


def test_an_interval_is_symmetric_in_the_logarithm_only_where_that_is_known():
    """A number whose relative error is 0.6 may be zero: 1 - 1.96 x 0.6 < 0; with 0.4 it may not."""
    value, std = T([[1.0, 1.0]]), T([[0.6, 0.4]])
    found = _interval(value, std)[0]
    assert found[0].tolist() == pytest.approx([0.0, 1 + Z95 * 0.6])
    assert found[1].tolist() == pytest.approx([math.exp(-Z95 * 0.4), math.exp(Z95 * 0.4)])


def test_as_many_numbers_as_unknowns_are_enough():
    """One marker and a force at the tip: three numbers each; with one coordinate less the sample is not fitted."""
    rod, s = steel_rod(), T([0.4])
    unknowns = Unknowns(GaussianCoordinates(0, 0.4, rod.rod.force_scale), tip="force")
    p = T([[[0.05, 0.0, 0.395]]])
    assert Problem(rod, unknowns, [Markers(s, p, 1e-3)]).usable.tolist() == [True]
    assert Problem(rod, unknowns, [Markers(s, p.masked_fill(p == 0, torch.nan), 1e-3)]).usable.tolist() == [False]


@pytest.mark.many_fits
def test_a_samples_answer_does_not_depend_on_its_batch():
    """With a NaN neighbour, one that is nonsense, and one that has too few markers."""
    study = study1(4)
    positions = study.positions.clone()
    positions[1] = torch.nan
    positions[2] = 5 * torch.randn(positions[2].shape, generator=torch.Generator().manual_seed(0))
    positions[3, 1:] = torch.nan
    limit = Settings(max_iterations=12)
    together = estimate(posed(study.s, positions), limit)
    assert together.status.tolist()[0] == Status.CONVERGED
    assert together.status.tolist()[1] == together.status.tolist()[3] == Status.INVALID
    assert not together.accepted[2]
    assert together.covariance[0].isfinite().all()
    assert together.covariance[2].isnan().all(), "no interval for a fit that has not converged"
    assert together.x[1].isnan().all()
    assert "more markers" in together.message(3)
    for i in (0, 2):
        alone = estimate(posed(study.s, positions[i : i + 1]), limit)
        assert torch.allclose(together.x[i], alone.x[0], rtol=0, atol=1e-9)
        assert torch.allclose(together.covariance[i], alone.covariance[0], rtol=1e-9, atol=1e-9, equal_nan=True)
        assert together.iterations[i] == alone.iterations[0]


def test_missing_markers_are_left_out():
    """A NaN marker changes the answer exactly as if it had never been there."""
    study = study1(2)
    gone, kept = [3, 11, 19], [i for i in range(20) if i not in (3, 11, 19)]
    positions = study.positions.clone()
    positions[:, gone] = torch.nan
    holes = estimate(posed(study.s, positions))
    fewer = estimate(posed(study.s[kept], study.positions[:, kept]))
    assert torch.allclose(holes.force, fewer.force, atol=1e-6)
    assert torch.equal(holes.dof, fewer.dof)
    assert holes.residual[:, gone].isnan().all()


def test_a_known_location_is_kept():
    robot, s = steel_rod(), torch.linspace(0.02, 0.4, 20)
    shape = solve_shape(robot, (PointForces(T([[[0.3, 0.5, 0.0]]]), T([[0.22]])),), None, s, 1)
    for loads in (GaussianCoordinates(1, 0.4, 1.0, "point", (0.22,)), PointCoordinates(1, 0.4, 1.0, (0.22,))):
        fit = estimate(posed(s, shape.p, 1e-4, loads=loads))
        assert fit.accepted[0]
        assert fit.location[0, 0] == 0.22
        assert torch.allclose(fit.force[0, 0], T([0.3, 0.5]), atol=1e-3)
        assert fit.location_std[0, 0] == 0


@pytest.mark.many_fits
def test_registration_recovers_a_wrong_base_frame():
    """5 mm and 3 degrees off; without registration the fit is refused and says to look at registration."""
    robot, s = steel_rod(), torch.linspace(0.02, 0.4, 20)
    shape = solve_shape(robot, (PointForces(T([[[0.6, 0.5, 0.0]]]), T([[0.22]])),), None, s, 1)
    c, d = math.cos(math.radians(3)), math.sin(math.radians(3))
    seen = shape.p @ T([[1.0, 0, 0], [0, c, -d], [0, d, c]]).T + T([0.003, -0.004, 0.0])
    loads = GaussianCoordinates(1, 0.4, robot.rod.force_scale, "point")
    fit = estimate(posed(s, seen, 1e-4, loads=loads, registration=Registration()))
    assert fit.accepted[0]
    assert fit.registration is not None
    assert torch.allclose(fit.registration[0], T([0.003, -0.004, 0.0, math.radians(3), 0.0, 0.0]), atol=2e-3)
    assert abs(float(fit.location[0, 0]) - 0.22) < 2e-3
    plain = estimate(posed(s, seen, 1e-4, loads=loads))
    assert not plain.accepted[0]
    assert "registration" in plain.message(0)


@pytest.mark.many_fits
def test_markers_off_the_centre_line():
    """p(s) + R(s) r: offset markers see the same load; taken for the centre line they are refused."""
    robot, s = steel_rod(), torch.linspace(0.05, 0.4, 8)
    shape = solve_shape(robot, (PointForces(T([[[0.6, 0.5, 0.0]]]), T([[0.25]])),), None, s, 1)
    offsets = T([[0.01, 0.0, 0.0], [0.0, -0.01, 0.0]]).repeat(4, 1)
    seen = shape.p + roma.quat_action(shape.q, offsets.unsqueeze(0))
    loads = GaussianCoordinates(1, 0.4, robot.rod.force_scale, "point")
    fit = estimate(posed(s, seen, 1e-4, loads=loads, offsets=offsets))
    assert fit.accepted[0]
    assert abs(float(fit.location[0, 0]) - 0.25) < 1e-3
    assert not estimate(posed(s, seen, 1e-4, loads=loads), Settings(max_iterations=20)).accepted[0]


@pytest.mark.parametrize("family", ["point", "fourier"])
def test_the_other_families_fit_the_shape(family):
    """Points and a Fourier series stand beside the Gaussians: two point loads, fitted to 0.1 mm."""
    robot, s = steel_rod(), torch.linspace(0.02, 0.4, 20)
    shape = solve_shape(robot, (PointForces(T([[[0.6, 0.5, 0.0], [-0.2, 0.4, 0.0]]]), T([[0.15, 0.3]])),), None, s, 1)
    scale = robot.rod.force_scale
    loads = PointCoordinates(2, 0.4, scale) if family == "point" else FourierCoordinates(3, 0.4, scale)
    fit = estimate(posed(s, shape.p, 1e-4, loads=loads))
    assert fit.status[0] == Status.CONVERGED
    assert fit.rms_residual[0] < 1e-4
    if family == "point":
        assert torch.allclose(fit.location[0].sort().values, T([0.15, 0.3]), atol=1e-3)
    else:
        assert torch.allclose(fit.force[0, 0], T([0.4, 0.9]), atol=0.05)


@pytest.mark.many_fits
def test_the_paper_mode_runs_the_plain_recursion():
    """The paper's parameters without safeguards: as many of Study 1 converge as the paper says, and are the true load."""
    study = study1()
    noise = 1e-3 * torch.randn(study.positions.shape, generator=torch.Generator().manual_seed(1))
    for positions, most in ((study.positions, 1e-3), (study.positions + noise, 0.02)):
        problem = in_paper_mode(study.s, positions, PaperCoordinates(1, 0.4, beta1=-0.004, beta2=0.404))
        fit = estimate(problem, paper_settings(problem))
        done = fit.status == Status.CONVERGED
        assert done.double().mean() >= 0.94
        assert fit.accepted.double().mean() >= 0.94
        assert fit.iterations[done].double().mean() > 10
        assert (fit.location[:, 0] - study.location)[done].abs().mean() < most


def in_paper_mode(s, positions, loads) -> Problem:
    return replace(posed(s, positions, loads=loads, scaled=False), tip_std=(2e-3, 2e-3))


def test_the_paper_mode_wants_the_papers_coordinates():
    with pytest.raises(InputError, match="PaperCoordinates"):
        paper_settings(posed(T([0.2, 0.4]), torch.zeros(1, 2, 3)))


def test_a_small_step_of_the_filter_is_enough_where_that_is_wanted():
    """Settings.gain: the same recursion stops earlier, and where no step is small enough it does not stop."""
    study = study1(5)
    noise = 1e-3 * torch.randn(study.positions.shape, generator=torch.Generator().manual_seed(1))
    problem = in_paper_mode(study.s, study.positions + noise, PaperCoordinates(1, 0.4))
    fits = [estimate(problem, replace(paper_settings(problem), gain=gain)) for gain in (1e-1, 1e-5)]
    assert (fits[0].iterations < fits[1].iterations).all()
    assert (fits[1].cost <= fits[0].cost).all()


def test_a_load_at_the_tip_has_its_whole_force_on_the_rod():
    """The default reports what the rod feels; (13) counts the half of the Gaussian that hangs over the tip as well."""
    robot, s = steel_rod(), torch.linspace(0.02, 0.4, 20)
    shape = solve_shape(robot, (PointForces(T([[[0.8, 0.0, 0.0]]]), T([[0.4]])),), None, s, 1)
    loads = GaussianCoordinates(1, 0.4, robot.rod.force_scale, "point", (0.4,))
    fit = estimate(posed(s, shape.p, 1e-4, loads=loads))
    assert abs(float(fit.magnitude[0, 0]) - 0.8) < 0.03
    assert torch.allclose(fit.net_force, 2 * fit.force, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(noise=0.0), "must be positive"),
        (dict(s=[0.1, 0.5]), "outside the rod"),
        (dict(s=[0.4]), "add markers"),
        (dict(tension=[[1.0]]), "1 tensions but the robot has 0"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_remedy(change, words):
    s = T(change.get("s", [0.2, 0.4]))
    tension = T(change["tension"]) if "tension" in change else None
    with pytest.raises(ValueError, match=words):
        estimate(posed(s, torch.zeros(1, len(s), 3), change.get("noise", 1e-3), tension=tension))


@pytest.mark.many_fits
def test_a_strong_push_near_the_tip_is_found_by_a_restart():
    """From rest these settle at a quarter or an eighth of the force; chi-square sees it, and other magnitudes are tried."""
    robot, s = steel_rod(), torch.linspace(0.02, 0.4, 20)
    size, place = T([4.91, 3.99, 0.5, 6.0, 8.0, 10.0]), T([0.379, 0.398, 0.2, 0.38, 0.34, 0.31]).unsqueeze(1)
    force = torch.stack([size, 0 * size, 0 * size], -1).unsqueeze(1)
    force[1] = force[1].roll(1, -1)
    shape = solve_shape(robot, (PointForces(force, place),), None, s, 6, 160)
    problem = posed(s, shape.p)
    once = estimate(problem, Settings(restarts=(), basins=0))
    assert once.accepted.tolist() == [False, False, True, False, False, False]
    fit = estimate(problem, Settings(basins=0))
    assert fit.accepted.all()
    assert estimate(problem, Settings(restarts=())).accepted[:3].all(), "a start elsewhere finds these as well"
    assert fit.restarts.tolist() == [1, 1, 0, 3, 3, 3]
    assert (fit.iterations >= once.iterations).all()
    assert torch.allclose(fit.magnitude, force.norm(dim=-1), rtol=0.02)


class Own:
    """Load coordinates that torchrod does not know, and that have no hash."""

    __hash__ = None  # pyright: ignore[reportAssignmentType]

    def __init__(self):
        self._known = GaussianCoordinates(1, 0.4, 1.0, "point")

    def __getattr__(self, name):
        return getattr(self._known, name)


def test_coordinates_of_your_own_are_fitted_as_well():
    robot, s = steel_rod(), torch.linspace(0.04, 0.4, 10)
    p = solve_shape(robot, (PointForces(T([[[0.6, -0.2, 0.0]]]), T([[0.25]])),), None, s, 1).p
    own, known = (estimate(posed(s, p, 1e-4, loads=c)) for c in (Own(), GaussianCoordinates(1, 0.4, 1.0, "point")))
    assert bool(own.accepted)
    assert torch.allclose(own.force, known.force, rtol=1e-8)
    assert torch.allclose(own.location, known.location, rtol=1e-8)


def test_the_last_update_is_taken_and_the_cost_is_what_it_promises():
    problem = study1(40).problem(1e-3, "contact", 1e-3)
    fit = estimate(problem)
    at = linearize(problem, fit.x)
    assert float((fit.cost - at.cost).abs().max()) < 1e-4
    assert float(at.decrement.max()) < 4e-4


def test_a_start_is_handed_out_chunk_by_chunk(monkeypatch):
    """Known starts, of samples that the estimator takes a few at a time, and one too few."""
    problem = study1(7).problem(1e-3, "contact", 1e-3, seed=2)
    whole = estimate(problem)
    start = Start.at(whole.x, Origin.OTHER_FIT)
    monkeypatch.setattr(estimator, "CHUNK", 3)
    monkeypatch.setattr(estimator, "CHUNK_TORCH", 3)
    again = estimate(problem, start=start)
    assert (again.iterations <= 2).all() and not again.warm_started.any()
    assert torch.allclose(again.force, whole.force, rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match=r"start.x has shape \(6, 10\)"):
        estimate(problem, start=start.take(torch.arange(6)))


def test_no_interval_of_a_place_leaves_the_rod():
    """A faint push near the tip, whose place is hardly known."""
    rod, s = steel_rod(), torch.linspace(0.1, 0.4, 4)
    push = PointForces(T([[[0.02, 0.0, 0.0]]]), T([[0.38]]))
    p = solve_shape(rod, (push,), None, s, 1).p
    fit = estimate(Problem(rod, unknowns_of(rod), [Markers(s, p, 2e-3)]))
    assert float(fit.location_std) > 0.01
    assert float(fit.location_interval[0, 0, 0]) < float(fit.location_interval[0, 0, 1]) <= rod.rod.length


def test_an_estimate_prints_its_loads():
    """And not pages of covariances."""
    push = PointForces(T([[[0.6, 0.0, 0.0]]]).expand(7, 1, 3), T([[0.3]]).expand(7, 1))
    s = torch.linspace(0.02, 0.4, 20)
    p = solve_shape(steel_rod(), (push,), None, s, 7).p
    p[1] = torch.nan
    lines = repr(estimate(posed(s, p, 1e-3))).splitlines()
    assert lines[0] == "Estimate of 7 samples: 6 converged, 6 accepted" and lines[-1] == "  ..." and len(lines) == 7
    assert lines[1].startswith("  0: 0.60") and lines[2] == "  1: no load"
    assert float(lines[1].split(" N at ")[1].split()[0]) == pytest.approx(0.3, abs=1e-3)
