"""What the Python interface does with tensors that are not quite what it wants."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from studies.reproduction.cases import S, study1

from tests.problems import posed
from tests.robots import busy_robot, steel_rod
from torchrod import (
    FourierCoordinates,
    FourierLoads,
    GaussianCoordinates,
    GaussianLoads,
    Markers,
    Origin,
    PointCoordinates,
    PointForces,
    PointWrenches,
    PolynomialLoads,
    Robot,
    Rod,
    Start,
    Tendon,
    Tendons,
    Tracker,
    WarmStart,
    bounds,
    cold_start,
    estimate,
    find_warm_start,
    load_bound,
    place,
    score_test,
    shape_from_base,
    solve_displacement,
    solve_shape,
)
from torchrod.learned.warm_start import shipped
from torchrod.mechanics.grid import make_grid


@pytest.fixture(scope="module")
def seen():
    torch.set_default_dtype(torch.float64)
    study = study1(4)
    return S, study.positions


def test_numbers_of_single_precision(seen):
    """As a camera gives them: markers, offsets, a start and its covariance."""
    s, p = seen
    whole = estimate(posed(s, p, offsets=torch.zeros(20, 3)))
    problem = posed(s.float(), p.float(), torch.full((4,), 1e-3).float(), offsets=torch.zeros(20, 3).float())
    single = problem.markers
    assert single is not None
    assert all(x.dtype == torch.float64 for x in vars(single).values() if x is not None)
    cold = cold_start(problem)
    start = Start(cold.x.float(), cold.origin, cold.challenged, torch.eye(problem.size).float().repeat(4, 1, 1))
    for fit in (estimate(problem), estimate(problem, start=start)):
        assert torch.allclose(fit.force, whole.force, atol=1e-4) and fit.accepted.all()
    follow = Tracker(problem.robot, problem.unknowns, s.float(), 1e-3)
    assert torch.allclose(follow(p[0].float()).force[0], whole.force[0], atol=1e-3)


def f(*numbers: object) -> torch.Tensor:
    """As torch.tensor makes it where nobody has asked for float64."""
    return torch.tensor(numbers, dtype=torch.float32)


LOADS = {
    "gaussian": lambda: GaussianLoads(f([8.0, -3.0]).unsqueeze(0), f([0.25]), f([5e3])),
    "point": lambda: PointForces(f([[0.6, -0.3, 0.0]]), f([0.25])),
    "wrench": lambda: PointWrenches(f([0.1, 0.0, -0.1]), f([0.0, 0.01, 0.0]), f(0.3)),
    "fourier": lambda: FourierLoads(f([0.5, 0.2], [0.1, 0.0]), f([0.1], [0.2]), 0.4),
    "polynomial": lambda: PolynomialLoads(f([0.5, 0.2], [0.1, 0.0]), 0.4),
}


def doubled(what: Any) -> Any:
    """The same numbers, given in float64."""
    tensors = {name: x for name, x in vars(what).items() if isinstance(x, torch.Tensor)}
    return replace(what, **{name: x.double() for name, x in tensors.items()})


def equal(a: Any, b: Any) -> bool:
    """Every tensor of two answers, to the bit and in float64 where it is of numbers."""
    pairs = [(x, getattr(b, name)) for name, x in vars(a).items() if isinstance(x, torch.Tensor)]
    return all(torch.equal(x, y) and x.dtype == y.dtype != torch.float32 for x, y in pairs)


@pytest.mark.parametrize("kind", LOADS)
def test_known_loads_of_single_precision(kind):
    """Forward solves, as a user writes them who has not read that physics is done in float64: as if the numbers had been so."""
    torch.set_default_dtype(torch.float32)
    given = LOADS[kind]()
    assert equal(given, doubled(given))
    s, tension, gravity, K = f(0.1, 0.2, 0.4), f([1.0]), f(0.0, -9.81, 0.0), torch.diag(f(1e5, 1e5, 3e5))
    bending = 1e-7 * K
    found = []
    for to in (torch.float32, torch.float64):
        load = given if to == torch.float32 else doubled(given)
        rod = Rod.from_stiffness(0.4, K.to(to), bending.to(to), 0.012)
        robot = Robot(rod, Tendons((Tendon.straight(0.01, 0.0, 0.4),)), gravity.to(to))
        assert equal(rod, doubled(rod)) and equal(robot, doubled(robot))
        solved = solve_shape(robot, (load,), tension.to(to), s.to(to), 1)
        again = shape_from_base(robot, (load,), solved.base_wrench.float().to(to), tension.to(to), s.to(to), 40)
        found.append([solved, again])
        if kind == "point":  # that the tendon is pulled by a length has nothing to do with the load
            found[-1].append(solve_displacement(robot, (load,), f([1e-3]).to(to), s.to(to)).equilibrium)
            assert found[-1][-1].status == 0
        assert solved.status == 0
    assert all(equal(single, double) for single, double in zip(*found, strict=True))


def test_bounds_and_placement_of_single_precision():
    torch.set_default_dtype(torch.float32)
    robot = Robot(Rod.circular(0.4, 1.4e-3, 207e9, 79e9), Tendons((Tendon.straight(0.01, 0.0, 0.4),)))
    s, tension, places, force, where = torch.linspace(0.02, 0.4, 20), f(1.0), f(0.2, 0.3), f([0.5, 0.0]), f(0.3)
    found = []
    for to in (torch.float32, torch.float64):
        bound = bounds(robot, s.to(to), 1e-3, 0.5, places.to(to), tension.to(to), directions=2)
        push = PointForces(f([[0.5, 0.0, 0.0]]).to(to), f([0.3]).to(to))
        markers = Markers(s.to(to), torch.zeros(1, 20, 3), 1e-3)
        wrench = solve_shape(robot, (push,), f([1.0]).to(to), s.to(to), 1).base_wrench.float().to(to)
        std = load_bound(robot, markers, force.to(to), where.to(to), wrench, f([1.0]).to(to))
        found.append((bound, place(robot, 4, 1e-3, 0.5, tension.to(to), directions=2), std))
    assert all(equal(single, double) for single, double in zip(found[0][:2], found[1][:2], strict=True))
    assert all(torch.equal(single, double) for single, double in zip(found[0][2], found[1][2], strict=True))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (
            {"positions": torch.zeros(4, 15, 3)},
            r"Markers.positions has shape \(4, 15, 3\); .* \(4, 20, 3\) with 20 arc lengths and 4 samples",
        ),
        ({"offsets": torch.zeros(5, 3)}, r"Markers.offsets has shape \(5, 3\)"),
        ({"tension": torch.zeros(3, 2)}, r"tension has shape \(3, 2\).*\(4, 2\)"),
        ({"noise": torch.ones(1)}, r"Markers.noise has shape \(1,\)"),
        ({"s": torch.zeros(1, 20)}, r"Markers.s has shape"),
    ],
)
def test_shapes_that_do_not_belong_together(seen, changed, said):
    tendons = "tension" in changed
    given = {"s": seen[0], "positions": seen[1], "robot": busy_robot() if tendons else steel_rod()} | changed
    with pytest.raises(ValueError, match=said):
        estimate(posed(**given))


def test_starts_and_gravity_that_do_not_fit(seen):
    with pytest.raises(ValueError, match=r"start.x has shape \(4, 3\); these measurements and unknowns need \(4, 10\)"):
        estimate(posed(*seen), start=lambda _: Start.at(torch.zeros(4, 3), Origin.OTHER_FIT))
    tilted = Robot(steel_rod().rod, gravity=torch.zeros(4, 3))
    with pytest.raises(ValueError, match="one gravity"):
        estimate(posed(*seen, robot=tilted))


@pytest.mark.many_fits
def test_inference_mode(seen):
    """Tensors made in it do not tell whether they have been changed; what is kept must serve outside of it, too."""
    s, p = seen
    whole = estimate(posed(s, p))
    shipped.cache_clear()
    with torch.inference_mode():
        problem = posed(s.clone(), p.clone())
        start = find_warm_start(problem)
        assert isinstance(start, WarmStart)
        within = [estimate(problem), estimate(problem, start=start)]
        follow = Tracker(problem.robot, problem.unknowns, s.clone(), 1e-3)
        within += [follow(p[0].clone()), follow(p[0].clone())]
    within += [estimate(problem, start=start), follow(p[0])]
    assert not any(p.is_inference() for p in start.network.parameters()), "they are kept, and packed anew for each call if they are"
    for fit in within:
        assert not fit.force.is_inference()
        assert torch.allclose(fit.force, whole.force[: len(fit.force)], atol=1e-4)


@pytest.mark.parametrize("kind", [GaussianCoordinates, PointCoordinates])
def test_locations_may_be_a_list(seen, kind):
    robot = steel_rod()
    places: list[Any] = [[0.2], (0.2,)]
    families = [kind(1, 0.4, robot.rod.force_scale, locations=at) for at in places]
    fits = [estimate(posed(*seen, loads=one)) for one in families]
    assert torch.equal(fits[0].force, fits[1].force)


@pytest.mark.parametrize("tendons", [False, True])
def test_no_samples_at_all(tendons):
    robot = busy_robot() if tendons else steel_rod()
    tension = torch.zeros(0, len(robot.tendons)) if tendons else None
    problem = posed(torch.linspace(0.02, 0.2, 10), torch.zeros(0, 10, 3), robot=robot, tension=tension)
    assert problem.h(torch.zeros(0, problem.size)).shape == (0, 36)
    with pytest.raises(ValueError, match="at least one sample"):
        estimate(problem)


def test_the_tip_in_single_precision_is_the_tip():
    outputs = torch.tensor([0.1, 0.3], dtype=torch.float32).double()
    assert outputs[-1] > 0.3
    grid = make_grid(0.3, outputs)
    assert float(grid.nodes[-1]) == 0.3 and int(grid.outputs[-1]) == len(grid.nodes) - 1


def test_places_off_the_rod():
    """A point load off it makes its own sample invalid; outputs off it are refused; the tip may be a float32's breadth beyond."""
    robot, s = steel_rod(), torch.linspace(0.02, 0.4, 20, dtype=torch.float32)
    force, moment = torch.tensor([[[0.6, -0.3, 0.0]]]), torch.zeros(1, 1, 3)
    whole = solve_shape(robot, (PointForces(force, torch.tensor([[0.4]])),), None, s, 3)
    places = torch.tensor([[0.4], [0.5], [-0.01]])
    for load in (PointForces(force, places), PointForces(force, places.float())):
        solved = solve_shape(robot, (load,), None, s, 3)
        assert solved.status.tolist() == [0, 2, 2]
        assert (solved.p[0] - whole.p[0]).abs().max() < 1e-7 and solved.p[1:].isnan().all()
    wrench = PointWrenches(force, moment, torch.tensor([0.5]))
    assert solve_shape(robot, (wrench,), None, s, 1).status.tolist() == [2]
    for beyond in (torch.tensor([0.1, 0.41]), torch.tensor([-0.1, 0.4]), torch.tensor([0.1, torch.nan])):
        with pytest.raises(ValueError, match=r"outside the rod of 0 to 0.4 m"):
            solve_shape(robot, (), None, beyond, 1)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: GaussianCoordinates(1, 0.4, 1.0, "contacts"), "prior_name is 'contacts'; it must be one of point, contact"),
        (lambda: GaussianCoordinates(2, 0.4, 1.0, locations=(0.1,)), "locations has 1 places for 2 loads; give one for each"),
        (lambda: PointCoordinates(1, 0.4, 1.0, (0.5,)), "must lie on the rod, 0 to 0.4 m"),
        (lambda: GaussianCoordinates(-1, 0.4, 1.0), "-1 loads; give 0 or more"),
        (lambda: FourierCoordinates(3, 0.4, -1.0), r"force_scale is -1.0 N; it must be finite and not negative"),
        (lambda: GaussianCoordinates(1, float("nan"), 1.0), "length is nan; it must be positive"),
    ],
)
def test_load_families_that_make_no_sense_are_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()


def test_the_score_test_is_of_gaussian_loads():
    problem = posed(torch.tensor([0.2, 0.4]), torch.zeros(1, 2, 3), loads=PointCoordinates(1, 0.4, 1.0))
    with pytest.raises(ValueError, match="the loads are PointCoordinates; give a problem with GaussianCoordinates"):
        score_test(problem, torch.zeros(1, problem.size))
