"""How many loads: the score test, the stages, the evidence that is reported."""

import json
import math
from dataclasses import replace

import pytest
import torch
from studies import contacts

from tests.problems import unknowns_of
from tests.robots import T, steel_rod
from torchrod import (
    GaussianLoads,
    Markers,
    PointForces,
    PointWrenches,
    Problem,
    Settings,
    analyze,
    contact_hypotheses,
    estimate,
    score_test,
    solve_shape,
)
from torchrod.analysis.count import Hypothesis, bic, select
from torchrod.analysis.score_test import drop_by_tip_force, start_with_one_more
from torchrod.cli import main
from torchrod.estimation.evaluator import evaluator

S = torch.linspace(0.02, 0.4, 20, dtype=torch.float64)
ROD = "[rod]\nlength = 0.4\ndiameter = 0.0014\nyoungs_modulus = 207e9\nshear_modulus = 79e9\n"
FORCES = {0: [], 1: [(0.3, -0.6, 0.22)], 2: [(0.8, 0.2, 0.15), (-0.5, 0.7, 0.33)]}


def markers_of(loads, count: int, seed: int, noise: float = 1e-3) -> Markers:
    shape = solve_shape(steel_rod(), loads, None, S, count)
    draw = torch.randn(shape.p.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return Markers(S, shape.p + noise * draw, noise)


def pushes(contacts: int) -> tuple:
    rows = FORCES[contacts]
    return (PointForces(T([[[x, y, 0.0] for x, y, _ in rows]]), T([[s for *_, s in rows]])),) if rows else ()


def without_load(markers: Markers) -> Problem:
    """Markers of the steel rod, as the hypothesis has them that there is no load."""
    robot = steel_rod()
    return Problem(robot, unknowns_of(robot, 0), [markers])


@pytest.mark.study
def test_without_a_load_the_score_is_chi_square():
    """At one place the drop has 2 degrees of freedom (mean 2); the best of 16 correlated places stays below what BIC asks for."""
    problem = without_load(markers_of((), 200, 0))
    drop = score_test(problem, estimate(problem).x).drop
    assert 2.0 < float(drop.mean()) < 6.0
    assert (drop > 3 * math.log(60)).double().mean() < 0.03


def test_the_score_points_at_the_missing_load():
    """A push of 0.3 N bends the rod by 50 mm: place to the spacing of the places, force to a third, from the fit without load."""
    push = (PointForces(T([[[0.0, 0.3, 0.0]]]), T([[0.3]])),)
    problem = without_load(markers_of(push, 20, 1))
    found = score_test(problem, estimate(problem).x)
    assert (found.drop > 3 * math.log(60)).all()
    assert ((0.4 * torch.sigmoid(found.eta) - 0.3).abs() < 0.04).all()
    assert (found.force * steel_rod().rod.force_scale - T([0.0, 0.3])).abs().max() < 0.1


def push_and_tip_force(B: int, size: float, seed: int, noise: float) -> Problem:
    """One contact told, beside a force of so many scales at the tip in any direction."""
    random, robot = torch.Generator().manual_seed(seed), steel_rod()
    turn = 6.3 * torch.rand(B, 1, generator=random, dtype=torch.float64)
    push = PointForces(0.6 * torch.stack([turn.cos(), turn.sin(), 0 * turn], -1), 0.15 + 0.15 * torch.rand(B, 1, generator=random))
    way = torch.randn(B, 3, generator=random, dtype=torch.float64)
    force = size * robot.rod.force_scale * way / way.norm(dim=-1, keepdim=True)
    loads = (push, PointWrenches(force[:, None], 0 * force[:, None], T([0.4])))
    return Problem(robot, unknowns_of(robot, 1), [markers_of(loads, B, seed + 1, noise)])


@pytest.mark.parametrize("nu", [math.inf, 8.0])
def test_the_score_of_a_tip_force_is_what_it_takes_off_the_cost(nu):
    """Of least squares by rows, with the tip out of balance at a price; robust: from the weights of the fit."""
    problem = push_and_tip_force(4, 0.05, 3, 1e-3)
    x = estimate(problem, settings=Settings(robust=nu)).x
    first, costs = problem.state.tip.at.start, []
    for tip in ("none", "force"):
        part = problem.of(replace(problem.unknowns, tip=tip))
        at = torch.cat([x[:, :first], x.new_zeros(len(x), part.state.tip.size), x[:, first:]], -1)
        h, H = part.linearized(at)
        r, w = part.reading - h, part.weights.clone()
        square = (w * r**2)[:, : len(part.groups)].unflatten(1, (-1, 3)).sum(-1)
        if math.isfinite(nu):
            w[:, : len(part.groups)] *= ((nu + 3) / (nu + square)).repeat_interleave(3, 1)
        w[:, len(part.groups) :] *= 1e6
        rows = torch.cat([w.sqrt().unsqueeze(-1) * H, torch.diag_embed(part.precision.sqrt().expand_as(at))], 1)
        of = torch.cat([w.sqrt() * r, part.precision.sqrt() * (part.mean - at)], 1)
        left = of - (rows @ torch.linalg.lstsq(rows, of.unsqueeze(-1)).solution).squeeze(-1)
        costs.append(left.square().sum(-1))
    assert torch.allclose(drop_by_tip_force(problem, x, nu), costs[0] - costs[1], rtol=1e-3)
    assert bool((costs[0] - costs[1] > 0.1).any())


@pytest.mark.study
def test_without_a_force_at_the_tip_its_score_is_chi_square():
    """With 3 degrees of freedom: mean 3, above 7.8 in 5 %."""
    problem = push_and_tip_force(400, 0.0, 4, 1e-3)
    drop = drop_by_tip_force(problem, estimate(problem).x)
    assert abs(float(drop.mean()) - 3.0) < 0.4
    assert 0.02 < float((drop > 7.815).double().mean()) < 0.09


def run(folder, markers: Markers, *options: str) -> list[dict]:
    (folder / "r.toml").write_text(ROD)
    rows = ["sample,s,x,y,z"]
    for b, p in enumerate(markers.positions):
        rows += [f"{b},{float(s)!r},{','.join(repr(float(v)) for v in q)}" for s, q in zip(markers.s, p, strict=True)]
    (folder / "s.csv").write_text("\n".join(rows) + "\n")
    out = folder / "o.json"
    assert main(["estimate", str(folder / "r.toml"), str(folder / "s.csv"), "--out", str(out), *options]) == 0
    return json.loads(out.read_text())["results"]


@pytest.mark.parametrize("contacts", [0, 1, 2])
@pytest.mark.many_fits
def test_the_count_is_found_and_its_evidence_told(contacts, tmp_path):
    results = run(tmp_path, markers_of(pushes(contacts), 3, 3), "--contacts", "auto")
    for sample in results:
        assert sample["evidence"]["chosen"] == str(contacts)
        assert len(sample["loads"]) == contacts
        known = {name: bic for name, bic in sample["evidence"]["bic"].items() if bic is not None}
        told_of = {name for name in known if "tip" not in name}  # the BIC knows nothing of how likely a force at the tip is
        assert min(told_of, key=lambda name: known[name]) == str(contacts)
        foreseen = sample["evidence"]["bic_foreseen"]
        told = {*known, *foreseen, *sample["evidence"]["not_converged"]}
        assert sorted(told - {"0 + tip force", "1 + tip force"}) == ["0", "1", "2", "3", "4"]
        assert foreseen.get(str(contacts + 1), math.inf) > known[str(contacts)], "why one more was not needed"
        for load, (x, y, s) in zip(sorted(sample["loads"], key=lambda v: v["location_m"]), FORCES[contacts], strict=True):
            assert abs(load["location_m"] - s) < 0.03
            assert abs(load["magnitude_N"] - math.hypot(x, y)) < 0.4


@pytest.mark.many_fits
def test_a_push_at_the_tip_competes(tmp_path):
    tip = (PointWrenches(T([[[0.2, 0.1, -0.3]]]), T([[[0.0, 0.0, 0.0]]]), T([0.4])),)
    for sample in run(tmp_path, markers_of(tip, 2, 4), "--contacts", "auto", "--unknown-tip", "force"):
        assert sample["evidence"]["chosen"] == "0 + tip force"
        assert abs(sample["tip"]["force_N"][0] - 0.2) < 5 * sample["tip"]["std"]["force_N"][0]


@pytest.mark.many_fits
def test_what_one_sample_chooses_does_not_depend_on_its_neighbours(tmp_path):
    both = torch.cat([markers_of(pushes(k), 1, 5).positions for k in (0, 2, 1)])
    together = run(tmp_path, Markers(S, both, 1e-3), "--contacts", "auto")
    for b, sample in enumerate(together):
        (alone,) = run(tmp_path, Markers(S, both[b : b + 1], 1e-3), "--contacts", "auto")
        assert alone["evidence"]["chosen"] == sample["evidence"]["chosen"]
        for one, other in zip(alone["loads"], sample["loads"], strict=True):
            assert abs(one["magnitude_N"] - other["magnitude_N"]) < 1e-9


@pytest.mark.many_fits
def test_a_wide_load_is_told_from_a_contact(tmp_path):
    """Markers must be good for that: the width hardly shows."""
    wide = (GaussianLoads(T([[[4.0, 0.0]]]), T([[0.25]]), T([[0.5 / 0.1**2]])),)
    for loads, prior in ((wide, "distributed"), (pushes(1), "contact")):
        for sample in run(tmp_path, markers_of(loads, 3, 6, 5e-5), "--load-prior", "auto", "--noise", "5e-5"):
            assert sample["evidence"]["chosen"] == f"1 {prior}"


@pytest.mark.many_fits
@pytest.mark.study
def test_a_contact_and_a_push_at_the_tip_are_told_from_two_contacts_and_a_push(tmp_path):
    """Pushes along the rod beyond its buckling load: the stages alone end at "2 + tip force" in these (docs/contacts.md)."""
    truth = contacts.Truth(1, tip=True)
    markers, _ = contacts.cases(truth, 20, 24, 5003, 2e-4)
    results = run(tmp_path, markers, "--contacts", "auto", "--unknown-tip", "force", "--noise", "2e-4")
    right = [sample["evidence"]["chosen"] == "1 + tip force" for sample in results]
    assert sum(right) >= 20


@pytest.mark.many_fits
def test_what_is_not_tried_would_not_have_been_chosen():
    """The count by stages is that of the least BIC among fits of every count; yet a third load is seldom tried."""
    random, B = torch.Generator().manual_seed(3), 60
    size = torch.cat([torch.full((B, 1), 0.8), 0.02 * 50 ** torch.rand(B, 1, generator=random)], -1)
    turn = 2 * math.pi * torch.rand(B, 2, generator=random)
    place = T([0.14, 0.3]) + T([0.06, 0.09]) * torch.rand(B, 2, generator=random)
    force = torch.stack([size * turn.cos(), size * turn.sin(), 0 * size], -1)
    problem = without_load(markers_of((PointForces(force, place),), B, 4))
    candidates = [Hypothesis(str(k), k, unknowns_of(steel_rod(), k)) for k in range(4)]
    _, evidence = select(problem, candidates)
    every = [problem.of(candidate.unknowns) for candidate in candidates]
    best = torch.stack([bic(own, estimate(own)) for own in every], -1).argmin(-1)
    assert torch.equal(evidence.choice, best)
    assert best.bincount(minlength=3)[1:3].min() > B / 4
    assert evidence.bic[:, 3].isnan().sum() > B / 2


def test_the_start_of_one_more_load_costs_less_than_the_fit_that_was_tested():
    """(4) of the score test: the fitted load and the base wrench move with the new force, to first order to where it fits."""
    rod, s = steel_rod(), torch.linspace(0.02, 0.4, 20)
    push = PointForces(T([[[0.015, 0.0, 0.0], [0.0, 0.0125, 0.0]]]), T([[0.2, 0.35]]))
    p = solve_shape(rod, (push,), None, s, 1).p
    one, two = (Problem(rod, unknowns_of(rod, k, "contact"), [Markers(s, p, 5e-5)]) for k in (1, 2))
    fit = estimate(one)
    start = start_with_one_more(two.unknowns, score_test(one, fit.x))
    assert float(evaluator(two).cost(start.x)) < 0.8 * float(fit.cost)


@pytest.mark.many_fits
def test_without_draws_too_what_one_sample_chooses_does_not_depend_on_its_neighbours():
    """Where a force at the tip helps one sample, it was once chosen for others that it does not explain: no longer for any."""
    random, B = torch.Generator().manual_seed(2), 8
    way = torch.randn(B, 3, generator=random, dtype=torch.float64)
    force = 0.5 * steel_rod().rod.force_scale * way / way.norm(dim=-1, keepdim=True)
    p = markers_of((PointWrenches(force[:, None], 0 * force[:, None], T([0.4])),), B, 3, 4e-4).positions
    noise = torch.tensor([[4e-4], [2e-4]], dtype=torch.float64).repeat(B // 2, len(S))  # of every other one as it is
    problem = Problem(steel_rod(), unknowns_of(steel_rod()), [Markers(S, p, noise)])
    candidates = contact_hypotheses(problem)
    together = analyze(problem, candidates)
    assert together.evidence is not None
    for b in range(B):
        alone = analyze(problem.take(torch.tensor([b])), candidates).evidence
        assert alone is not None and int(alone.choice[0]) == int(together.evidence.choice[b])
    untold = torch.tensor(["tip" in together.evidence.names[h] for h in together.evidence.choice.tolist()])
    assert 0 < int(untold.sum()) < B and bool(together.estimate.accepted[untold].all())
