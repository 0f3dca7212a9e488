"""What is only nearly known of a robot: the model of its errors, what it does to intervals, and [uncertainty] of ROBOT.toml."""

import json
import math
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from jsonargparse import Namespace

from tests.problems import posed, slopes, unknowns_of
from tests.robots import T, busy_robot, steel_rod
from torchrod import (
    GaussianCoordinates,
    Markers,
    Piece,
    PointCoordinates,
    PointForces,
    Problem,
    Registration,
    Robot,
    Rod,
    Tendons,
    Uncertainty,
    Unknowns,
    estimate,
    solve_shape,
)
from torchrod.cli import main
from torchrod.cli.estimate import _sampled
from torchrod.estimation.draws import posterior_draws
from torchrod.estimation.evaluator import KernelEvaluator, MisreadEvaluator, TorchEvaluator, evaluator
from torchrod.estimation.intervals import intervals, resultant
from torchrod.mechanics.jacobian import pointwise_jacobian
from torchrod.model.deviations import Deviations
from torchrod.model.uncertainty import Found

S = torch.linspace(0.02, 0.4, 20)
EVERY = Uncertainty(0.03, 0.05, 0.04, 0.1, 0.1, 0.2, 0.1, 0.05, 0.2, 1e-3, 0.02, 0.05)


def problem_of(robot: Robot, uncertainty: Uncertainty, steps: int = 8, **unknown) -> Problem:
    tension = T([[3.0, 2.0], [1.0, 0.5]])[:, : len(robot.tendons)] if len(robot.tendons) else None
    positions = 0.1 * torch.randn(2, 3, 3, generator=torch.Generator().manual_seed(0))
    return posed(T([0.1, 0.25, 0.4]), positions, 1e-3, robot, None, tension, steps=steps, uncertainty=uncertainty, **unknown)


def known(problem: Problem, robot: Robot) -> tuple[Problem, slice]:
    """The same of a robot that is known, in the same units; and which entries of x it has not."""
    exact = problem.of(replace(problem.unknowns, uncertainty=None))
    other = replace(exact, robot=robot)
    vars(other)["state"] = exact.state
    return other, problem.state.parameters.at


def of_robot(problem: Problem, x: torch.Tensor, robot: Robot) -> torch.Tensor:
    """h of another robot, at x but for its errors."""
    other, at = known(problem, robot)
    return other.h(torch.cat([x[:, : at.start], x[:, at.stop :]], -1), False)


@pytest.mark.parametrize("robot", [steel_rod, busy_robot])
def test_jacobian(robot):
    problem = problem_of(robot(), Uncertainty(stiffness=0.03, friction=0.1, set=0.1), registration=Registration())
    x = 0.3 * torch.randn(2, problem.size, generator=torch.Generator().manual_seed(0))
    h, H = problem.linearized(x)
    assert torch.allclose(h, problem.h(x, differentiable=False), rtol=0, atol=1e-12)
    assert torch.allclose(slopes(problem, x, 1e-5, differentiable=False), H, rtol=1e-6, atol=1e-6)


def test_the_parameters_are_those_that_a_robot_has():
    passive, pulled = (tuple(p.name for p in EVERY.parameters(r())) for r in (steel_rod, busy_robot))
    bumps = [f"curvature_{axis}_{k}" for axis in "xy" for k in range(1, 6)]
    assert set(passive) == {
        "stiffness",
        "oval_1",
        "oval_2",
        "set_x",
        "set_y",
        *bumps,
        *(f"metric_{axes}" for axes in ("xx", "yy", "zz", "yz", "xz", "xy")),
    }
    of_tendons = {f"{k}_{j}" for k in ("tension", "tension_offset", "friction", "tendon_x", "tendon_y") for j in (1, 2)}
    assert set(pulled) - set(passive) == {"mass", "gravity_1", "gravity_2", *of_tendons}


@pytest.mark.parametrize(
    "name",
    [
        *(
            "stiffness",
            "mass",
            "tension_1",
            "friction_2",
            "gravity_1",
            "set_y",
            "curvature_x_2",
            "tension_offset_2",
            "tendon_x_1",
            "oval_2",
        ),
        "metric_xz",
    ],
)
@pytest.mark.parametrize("sign", [1.0, pytest.param(-1.0, marks=pytest.mark.study)])
def test_one_standard_deviation_is_a_robot_that_is_off_by_it(name, sign):
    """h at theta = +-1 is h of the changed robot, by numbers written here."""
    robot = busy_robot()
    problem = problem_of(robot, EVERY, 20)
    names = [p.name for p in EVERY.parameters(robot)]
    x = torch.zeros(2, problem.size)
    generator = torch.Generator().manual_seed(1)
    free = [i for i in range(problem.size) if not problem.state.parameters.at.start <= i < problem.state.parameters.at.stop]
    x[:, free] = 0.3 * torch.randn(2, len(free), generator=generator)
    plain = x[:, free]
    x[:, problem.state.parameters.at.start + names.index(name)] = sign
    rod, gravity, tendons, tension = robot.rod, robot.gravity, list(robot.tendons.tendons), problem.tension
    options = [gravity]
    assert tension is not None
    if name == "stiffness":
        rod = replace(rod, K_se=(1 + 0.03 * sign) * rod.K_se, K_bt=(1 + 0.03 * sign) * rod.K_bt)
    elif name == "mass":
        rod = replace(rod, mass_per_length=(1 + 0.05 * sign) * rod.mass_per_length)
    elif name == "oval_2":
        EI = float((rod.K_bt[0, 0] * rod.K_bt[1, 1]).sqrt())
        rod = replace(rod, K_bt=rod.K_bt + 0.05 * sign * EI * T([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    elif name == "tension_1":
        tension = tension * T([1 + 0.04 * sign, 1.0])
    elif name == "friction_2":
        tendons[1] = replace(tendons[1], friction=0.1 * sign)
    elif name == "gravity_1":
        turned = T([math.cos(0.05), 0.0, 0.0]) * 9.81
        change = sign * math.sin(0.05) * 9.81
        options = [turned + T([0.0, change, 0.0]), turned + T([0.0, 0.0, change])]
        options += [turned - T([0.0, change, 0.0]), turned - T([0.0, 0.0, change])]
    elif name == "tension_offset_2":
        tension = tension + T([0.0, 0.2 * sign])
    elif name == "tendon_x_1":
        tendons[0] = replace(tendons[0], routing=tuple((s, x + 1e-3 * sign, y) for s, x, y in tendons[0].routing))
    elif name == "set_y":
        rod = replace(rod, reference_curvature=rod.reference_curvature + T([[0.0, 0.0, 0.1 * sign, 0.0]]))
    elif name == "curvature_x_2":
        rows = torch.stack([torch.linspace(0, 0.4, 5), *torch.zeros(3, 5)], -1)
        rows[1, 1] = 0.2 * sign
        rod = replace(rod, reference_curvature=rows)
    (exact, _), found = known(problem, robot), problem.h(x, False)

    def off(gravity):
        other = replace(exact, robot=replace(robot, rod=rod, gravity=gravity, tendons=Tendons(tuple(tendons))), tension=tension)
        vars(other)["state"] = exact.state
        h = other.h(plain, False)
        if name == "metric_xz":
            p = h[:, :9].unflatten(-1, (3, 3))
            h = torch.cat([(p + 0.02 * sign * p.flip(-1) * T([1.0, 0.0, 1.0])).flatten(1), h[:, 9:]], -1)
        return h

    errors = [float((found - off(g)).abs().max()) for g in options]
    assert min(errors) < 1e-6, "of grids with other nodes"
    assert float((found - exact.h(plain, False)).abs().max()) > 1e-5


def covered(robot: Robot, change, uncertainty: Uncertainty | None, tension=None, noise=1e-3, B=60) -> tuple[float, float]:
    """Shares of 95 % intervals of force and place that hold, on samples each of a robot of its own."""
    g, L = torch.Generator().manual_seed(11), robot.rod.length
    size = robot.rod.force_scale * (0.5 + 0.5 * torch.rand(B, 1, generator=g))
    turn, place = 2 * math.pi * torch.rand(B, 1, generator=g), L * (0.3 + 0.65 * torch.rand(B, 1, generator=g))
    load = PointForces(torch.stack([size * turn.cos(), size * turn.sin(), 0 * size], -1), place)
    readings = None if tension is None else tension * torch.rand(B, len(robot.tendons), generator=g)
    shapes = []
    for b in range(B):
        own, pulled = change(robot, None if readings is None else readings[b : b + 1], g)
        shapes.append(solve_shape(own, (load.take(torch.tensor([b])),), pulled, S, 1).p)
    p = torch.cat(shapes)
    p = p + noise * L * torch.randn(p.shape, generator=g)
    unknowns = Unknowns(GaussianCoordinates(1, L, robot.rod.force_scale), uncertainty=uncertainty)
    fit = estimate(Problem(robot, unknowns, [Markers(S, p, noise * L)], readings))
    assert int((fit.status == 0).sum()) >= B - 1
    held = [
        ((i[..., 0] <= t) & (t <= i[..., 1])).double().mean()
        for i, t in ((fit.magnitude_interval, size), (fit.location_interval, place))
    ]
    return float(held[0]), float(held[1])


def bent(robot, tension, g):
    """A set of 0.2/m."""
    rows = robot.rod.reference_curvature.clone()
    rows[:, 1:3] += 0.2 * torch.randn(1, 2, generator=g)
    return replace(robot, rod=replace(robot.rod, reference_curvature=rows)), tension


def stiffer(robot, tension, g):
    k = 1 + 0.1 * float(torch.randn(1, generator=g))
    return replace(robot, rod=replace(robot.rod, K_se=k * robot.rod.K_se, K_bt=k * robot.rod.K_bt)), tension


def rubbing(robot, tension, g):
    mu = (0.15 * torch.randn(len(robot.tendons), generator=g)).tolist()
    return replace(
        robot, tendons=Tendons(tuple(replace(t, friction=m) for t, m in zip(robot.tendons.tendons, mu, strict=True)))
    ), tension


@pytest.mark.study
@pytest.mark.parametrize(
    ("robot", "change", "stated", "tension"),
    [
        (steel_rod, bent, Uncertainty(set=0.2), None),
        (steel_rod, stiffer, Uncertainty(stiffness=0.1), None),
        (busy_robot, rubbing, Uncertainty(friction=0.15), 6.0),
    ],
)
def test_intervals_hold_where_the_error_is_stated(robot, change, stated, tension):
    force, place = covered(robot(), change, stated, tension)
    assert min(force, place) > 0.87
    exact = covered(robot(), change, None, tension)
    assert min(exact) < 0.85, "taken as exact, one of the two does not"


def test_from_the_file_to_the_result(tmp_path, capsys):
    rod, (robot, s) = (
        'name = "rod"\n[rod]\nlength = 0.4\ndiameter = 0.0014\nyoungs_modulus = 207e9\nshear_modulus = 79e9\n',
        (steel_rod(), S),
    )
    p = solve_shape(robot, (PointForces(T([[[0.6, 0.1, 0.0]]]), T([[0.3]])),), None, s, 1).p[0]
    (tmp_path / "s.csv").write_text("s,x,y,z\n" + "\n".join(",".join(map(str, row)) for row in np.column_stack([s, p]).tolist()))
    spreads = []
    for stated in ("", "[uncertainty]\nstiffness = 0.05\nset = 0.1\nframe = [0.001, 0.005]\n"):
        (tmp_path / "r.toml").write_text(rod + stated)
        out = str(tmp_path / "r.json")
        assert main(["estimate", str(tmp_path / "r.toml"), str(tmp_path / "s.csv"), "--noise", "1e-3", "--out", out]) == 0
        (record,) = json.loads((tmp_path / "r.json").read_text())["results"]
        spreads.append(record["loads"][0]["std"]["magnitude_N"])
    assert set(record["parameters"]) == {"stiffness", "set_x", "set_y"}
    assert record["parameters"]["stiffness"]["std"] == pytest.approx(0.05, rel=1e-3), "a passive rod's push tells nothing of it"
    assert "registration" in record
    assert spreads[1] ** 2 > spreads[0] ** 2 + (0.04 * 0.6) ** 2
    capsys.readouterr()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("stiffness = -0.1", "stiffness is -0.1; it must be a finite standard deviation"),
        ("stiffnes = 0.1", "stiffnes"),
        ('mass = "x"', "uncertainty.mass"),
        ("frame = [0.001]", "uncertainty.frame"),
        ("frame = [0.001, 3.0]", "3 degrees are 0.052"),
        ("curvature_length = 0", "curvature_length is 0"),
        ("stiffness = 3", "stiffness is 3.0; it is a share"),
    ],
)
def test_bad_input(text, said, tmp_path, capsys):
    path = tmp_path / "r.toml"
    path.write_text(
        f"[rod]\nlength = 0.4\ndiameter = 0.0014\nyoungs_modulus = 207e9\nshear_modulus = 79e9\n[uncertainty]\n{text}\n"
    )
    (tmp_path / "s.csv").write_text("s,x,y,z\n0.2,0,0,0.2\n0.4,0,0,0.4\n")
    assert main(["estimate", str(path), str(tmp_path / "s.csv")]) == 2
    error = capsys.readouterr().err
    assert said in error and str(path) in error and error.count("\n") == 1


def test_a_learned_start_steps_aside_and_other_unknowns_stay():
    problem = problem_of(busy_robot(), EVERY, tip="force")
    assert problem.state.free_size == 4 + 3
    assert unknowns_of(steel_rod(), uncertainty=EVERY).uncertainty is EVERY
    with pytest.raises(ValueError, match="do not go together"):
        unknowns_of(busy_robot(), uncertainty=EVERY, tension_std=0.2)


def with_discs() -> Robot:
    robot = busy_robot()
    return replace(robot, tendons=Tendons(tuple(replace(t, discs=(0.1, 0.2, 0.3)) for t in robot.tendons.tendons)))


def rubbing_with_masses() -> Robot:
    robot = busy_robot()
    tendons = tuple(replace(t, friction=mu) for t, mu in zip(robot.tendons.tendons, (0.1, 0.3), strict=True))
    return replace(robot, tendons=Tendons(tendons), rod=replace(robot.rod, masses=T([[0.15, 0.01], [0.4, 0.02]])))


def in_pieces() -> Robot:
    rod = steel_rod().rod
    first = Piece.of_stiffness(0.2, rod.K_se, rod.K_bt, 0.02)
    rod = Rod.of_pieces((first, Piece.of_stiffness(0.4, (rod.K_se, 0.5 * rod.K_se), (rod.K_bt, 0.4 * rod.K_bt), 0.01)))
    return Robot(rod, gravity=T([0.0, 3.0, -9.0]))


def skew() -> Robot:
    """K_bt with all of its entries."""
    rod = steel_rod().rod
    more = rod.K_bt[0, 0] * T([[0.0, 0.3, 0.1], [0.3, 0.0, 0.0], [0.1, 0.0, 0.0]])
    return Robot(replace(rod, K_bt=rod.K_bt + more))


ROBOTS = [steel_rod, busy_robot, with_discs, rubbing_with_masses, in_pieces, skew]
OVERALL = replace(EVERY, curvature_length=0.2)  # two bumps of curvature


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize(
    ("stated", "nu"),
    [
        (OVERALL, 5.0),
        (replace(OVERALL, metric=0.0), math.inf),
        (replace(OVERALL, metric=0.0, friction=0.0), 5.0),
        (Uncertainty(stiffness=0.1, set=0.1), math.inf),
    ],
    ids=["all", "as measured", "smooth", "two"],
)
def test_the_kernel_on_robots_that_are_off_is_the_torch_model(robot, stated, nu):
    problem = problem_of(robot(), stated, 2, registration=Registration())
    x = 0.3 * torch.randn(2, problem.size, generator=torch.Generator().manual_seed(0))
    fast, slow = evaluator(problem, nu), TorchEvaluator(problem, nu)
    assert isinstance(fast, MisreadEvaluator if stated.metric else KernelEvaluator)
    assert torch.allclose(fast.cost(x), slow.cost(x), rtol=1e-9)
    one = torch.tensor([1])
    for a, b in ((fast.sums(x), slow.sums(x)), (fast.take(one).sums(x[one]), slow.take(one).sums(x[one]))):
        for name in ("A", "g", "cost", "C", "r", "line"):
            ours, theirs = getattr(a, name), getattr(b, name)
            assert torch.allclose(ours, theirs, rtol=1e-9, atol=1e-9 * float(theirs.abs().max())), name


@pytest.mark.parametrize("robot", [steel_rod, in_pieces])
def test_nodes_move_with_a_load_on_robots_that_are_off(robot):
    loads = PointCoordinates(2, 0.4, 1.0)
    heavy = replace(robot(), rod=replace(steel_rod().rod, mass_per_length=T(0.05)), gravity=T([0.0, 3.0, -9.0]))
    stated = Uncertainty(stiffness=0.1, oval=0.05, set=0.1, mass=0.1, gravity=0.05)
    problem = problem_of(heavy if robot is steel_rod else robot(), stated)
    problem = problem.of(replace(problem.unknowns, loads=loads))
    x = 0.3 * torch.randn(2, problem.size, generator=torch.Generator().manual_seed(0))
    fast, slow = evaluator(problem), TorchEvaluator(problem)
    assert isinstance(fast, KernelEvaluator if robot is steel_rod else TorchEvaluator), "pieces do not move along"
    for ours, theirs in zip(fast.linearized(x), slow.linearized(x), strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-10, atol=1e-10 * float(theirs.abs().max()))


@pytest.mark.parametrize("robot", ROBOTS)
@given(seed=st.integers(0, 2**31))
@settings(max_examples=6, deadline=None)
def test_all_errors_at_once_are_one_robot(robot, seed):
    """Of any sizes to three deviations: h is that of the robot that is off by all, found by changing it by one after the other."""
    robot, g = robot(), torch.Generator().manual_seed(seed)
    problem = problem_of(robot, OVERALL, 20)
    if problem.tension is not None:
        problem = replace(problem, tension=problem.tension + 1.0)  # none goes slack
    x = 0.3 * torch.randn(2, problem.size, generator=g)
    nearly, at = problem.deviations, problem.state.parameters.at
    assert nearly is not None
    theta = 3 * (2 * torch.rand(at.stop - at.start, generator=g) - 1)
    theta *= torch.rand(len(theta), generator=g) < 0.5  # some are as stated
    x[:, at] = theta
    errors = dict(zip(nearly.names, problem.state.parameters.of(x)[0].tolist(), strict=True))
    other, warp = OVERALL.found_at(nearly.prepared, errors)
    true, found = of_robot(problem, x, other), problem.h(x, False)
    p = warp(true[:, :-6].unflatten(-1, (-1, 3))).flatten(1)
    assert torch.allclose(found, torch.cat([p, true[:, -6:]], -1), rtol=1e-9, atol=1e-9)


def test_a_stiffness_stays_positive_however_far_a_step_goes():
    problem = problem_of(steel_rod(), Uncertainty(stiffness=0.3, oval=0.2), 20)
    x = torch.zeros(2, problem.size)
    x[:, problem.state.base.at] = 0.02
    for entry in range(3):
        for far in (-20.0, 20.0):
            x[:, problem.state.parameters.at] = far * torch.eye(3)[entry]
            h, H = evaluator(problem).linearized(x)
            assert torch.isfinite(h).all() and torch.isfinite(H).all()
            assert torch.allclose(slopes(problem, x, 1e-4, differentiable=False), H, rtol=1e-5, atol=1e-5 * float(H.abs().max()))


def test_a_load_cell_whose_zero_is_off_lets_a_tendon_go_slack():
    """Well above zero the tension is the reading with its errors, well below it is next to none, and in between it has no kink."""
    robot = busy_robot()
    stated = Uncertainty(tension=0.1, tension_offset=0.5)
    nearly = Deviations(stated, robot)
    reading = T([[4.0, 0.0]]).expand(7, 2)
    theta = torch.zeros(7, 4)
    offset = [nearly.names.index(f"tension_offset_{j}") for j in (1, 2)]
    theta[:, offset] = torch.linspace(-3, 3, 7).unsqueeze(-1)
    theta[:, nearly.names.index("tension_1")] = 1.0
    kappa = nearly.amounts(theta, reading)
    assert torch.allclose(kappa[:, 0], 0.5 * theta[:, offset[0]] + 0.4)
    assert torch.allclose(kappa[4:, 1], 0.5 * theta[4:, offset[1]])
    assert (kappa[:3, 1] <= 0).all() and (kappa[:3, 1] > -0.05).all()


@pytest.mark.parametrize("robot", ROBOTS)
@given(seed=st.integers(0, 2**31), size=st.sampled_from([0.0, 0.3, 3.0, 30.0]))
@settings(max_examples=8, deadline=None)
def test_the_slopes_of_the_amounts_are_their_derivatives(robot, seed, size):
    """Also where a tendon goes slack, a stiffness would fall below nothing, or gravity has turned far."""
    g, nearly = torch.Generator().manual_seed(seed), Deviations(OVERALL, robot())
    theta = size * torch.randn(5, len(nearly.names), generator=g)
    reading = 4 * torch.rand(5, len(nearly.robot.tendons), generator=g).round(decimals=1)
    _, J = pointwise_jacobian(lambda at: nearly.amounts(at, reading), theta)
    found = nearly.slopes(theta, reading)
    assert torch.allclose(found, J, rtol=1e-9, atol=1e-9 * float(J.abs().max()))


def test_errors_that_a_calibration_leaves_go_together():
    """x = e_k of the parameters is the robot whose errors are the k-th column of a root of the covariance."""
    robot = busy_robot()
    names = ("stiffness", "tension_offset_2", "frame_x", "frame_turn_z")
    L = T([[0.03, 0, 0, 0], [0.1, 0.2, 0, 0], [1e-3, -5e-4, 5e-4, 0], [0.01, 0.0, -0.01, 0.01]])
    stated = Uncertainty(tension_offset=0.1, found=Found(names, L @ L.T))
    listed = stated.parameters(robot)
    assert [p.name for p in listed] == ["tension_offset_1", "tension_offset_2", "stiffness", "frame_x", "frame_turn_z"]
    order = [names.index(p.name) if p.name in names else -1 for p in listed]
    total = torch.zeros(5, 5)
    for i, a in enumerate(order):
        for j, b in enumerate(order):
            total[i, j] = (L @ L.T)[a, b] if min(a, b) >= 0 else 0.0
    total[:2, :2] += 0.01 * torch.eye(2)
    root = stated.root(robot)
    assert torch.allclose(root @ root.T, total, rtol=1e-9)
    problem = problem_of(robot, stated)
    state, x = problem.state, torch.zeros(2, problem.size)
    x[:, state.base.at] = 0.2
    for k in range(5):
        x[:, state.parameters.at] = torch.eye(5)[k]
        error = dict(zip((p.name for p in listed), root[:, k].tolist(), strict=True))
        assert torch.allclose(state.parameters.of(x)[0], root[:, k])
        rod, tendons = robot.rod, list(robot.tendons.tendons)
        rod = replace(rod, **{K: (1 + error["stiffness"]) * getattr(rod, K) for K in ("K_se", "K_bt")})
        tendons = [replace(t, tension_offset=error[f"tension_offset_{j + 1}"]) for j, t in enumerate(tendons)]
        h = of_robot(problem, x, replace(robot, rod=rod, tendons=Tendons(tuple(tendons))))
        c, s, p = math.cos(error["frame_turn_z"]), math.sin(error["frame_turn_z"]), h[:, :9].unflatten(-1, (3, 3))
        p = p @ T([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T + T([error["frame_x"], 0.0, 0.0])
        assert torch.allclose(problem.h(x, False), torch.cat([p.flatten(1), h[:, 9:]], -1), rtol=0, atol=1e-6), k
    fast = evaluator(problem)
    assert torch.allclose(fast.cost(x), TorchEvaluator(problem).cost(x), rtol=1e-9)


@pytest.mark.parametrize(
    ("names", "covariance", "words"),
    [
        (("a", "a"), [[1.0, 0.0], [0.0, 1.0]], "names a parameter twice"),
        (("a",), [[1.0, 0.0]], "one for each name"),
        (("a", "b"), [[1.0, 0.5], [0.4, 1.0]], "symmetric"),
        (("a", "b"), [[1.0, 2.0], [2.0, 1.0]], "negative eigenvalue"),
    ],
)
def test_what_is_no_covariance_is_refused(names, covariance, words):
    with pytest.raises(ValueError, match=words):
        Found(names, T(covariance))


def test_markers_know_nothing_of_a_stiffness_of_weightless_rods():
    """Force and stiffness go together: a model that is off by 1 % in how the shape moves with the stiffness, as a parabola through
    +-10 % is, takes that for knowledge at 0.1 % noise: a deviation of 9.3 instead of 10 %, intervals of force that hold 90 %.
    """
    robot = steel_rod()
    push = PointForces(T([[[0.5, 0.6, 0.0]], [[-0.9, 0.2, 0.0]]]), T([[0.25], [0.35]]))
    p = solve_shape(robot, (push,), None, S, 2, 80).p
    problem = Problem(robot, unknowns_of(robot, uncertainty=Uncertainty(stiffness=0.1)), [Markers(S, p, 4e-4)])
    fit = estimate(problem)
    assert fit.accepted.all() and fit.parameters_std is not None
    assert (fit.parameters_std > 0.0995).all()
    relative = fit.magnitude_std / fit.magnitude
    assert (relative > 0.098).all() and (relative < 0.13).all()


def test_a_strip_that_is_oval_by_more_than_it_bears_is_refused_in_one_sentence():
    K = steel_rod().rod.K_bt * torch.diag(T([30.0, 1 / 30, 1.0]))
    robot = replace(steel_rod(), rod=replace(steel_rod().rod, K_bt=K))
    with pytest.raises(ValueError, match=r"oval is 0.1, more than the rod's softer side has, 0.033 EI; state less"):
        estimate(problem_of(robot, Uncertainty(oval=0.1), 20))
    assert problem_of(robot, Uncertainty(oval=0.02), 20).size


@pytest.mark.parametrize("robot", [busy_robot, rubbing_with_masses, in_pieces])
def test_the_resultant_is_without_the_weight_that_the_robot_has(robot):
    """Base force less weight: of a robot that is off, its own."""
    problem = problem_of(robot(), OVERALL)
    x = torch.randn(2, problem.size, generator=torch.Generator().manual_seed(0))
    for b, errors in enumerate(problem.state.parameters.of(x).tolist()):
        assert problem.deviations is not None
        other, _ = OVERALL.found_at(robot(), dict(zip(problem.deviations.names, errors, strict=True)))
        weight = other.rod.mass * other.gravity
        assert torch.allclose(problem.own_weight(x)[b], weight)
        assert torch.allclose(resultant(problem, x.unsqueeze(1))[b, 0], problem.state.base.of(x)[b, :3] - weight)


def test_draws_where_it_is_unknown_whether_tendons_rub():
    """Theta is followed then, though the file has no friction: the base wrench comes by Newton steps, not by a walk."""
    robot = busy_robot()
    load = PointForces(0.5 * robot.rod.force_scale * T([[[0.6, 0.8, 0.0]]]), T([[0.25]]))
    p = solve_shape(robot, (load,), T([[6.0, 3.0]]), S, 1).p
    problem = Problem(robot, unknowns_of(robot, uncertainty=Uncertainty(friction=0.1)), [Markers(S, p, 4e-4)], T([[6.0, 3.0]]))
    fit = estimate(problem)
    found = intervals(posterior_draws(problem, fit), fit)
    low, high = found.location[0, 0].tolist()
    assert low < 0.25 < high and high - low < 8 * float(fit.location_std)


@pytest.mark.parametrize(("batch", "drawn"), [(10, True), (11, False)])
def test_few_samples_are_drawn_by_default_where_tendons_may_rub_and_the_metric_is_unknown(batch, drawn):
    robot = busy_robot()
    unknowns = unknowns_of(robot, uncertainty=Uncertainty(friction=0.1, metric=0.01))
    problem = Problem(robot, unknowns, [Markers(S, torch.zeros(batch, 20, 3), 1e-3)], torch.ones(batch, 2))
    options = Namespace(intervals=None, one_frame=False)
    with nullcontext() if drawn else pytest.warns(UserWarning, match="intervals of 11 samples are those of the covariance"):
        assert _sampled(options, problem, False) is drawn


@pytest.mark.parametrize("command", ["estimate", "observability"])
def test_a_strip_that_bears_less_than_is_stated_is_refused_by_the_commands(command, tmp_path, capsys):
    robot, shapes = tmp_path / "strip.toml", tmp_path / "s.csv"
    K = "K_se = [1e5, 1e5, 3e5]\nK_bt = [1.2, 0.0013, 0.03]"
    robot.write_text(f'name = "strip"\n[rod]\nlength = 0.3\n{K}\n[uncertainty]\noval = 0.1\n')
    shapes.write_text("s,x,y,z\n" + "".join(f"{0.03 * k},0,0,{0.03 * k}\n" for k in range(1, 11)))
    asked = [str(robot), *([str(shapes)] if command == "estimate" else ["--markers", "10"]), "--noise", "1e-3"]
    assert main([command, *asked]) == 2
    said = capsys.readouterr().err
    assert str(robot) in said and "oval is 0.1, more than the rod's softer side has" in said and said.count("\n") == 1


def test_parameters_are_those_of_the_robot_whatever_was_asked_before():
    """Of two robots alike but for the mass per length, with a mass at the tip, one has a mass that may be off."""
    stated = Uncertainty(stiffness=0.05, mass=0.1)
    for mass in (0.05, 0.0, 0.05):
        rod = replace(steel_rod().rod, mass_per_length=T(mass), masses=T([[0.4, 0.02]]))
        problem = problem_of(Robot(rod, gravity=T([0.0, 3.0, -9.0])), stated)
        assert problem.deviations is not None and problem.state.parameters.size == len(problem.deviations.names) == 1 + (mass > 0)
        assert torch.isfinite(problem.h(torch.zeros(2, problem.size), False)).all()
