"""What the Python interface does with tensors that are not quite what it wants."""

from typing import Any

import pytest
import torch

from tests.robots import busy_robot, steel_rod
from tests.study import study1
from torchrod import (
    Estimator,
    GaussianCoordinates,
    Markers,
    Model,
    PointCoordinates,
    Robot,
    Start,
    WarmStart,
    cold_start,
    estimate,
    find_warm_start,
)
from torchrod.grid import make_grid
from torchrod.warmstart import shipped


@pytest.fixture(scope="module")
def seen():
    torch.set_default_dtype(torch.float64)
    study = study1(4)
    return study.s, study.positions


def one_contact(robot: Robot | None = None) -> Model:
    robot = robot or steel_rod()
    return Model(robot, GaussianCoordinates(1, 0.4, robot.rod.force_scale))


def test_numbers_of_single_precision(seen):
    """As a camera gives them: markers, offsets, a start and its covariance."""
    s, p = seen
    model, markers = one_contact(), Markers(s, p, torch.zeros(20, 3))
    whole = estimate(model, markers, 1e-3)
    single = Markers(*(x.float() for x in (s, p, torch.zeros(20, 3))))
    assert all(x is not None and x.dtype == torch.float64 for x in (single.s, single.positions, single.offsets))
    cold = cold_start(model, single, 1e-3)
    start = Start(cold.x.float(), torch.eye(model.size).float().repeat(4, 1, 1), cold.warm)
    for fit in (estimate(model, single, 1e-3), estimate(model, single, 1e-3, start=start)):
        assert torch.allclose(fit.force, whole.force, atol=1e-4) and fit.accepted.all()
    follow = Estimator(model, s.float(), 1e-3)
    assert torch.allclose(follow(p[0].float()).force[0], whole.force[0], atol=1e-3)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (
            {"positions": torch.zeros(4, 15, 3)},
            r"markers.positions has shape \(4, 15, 3\); with 20 arc lengths and 4 samples .* \(4, 20, 3\)",
        ),
        ({"offsets": torch.zeros(5, 3)}, r"markers.offsets has shape \(5, 3\)"),
        ({"tension": torch.zeros(3, 2)}, r"markers.tension has shape \(3, 2\).*\(4, tendons\)"),
        ({"sigma": torch.ones(1)}, r"markers.sigma has shape \(1,\)"),
        ({"s": torch.zeros(1, 20)}, r"markers.s has shape"),
    ],
)
def test_shapes_that_do_not_belong_together(seen, changed, said):
    with pytest.raises(ValueError, match=said):
        estimate(one_contact(), Markers(**({"s": seen[0], "positions": seen[1]} | changed)), 1e-3)


def test_starts_and_gravity_that_do_not_fit(seen):
    model, markers = one_contact(), Markers(*seen)
    with pytest.raises(ValueError, match=r"start.x has shape \(4, 3\); these markers and this model need \(4, 10\)"):
        estimate(model, markers, 1e-3, start=lambda *_: Start.known(torch.zeros(4, 3)))
    tilted = one_contact(Robot(steel_rod().rod, gravity=torch.zeros(4, 3)))
    with pytest.raises(ValueError, match="one gravity"):
        estimate(tilted, markers, 1e-3)


@pytest.mark.many_fits
def test_inference_mode(seen):
    """Tensors made in it do not tell whether they have been changed; what is kept must serve outside of it, too."""
    s, p = seen
    whole = estimate(one_contact(), Markers(s, p), 1e-3)
    shipped.cache_clear()
    with torch.inference_mode():
        model, markers = one_contact(), Markers(s.clone(), p.clone())
        start = find_warm_start(model)
        assert isinstance(start, WarmStart)
        within = [estimate(model, markers, 1e-3), estimate(model, markers, 1e-3, start=start)]
        follow = Estimator(model, s.clone(), 1e-3)
        within += [follow(p[0].clone()), follow(p[0].clone())]
    within += [estimate(model, markers, 1e-3, start=start), follow(p[0])]
    assert not any(p.is_inference() for p in start.network.parameters()), "they are kept, and packed anew for each call if they are"
    for fit in within:
        assert not fit.force.is_inference()
        assert torch.allclose(fit.force, whole.force[: len(fit.force)], atol=1e-4)


@pytest.mark.parametrize("kind", [GaussianCoordinates, PointCoordinates])
def test_locations_may_be_a_list(seen, kind):
    robot = steel_rod()
    places: list[Any] = [[0.2], (0.2,)]
    coordinates = [kind(1, 0.4, robot.rod.force_scale, locations=at) for at in places]
    fits = [estimate(Model(robot, one), Markers(*seen), 1e-3) for one in coordinates]
    assert torch.equal(fits[0].force, fits[1].force)


@pytest.mark.parametrize("tendons", [False, True])
def test_no_samples_at_all(tendons):
    robot = busy_robot() if tendons else steel_rod()
    model = one_contact(robot)
    s = torch.linspace(0.02, 0.2, 10)
    markers = Markers(s, torch.zeros(0, 10, 3), tension=torch.zeros(0, len(robot.tendons)) if tendons else None)
    x = torch.zeros(0, model.size)
    assert model.h(x, markers).shape == (0, 36)
    with pytest.raises(ValueError, match="at least one sample"):
        estimate(model, markers, 1e-3)


def test_the_tip_in_single_precision_is_the_tip():
    outputs = torch.tensor([0.1, 0.3], dtype=torch.float32).double()
    assert outputs[-1] > 0.3
    grid = make_grid(0.3, outputs)
    assert float(grid.nodes[-1]) == 0.3 and int(grid.outputs[-1]) == len(grid.nodes) - 1
