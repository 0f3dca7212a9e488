"""What two lateral contacts are made of that are none: a force at the tip, and a section that is not what the file says."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import torchrod as tr
from tests.problems import posed
from tests.robots import T, steel_rod
from torchrod.analysis import pipeline
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


@pytest.mark.study
def test_a_push_on_the_tip_in_any_direction_is_told_or_named():
    """Once told as one contact in 39 of 100, 13 of them with a wrong resultant and no word.

    A force nearly square to the rod is a contact at the tip to the data; one that also pulls along the rod is one farther down.
    """
    random, B = torch.Generator().manual_seed(6), 60
    way = torch.randn(B, 3, generator=random, dtype=torch.float64)
    force = (0.3 + 0.7 * torch.rand(B, 1, generator=random)) * steel_rod().rod.force_scale * way / way.norm(dim=-1, keepdim=True)
    wrench = tr.PointWrenches(force[:, None], 0 * force[:, None], T([0.4]))
    problem = posed(S, noisy(tr.solve_shape(steel_rod(), (wrench,), None, S, B, 160).p, 4e-4), 4e-4)
    a = analyze(problem, contact_hypotheses(problem), sampled=True)
    assert a.intervals is not None and a.evidence is not None
    size, interval = force.norm(dim=-1), a.intervals.resultant[:, 3]
    inside = (size >= interval[:, 0]) & (size <= interval[:, 1])
    told = torch.tensor(["tip" in a.evidence.names[h] for h in a.evidence.choice.tolist()])
    named = torch.tensor(["tip force" in a.message(b) for b in range(B)])
    assert float(inside.double().mean()) > 0.85
    assert float(told.double().mean()) > 0.55
    assert float((interval[told, 0] > 0.3 * size[told]).double().mean()) > 0.8  # it counts that force
    assert bool((told | named | inside)[a.estimate.accepted].all())
    assert float((told | named).double().mean()) > 0.85


@pytest.mark.study
def test_loads_that_nobody_told_of_are_named_where_one_contact_explains_the_shape():
    """With --contacts 1: a force at the tip in any direction, and two pushes that one explains. Of one push nothing is said."""
    random, B = torch.Generator().manual_seed(8), 60
    way = torch.randn(B, 3, generator=random, dtype=torch.float64)
    force = 0.5 * steel_rod().rod.force_scale * way / way.norm(dim=-1, keepdim=True)
    tip = tr.PointWrenches(force[:, None], 0 * force[:, None], T([0.4]))
    turn = 6.3 * torch.rand(B, 2, generator=random, dtype=torch.float64)
    size = T([0.8, 0.15]) * steel_rod().rod.force_scale
    both = torch.stack([size * turn.cos(), size * turn.sin(), 0 * turn], -1)
    at = T([0.18, 0.34]) + 0.05 * torch.rand(B, 2, generator=random, dtype=torch.float64)
    loads = {"tip": tip, "two": tr.PointForces(both, at), "one": tr.PointForces(both[:, :1], at[:, :1])}
    said, accepted = {}, {}
    for name, load in loads.items():
        problem = posed(S, noisy(tr.solve_shape(steel_rod(), (load,), None, S, B, 160).p, 1e-3), 1e-3)
        a = analyze(problem, contact_hypotheses(problem, 1), named=True)
        accepted[name] = a.estimate.accepted
        words = {"tip": "N at the tip explains", "two": "weighs both", "one": "weighs both"}[name]
        said[name] = torch.tensor([words in a.message(b) for b in range(B)])
        assert name != "tip" or all("N at the tip explains" in a.message(b) for b in (~accepted[name]).nonzero().flatten().tolist())
    assert int(accepted["tip"].sum()) > 40 and float(said["tip"][accepted["tip"]].double().mean()) > 0.9
    assert int(accepted["two"].sum()) > 5 and float(said["two"][accepted["two"]].double().mean()) > 0.5
    assert accepted["one"].all() and int(said["one"].sum()) <= 2


@pytest.mark.study
def test_beside_a_told_contact_a_force_at_the_tip_is_named_where_chi2_asks_for_it():
    """Of pushes alone in 1 % of the shapes."""
    random, B = torch.Generator().manual_seed(9), 120
    turn = 6.3 * torch.rand(B, 1, generator=random, dtype=torch.float64)
    at = 0.15 + 0.12 * torch.rand(B, 1, generator=random, dtype=torch.float64)
    push = tr.PointForces(0.7 * torch.stack([turn.cos(), turn.sin(), 0 * turn], -1), at)
    way = torch.randn(B, 3, generator=random, dtype=torch.float64)
    force = 0.15 * steel_rod().rod.force_scale * way / way.norm(dim=-1, keepdim=True)
    tip = tr.PointWrenches(force[:, None], 0 * force[:, None], T([0.4]))
    share = {}
    for name, loads in (("alone", (push,)), ("beside", (push, tip))):
        problem = posed(S, noisy(tr.solve_shape(steel_rod(), loads, None, S, B, 160).p, 1e-3), 1e-3)
        a = analyze(problem, contact_hypotheses(problem, 1), named=True)
        said = ["N at the tip beside 1 contact explains the readings better" in a.message(b) for b in range(B)]
        share[name] = float(torch.tensor(said)[a.estimate.accepted].double().mean())
    assert share["alone"] < 0.04 and share["beside"] > 0.3


@pytest.mark.study
@pytest.mark.parametrize("contacts", [2, 3])
def test_of_a_push_that_more_contacts_are_told_of_than_there_are_no_spread_load_is_named(contacts):
    """It has fewer numbers than they have, but so has one contact: 58 of 60 were named."""
    random, B = torch.Generator().manual_seed(11), 30
    turn = 6.3 * torch.rand(B, 1, generator=random, dtype=torch.float64)
    at = 0.15 + 0.2 * torch.rand(B, 1, generator=random)
    push = tr.PointForces(0.6 * torch.stack([turn.cos(), turn.sin(), 0 * turn], -1), at)
    problem = posed(S, noisy(tr.solve_shape(steel_rod(), (push,), None, S, B, 160).p, 4e-4), 4e-4)
    a = analyze(problem, contact_hypotheses(problem, contacts), named=True)
    assert int(a.estimate.accepted.sum()) > 20
    assert sum("spread along" in a.message(b) for b in range(B)) <= 3


@pytest.mark.study
@pytest.mark.parametrize("contacts", [1, "auto"])
def test_a_load_that_is_spread_along_the_rod_is_named_where_one_contact_explains_it(contacts):
    """A contact makes too little of its force, by ten standard deviations, and was accepted in silence. Of pushes 5 % are named."""
    random, B = torch.Generator().manual_seed(10), 40 if contacts == "auto" else 80
    turn, size = 6.3 * torch.rand(B, 1, generator=random, dtype=torch.float64), 0.6
    t = (torch.arange(100, dtype=torch.float64) + 0.5) / 100
    way = torch.stack([turn.cos(), turn.sin(), 0 * turn], -1)
    even = tr.PointForces(size / 100 * way.expand(-1, 100, -1), (0.1 + 0.28 * t).expand(B, -1))
    share = {}
    for name, loads in (("even", even), ("push", tr.PointForces(size * way, torch.full((B, 1), 0.24)))):
        problem = posed(S, noisy(tr.solve_shape(steel_rod(), (loads,), None, S, B, 160).p, 4e-4), 4e-4)
        a = analyze(problem, contact_hypotheses(problem, contacts), named=True)
        said = torch.tensor(["One load spread along the rod" in a.message(b) for b in range(B)])
        share[name] = float(said[a.estimate.accepted].double().mean())
        if contacts == 1 and name == "even":
            wrong = (a.estimate.magnitude_interval[:, 0, 1] < size) & a.estimate.accepted
            assert float(wrong.double().mean()) > 0.6
    assert share["even"] > 0.7 and share["push"] < 0.13


def test_where_a_spread_load_competes_it_is_not_named_again(monkeypatch):
    way = torch.tensor([[[1.0, 0.0, 0.0]]], dtype=torch.float64)
    even = tr.PointForces(0.006 * way.expand(3, 100, 3), (0.1 + 0.0028 * torch.arange(100, dtype=torch.float64)).expand(3, -1))
    problem = posed(S, noisy(tr.solve_shape(steel_rod(), (even,), None, S, 3, 160).p, 4e-4), 4e-4)
    a = analyze(problem, contact_hypotheses(problem, 1), named=True)
    odds = [
        float(a.message(b).partition(" N about s")[2].partition(" is ")[2].split()[0]) for b in range(3) if "spread" in a.message(b)
    ]
    assert odds and min(odds) >= 2
    monkeypatch.setattr(pipeline, "spread", lambda *_, **__: pytest.fail("it competes"))
    for prior in ("distributed", "auto"):
        analyze(problem, contact_hypotheses(problem, 1, prior), named=True)


def test_where_nothing_or_one_contact_is_surely_right_no_force_at_the_tip_is_named():
    """On an unloaded rod a contact near the tip, and a pull there, explain noise alike."""
    p = tr.solve_shape(steel_rod(), (), None, S, 40, 80).p
    a = analyze(problem := posed(S, noisy(p, 4e-4), 4e-4), contact_hypotheses(problem, 1), named=True)
    near = (a.estimate.location > 0.3).any(-1) & a.estimate.accepted
    assert int(near.sum()) >= 5 and not any("at the tip" in a.message(b) for b in range(40))


def test_of_two_explanations_the_likelier_is_named():
    """Of a force at the tip, where one contact more explains the shape better than one contact as well."""
    random, B = torch.Generator().manual_seed(8), 60
    way = torch.randn(B, 3, generator=random, dtype=torch.float64)
    force = 0.5 * steel_rod().rod.force_scale * way / way.norm(dim=-1, keepdim=True)
    wrench = tr.PointWrenches(force[:, None], 0 * force[:, None], T([0.4]))
    problem = posed(S, noisy(tr.solve_shape(steel_rod(), (wrench,), None, S, B, 160).p, 2e-4), 2e-4)
    a = analyze(problem, contact_hypotheses(problem, 1), named=True)
    said = [a.message(b) for b in a.estimate.accepted.nonzero().flatten().tolist()]
    assert len(said) > 20 and sum("N at the tip explains" in words for words in said) > 0.9 * len(said)


@pytest.mark.study
def test_a_push_near_the_tip_stays_a_contact():
    """Though a force at the tip that pulls along the rod explains it nearly as well."""
    random, B = torch.Generator().manual_seed(7), 40
    turn = 6.3 * torch.rand(B, generator=random, dtype=torch.float64)
    at = 0.4 * (0.75 + 0.25 * torch.rand(B, 1, generator=random, dtype=torch.float64))
    F = 0.6 * torch.stack([turn.cos(), turn.sin(), 0 * turn], -1).unsqueeze(1)
    problem = posed(S, noisy(tr.solve_shape(steel_rod(), (tr.PointForces(F, at),), None, S, B, 160).p, 4e-4), 4e-4)
    for sampled in (False, True):
        a = analyze(problem, contact_hypotheses(problem), sampled=sampled)
        assert a.evidence is not None
        assert sum(a.evidence.names[h] == "1" for h in a.evidence.choice.tolist()) >= 36


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


def robots() -> dict[str, tr.Robot]:
    """Rods of other lengths, sections and weights, and robots with tendons."""
    around = [(0.006, 0.0), (-0.003, 0.0052), (-0.003, -0.0052)]
    held = tr.Rod.circular(0.3, 0.0012, 207e9, 79e9, 0.02)
    flat = tr.Rod.from_stiffness(0.25, torch.diag(T([2e5, 2e5, 6e5])), torch.diag(T([0.03, 0.003, 0.005])))
    down, aside = T([0.0, 0.0, -9.81]), T([0.0, -9.81, 0.0])
    return {
        "steel": steel_rod(),
        "nitinol": tr.Robot(tr.Rod.circular(0.15, 0.0009, 60e9, 23e9, 0.004), gravity=aside),
        "long": tr.Robot(tr.Rod.circular(1.0, 0.004, 70e9, 26e9, 0.034), gravity=aside),
        "flat": tr.Robot(flat),
        "one tendon": tr.Robot(held, tr.Tendons((tr.Tendon.straight(0.006, 0.0, 0.3),)), down),
        "three tendons": tr.Robot(held, tr.Tendons(tuple(tr.Tendon.straight(x, y, 0.3) for x, y in around)), down),
    }


def drawn(low: float, high: float, count: int, random: torch.Generator) -> torch.Tensor:
    return low + (high - low) * torch.rand(count, generator=random)


def pushed(
    robot: tr.Robot, loads: tuple, tension: torch.Tensor | None, random: torch.Generator, B: int
) -> tuple[tr.Problem, torch.Tensor]:
    """Markers with a noise of a thousandth of the length, of the robot without what is not in its file, and which were solved."""
    L = robot.rod.length
    s = torch.linspace(L / 20, L, 20)
    shape = tr.solve_shape(robot, loads, tension, s, B)
    solved = shape.status == 0
    p = shape.p[solved] + 1e-3 * L * torch.randn(shape.p[solved].shape, generator=random)
    unknowns = tr.Unknowns(tr.GaussianCoordinates(1, L, robot.rod.force_scale))
    return tr.Problem(robot, unknowns, [tr.Markers(s, p, 1e-3 * L)], None if tension is None else tension[solved]), solved


def lateral(robot: tr.Robot, B: int, random: torch.Generator) -> torch.Tensor:
    """Forces (B, 1, 3) of 0.5 to 1.5 force scales."""
    size, turn = robot.rod.force_scale * drawn(0.5, 1.5, B, random), drawn(0, 6.283, B, random)
    return torch.stack([size * turn.cos(), size * turn.sin(), 0 * size], -1).unsqueeze(1)


def tension_of(robot: tr.Robot, B: int, random: torch.Generator) -> torch.Tensor | None:
    count = len(robot.tendons)
    return 160 * robot.rod.moment_scale / max(count, 1) * torch.rand(B, count, generator=random) if count else None


def worded(problem: tr.Problem, contacts: int) -> tuple[list[str], torch.Tensor]:
    """The messages of so many contacts, and which of them are of fits that are not accepted."""
    a = analyze(problem, contact_hypotheses(problem, contacts))
    return [a.message(b) for b in range(problem.batch)], ~a.estimate.accepted


def bent(robot: tr.Robot, push: int, random: torch.Generator, B: int) -> tr.Problem:
    """A stretch of 4 to 12 % of the length was bent before, by 0.05 to 0.3 rad, which no file knows."""
    L, problems = robot.rod.length, []
    for b in range(B):
        at, wide = L * drawn(0.35, 0.6, 1, random), L * drawn(0.04, 0.12, 1, random)
        bend, zero = drawn(0.05, 0.3, 1, random) * (-1) ** b / wide, torch.zeros(1)
        rows = [(zero, zero), (at, zero), (at, bend), (at + wide, bend), (at + wide, zero), (zero + L, zero)]
        table = torch.stack([torch.cat([s, u, zero, zero]) for s, u in rows])
        own = tr.Robot(replace(robot.rod, reference_curvature=table), robot.tendons, robot.gravity)
        load = tr.PointForces(push * lateral(robot, 1, random), L * drawn(0.8, 0.95, 1, random).unsqueeze(0))
        problems.append(pushed(own, (load,), tension_of(robot, 1, random), random, 1)[0])
    tension = None if problems[0].tension is None else torch.cat([q.tension for q in problems if q.tension is not None])
    markers = tr.Markers(problems[0].s, torch.cat([q.reading[:, :60] for q in problems]).unflatten(1, (20, 3)), 1e-3 * L)
    return tr.Problem(robot, problems[0].unknowns, [markers], tension)


@pytest.mark.many_fits
@pytest.mark.study
def test_a_bend_that_no_file_knows_is_not_more_contacts():
    """Alone, or beside a push: where one contact more explains it by opposite ones side by side, on every robot."""
    random, couples = torch.Generator().manual_seed(3), []
    for robot in robots().values():
        L = robot.rod.length
        for contacts in (1, 2):
            problem = bent(robot, contacts - 1, random, 6)
            said, refused = worded(problem, contacts)
            assert not [w for w in said if "not a contact near" in w and "try more --contacts" in w]
            more = tr.estimate(problem.of(tr.Unknowns(tr.GaussianCoordinates(contacts + 1, L, robot.rod.force_scale))))
            pair = torch.zeros(6, dtype=torch.bool)
            for i, j in [(0, 1), (0, 2), (1, 2)][: 2 * contacts - 1]:
                against = (more.force[:, i] * more.force[:, j]).sum(-1) < -0.9 * more.magnitude[:, i] * more.magnitude[:, j]
                pair |= against & ((more.location[:, i] - more.location[:, j]).abs() < 0.12 * L)
            couples += [said[b] for b in (pair & more.accepted & refused).nonzero().flatten().tolist()]
    assert len(couples) >= 20
    assert sum("not a contact near" in w for w in couples) >= 0.9 * len(couples)
    assert sum("try more --contacts" in w for w in couples) <= 0.05 * len(couples)


@pytest.mark.many_fits
def test_two_opposite_pushes_that_the_markers_tell_apart_are_contacts():
    """A quarter to half of the length apart, on every robot."""
    random, told, B = torch.Generator().manual_seed(4), [], 12
    for robot in robots().values():
        L, force = robot.rod.length, lateral(robot, B, random)
        first, gap = drawn(0.3, 0.45, B, random), drawn(0.25, 0.5, B, random)
        both = torch.cat([force, -force * drawn(0.6, 1.4, B, random)[:, None, None]], 1)
        loads = tr.PointForces(both, L * torch.stack([first, first + gap], -1))
        said, refused = worded(pushed(robot, (loads,), tension_of(robot, B, random), random, B)[0], 1)
        told += [said[b] for b in refused.nonzero().flatten().tolist()]
    assert len(told) >= 40
    assert sum("try more --contacts" in w for w in told) >= 0.85 * len(told)
    assert sum("not a contact near" in w for w in told) <= 0.05 * len(told)
