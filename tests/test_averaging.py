"""Probabilities of hypotheses, and what is averaged by them."""

import json
import math
from dataclasses import replace

import pytest
import torch

from tests.robots import T, steel_rod
from torchrod import (
    GaussianCoordinates,
    Markers,
    PointForces,
    Problem,
    Unknowns,
    analyze,
    contact_hypotheses,
    estimate,
    solve_shape,
)
from torchrod.analysis.averaging import ONE_MORE, _Drawn, _probabilities, average
from torchrod.analysis.count import UNTOLD, Evidence, selection
from torchrod.cli import main
from torchrod.estimation.draws import posterior_draws
from torchrod.estimation.intervals import quantiles, resultant
from torchrod.util.precision import DTYPE

L, NOISE = 0.4, 1e-3
S = torch.linspace(L / 20, L, 20, dtype=DTYPE)


def posed(B: int, seed: int, size: tuple[float, float], gap: float = 0.0) -> tuple[Problem, torch.Tensor]:
    """One push, or two `gap` apart (m); the resultant (N, base frame)."""
    random, robot = torch.Generator().manual_seed(seed), steel_rod()
    K = 1 + (gap > 0)
    first = 0.15 + (0.2 - gap) * torch.rand(B, 1, generator=random, dtype=DTYPE)
    place = first + gap * torch.arange(K, dtype=DTYPE)
    force = size[0] + (size[1] - size[0]) * torch.rand(B, K, generator=random, dtype=DTYPE)
    turn = 2 * math.pi * torch.rand(B, K, generator=random, dtype=DTYPE)
    F = torch.stack([force * turn.cos(), force * turn.sin(), 0 * force], -1)
    rod = solve_shape(robot, (PointForces(F, place),), None, S, B, 80)
    p = rod.p + NOISE * torch.randn(rod.p.shape, generator=random, dtype=DTYPE)
    unknowns = Unknowns(GaussianCoordinates(1, L, robot.rod.force_scale))
    return Problem(robot, unknowns, [Markers(S, p, NOISE)]), rod.base_wrench[:, :3]


def test_probabilities_are_those_of_the_evidence():
    """By hand from the draws of every hypothesis: a weak push that may be none."""
    problem, _ = posed(8, 1, (0.002, 0.02))
    candidates = contact_hypotheses(problem)[:2]
    found = average(problem, candidates, selection(problem, candidates))
    evidence = []
    for candidate in candidates:
        own = problem.of(candidate.unknowns)
        fit = selection(problem, [candidate]).fit
        evidence.append(posterior_draws(own, fit, prior="normalized").log_evidence + candidate.contacts * math.log(ONE_MORE))
    by_hand = torch.softmax(torch.stack(evidence, -1), -1)
    p = found.evidence.probability
    assert p is not None and torch.allclose(p, by_hand, atol=0.02)
    assert torch.equal(found.evidence.choice, by_hand.argmax(-1))
    assert found.evidence.something is not None and torch.allclose(found.evidence.something, p[:, 1])
    assert int(((p[:, 1] > 0.1) & (p[:, 1] < 0.9)).sum()) >= 2  # of some it is open


def test_a_resultant_is_averaged_by_the_evidence_alone():
    """By hand: a load that is not worth reporting may be there, and counts as much as the readings speak for it."""
    problem, _ = posed(8, 1, (0.002, 0.02))
    candidates = contact_hypotheses(problem)[:2]
    found = average(problem, candidates, selection(problem, candidates))
    R, weight, evidence = [], [], []
    for candidate in candidates:
        own = problem.of(candidate.unknowns)
        draws = posterior_draws(own, selection(problem, [candidate]).fit, prior="normalized")
        R.append(resultant(own, draws.x))
        weight.append(draws.weight)
        evidence.append(draws.log_evidence)

    def mixed(rarer: float) -> torch.Tensor:
        share = torch.softmax(torch.stack(evidence, -1) + T([0.0, math.log(rarer)]), -1)
        return quantiles(torch.cat(R, 1), torch.cat([w * share[:, h : h + 1] for h, w in enumerate(weight)], 1))

    p = found.evidence.probability
    assert p is not None
    interval, open_to = found.intervals.resultant[:, :3], (p.amax(-1) < 0.9)
    assert int(open_to.sum()) >= 2
    off, rarer = ((interval - mixed(share))[open_to].abs().amax() for share in (1.0, ONE_MORE))
    assert off < 0.02 < 0.1 < rarer, "N, of intervals of 1 N"


def test_one_more_load_than_is_asked_for_is_tried_where_that_is_averaged():
    """Of one push two, and of none nothing; only where it is to be thorough."""
    problem, _ = posed(6, 3, (0.5, 1.0))
    markers = problem.markers
    assert markers is not None
    still = Markers(S, markers.positions[:1] * 0 + torch.stack([0 * S, 0 * S, S], -1), NOISE)
    candidates = contact_hypotheses(problem)[:4]
    quick, thorough = (selection(problem, candidates, thorough=it) for it in (False, True))
    assert set(thorough.fits[2][1].tolist()) == set(range(6)) > set(quick.fits.get(2, (None, T([])))[1].tolist())
    assert len(thorough.fits.get(3, (None, T([])))[1]) < 3  # a third load only of those that ask for it
    assert 2 not in selection(replace(problem, sensors=[still]), candidates, thorough=True).fits
    told = analyze(problem, candidates, sampled=True).evidence
    assert told is not None and bool(torch.isfinite(told.bic[:, 2]).all())


@pytest.mark.study
def test_a_resultant_holds_what_was_merged():
    """Two pushes 6 % of the length apart, which now and then are told as one: once 0 to 23 % of their resultants, then 79."""
    problem, truth = posed(24, 2, (0.5, 2.0), gap=0.06 * L)
    found = analyze(problem, contact_hypotheses(problem), sampled=True)
    assert found.intervals is not None and found.evidence is not None and found.evidence.probability is not None
    interval = found.intervals.resultant[:, 3]
    size = truth.norm(dim=-1)
    inside = (size >= interval[:, 0]) & (size <= interval[:, 1])
    merged = found.evidence.choice < 2
    assert int(merged.sum()) >= 5
    assert float(inside.double().mean()) > 0.85 and float(inside[merged].double().mean()) > 0.85


def test_close_explanations_are_told(tmp_path, capsys):
    """In the message, and with probabilities in RESULT.json; bands and resultants are there."""
    problem, _ = posed(4, 3, (0.3, 0.6), gap=0.03)
    rows = ["sample,s,x,y,z"]
    markers = problem.markers
    assert markers is not None
    for b, points in enumerate(markers.positions.tolist()):
        rows += [f"{b},{s},{x},{y},{z}" for s, (x, y, z) in zip(S.tolist(), points, strict=True)]
    (tmp_path / "shapes.csv").write_text("\n".join(rows))
    (tmp_path / "rod.toml").write_text(
        f"[rod]\nlength = 0.4\nK_se = [2.5e5, 2.5e5, 6.5e5]\nK_bt = {problem.robot.rod.K_bt.diagonal().tolist()}\n"
    )
    given = [str(tmp_path / "rod.toml"), str(tmp_path / "shapes.csv")]
    out = tmp_path / "result.json"
    assert not main(["estimate", *given, "--noise", str(NOISE), "--contacts", "auto", "--load-prior", "auto", "--out", str(out)])
    records = json.loads(out.read_text())["results"]
    told = [r for r in records if "remain possible" in r["message"] and "tip force" not in r["message"]]
    assert told and all(0.1 <= sorted(r["evidence"]["probability"].values())[-2] <= 0.5 for r in told)
    for record in records:
        shares = record["evidence"]["probability"]
        assert math.isclose(sum(shares.values()), 1.0, abs_tol=1e-9)
        told = {name: share for name, share in shares.items() if "smooth" not in name}
        assert max(told, key=lambda name: told[name]) == record["evidence"]["chosen"]
        assert record["evidence"]["probability_of_any_load"] > 0.99
        at_tip = any("tip" in name for name in shares)  # its force along the rod may be anything
        assert record["resultant"]["interval_95"]["magnitude_N"][0] > 0 or at_tip
    assert "remain possible" in capsys.readouterr().out


@pytest.mark.study
def test_a_band_of_any_form_holds_a_uniform_load():
    """Over 30 or 60 % of the rod, of 100 point forces; a Gaussian's band holds a quarter of it.

    Where it competes with Gaussians that explain the readings alike, too: 64 % once.
    """
    random, robot, B, M = torch.Generator().manual_seed(4), steel_rod(), 8, 100
    s = (torch.arange(M, dtype=DTYPE) + 0.5) / M
    first, length = 0.1 + 0.3 * torch.rand(B, 1, generator=random, dtype=DTYPE), T([0.3, 0.6]).repeat(B // 2).unsqueeze(-1)
    f = ((s > first) & (s < first + length)).to(DTYPE) / length  # of 1 N, per length
    forces = torch.stack([f / M, 0 * f, 0 * f], -1)
    p = solve_shape(robot, (PointForces(forces, (L * s).expand(B, -1)),), None, S, B, 40).p
    p = p + 2e-4 * torch.randn(p.shape, generator=random, dtype=DTYPE)
    problem = Problem(robot, Unknowns(GaussianCoordinates(1, L, robot.rod.force_scale)), [Markers(S, p, 2e-4)])
    held = {}
    for prior in ("smooth", "distributed", "auto"):
        found = analyze(problem, contact_hypotheses(problem, 1, prior), sampled=True)
        profile = found.profile
        assert profile is not None and found.estimate.accepted.all()
        at = profile.s / L
        truth = ((at > first) & (at < first + length)).to(DTYPE) / length / L
        inside = (truth >= profile.band[..., 2, 0]) & (truth <= profile.band[..., 2, 1])
        held[prior] = float(inside[truth > 0].double().mean())
    assert held["distributed"] < 0.6 < 0.9 < min(held["smooth"], held["auto"])


@pytest.mark.study
@pytest.mark.parametrize("prior", ["auto", "smooth"])
def test_force_and_place_of_a_load_of_any_form_are_held(prior: str):
    """Spread evenly over 30 or 60 % of the rod, of 100 point forces: once 42 to 78 % of the places, those of one Gaussian."""
    random, robot, B, M = torch.Generator().manual_seed(11), steel_rod(), 24, 100
    s = (torch.arange(M, dtype=DTYPE) + 0.5) / M
    first, length = 0.1 + 0.3 * torch.rand(B, 1, generator=random, dtype=DTYPE), T([0.3, 0.6]).repeat(B // 2).unsqueeze(-1)
    turn = 2 * math.pi * torch.rand(B, 1, generator=random, dtype=DTYPE)
    f = ((s > first) & (s < first + length)).to(DTYPE)
    forces = (f / f.sum(-1, keepdim=True)).unsqueeze(-1) * torch.stack([turn.cos(), turn.sin(), 0 * turn], -1)
    p = solve_shape(robot, (PointForces(forces, (L * s).expand(B, -1)),), None, S, B, 40).p
    p = p + 4e-4 * torch.randn(p.shape, generator=random, dtype=DTYPE)
    problem = Problem(robot, Unknowns(GaussianCoordinates(1, L, robot.rod.force_scale)), [Markers(S, p, 4e-4)])
    found = analyze(problem, contact_hypotheses(problem, 1, prior), sampled=True)
    assert found.intervals is not None and found.estimate.accepted.all()
    place, size = found.intervals.location[:, 0], found.intervals.magnitude[:, 0]
    middle = L * (f * s).sum(-1) / f.sum(-1)
    assert float(((place[:, 0] < middle) & (middle < place[:, 1])).double().mean()) >= 0.79
    assert float(((size[:, 0] < 1.0) & (size[:, 1] > 1.0)).double().mean()) >= 0.79
    assert float((place[:, 1] - place[:, 0]).median()) < 0.6 * L


def test_what_is_nearly_as_probable_is_told_whichever_was_chosen():
    """A force at the tip that nobody told of counts fifty times its share where it was not chosen, and its share where it was."""
    names, tip = ("0", "1", "2", "0 + tip force"), frozenset({"0 + tip force"})
    shares = T([[0.0, 0.99, 0.0, 0.01], [0.0, 0.23, 0.25, 0.52], [0.0, 0.85, 0.15, 0.0], [0.0, 0.999, 0.0, 0.001]])
    evidence = Evidence(names, torch.tensor([1, 3, 1, 1]), shares, shares, tip, shares)
    said = [evidence.rival(b) for b in range(4)]
    assert "1 (99 %) and 0 + tip force (1 %) remain possible" in said[0]
    assert "0 + tip force (52 %) and 2 (25 %) remain possible" in said[1]
    assert "1 (85 %) and 2 (15 %) remain possible" in said[2]
    assert not said[3]


def test_a_load_of_any_form_is_told_of_in_words():
    """Its share is on a scale of its own: beside contacts it is not given in percent, and where it is told, it says what it is."""
    names = ("0", "1 contact", "2 contact", "1 smooth(0.1 L, 2)", "1 smooth(0.4 L, 2)")
    shares = T([[0.0, 0.0, 0.01, 0.5, 0.49], [0.0, 0.97, 0.01, 0.01, 0.01], [0.0, 0.0, 0.0, 0.3, 0.7]])
    evidence = Evidence(names, torch.tensor([2, 1, 4]), shares, shares, frozenset(), shares)
    assert evidence.rival(0) == "One load of any form along the rod explains the readings too: what is there may be spread."
    assert not evidence.rival(1)
    assert "told is one load of any form" in evidence.rival(2) and "try --contacts auto" in evidence.rival(2)
    alone = Evidence(names[3:], torch.tensor([1]), shares[2:, 3:], shares[2:, 3:], frozenset(), shares[2:, 3:])
    assert not alone.rival(0)  # of --load-prior smooth, which asked for just that


def test_one_load_of_any_form_competes_with_nothing_at_the_tip():
    problem, _ = posed(1, 1, (0.3, 0.6))
    assert not [c for c in contact_hypotheses(problem, "auto", "smooth") if c.unknowns.tip != "none"]
    assert [c for c in contact_hypotheses(problem, "auto", "auto") if c.unknowns.tip != "none"]


def test_where_draws_are_not_trusted_the_bic_counts_what_nobody_told_of():
    """Two hypotheses of one BIC, of which one has a force at the tip that nobody told of."""
    problem, _ = posed(2, 1, (0.3, 0.6))
    fit = estimate(problem)
    draws = replace(posterior_draws(problem, fit, 64), k_hat=T([2.0, 2.0]))
    drawn = [_Drawn(h, torch.arange(2), fit, draws, h == 1) for h in range(2)]
    before = T([0.0, math.log(UNTOLD)])
    found = _probabilities(drawn, torch.full((2, 2), 50.0, dtype=DTYPE), before, before)
    assert torch.allclose(found, (T([1.0, UNTOLD]) / (1 + UNTOLD)).expand(2, -1))


def test_an_interval_of_a_load_of_any_form_is_of_all_sizes_and_length_scales():
    """And so it is wider than that of the one pair which is the likeliest."""
    problem, _ = posed(8, 4, (0.3, 0.6))
    candidates = contact_hypotheses(problem, 1, "smooth")
    found = analyze(problem, candidates, sampled=True)
    assert found.intervals is not None and found.evidence is not None
    wider = []
    for b, h in enumerate(found.evidence.choice.tolist()):
        alone = analyze(problem.of(candidates[h].unknowns).take(torch.tensor([b])), sampled=True).intervals
        assert alone is not None
        own, every = alone.location[0, 0], found.intervals.location[b, 0]
        assert bool(every[0] <= own[0] + 1e-9) and bool(every[1] >= own[1] - 1e-9)
        wider.append(float(every.diff() / own.diff()))
    assert max(wider) > 1.1


@pytest.mark.study
def test_a_pull_at_the_tip_passes_for_opposed_pushes_near_it_and_the_resultant_holds_both():
    """Two opposed pushes 5 to 10 % of the length apart on the outer third: once half of those told with a force at the tip."""
    random, robot, B = torch.Generator().manual_seed(3), steel_rod(), 60
    first = 0.65 + 0.25 * torch.rand(B, 1, generator=random, dtype=DTYPE)
    place = L * torch.cat([first, first + 0.05 + 0.05 * torch.rand(B, 1, generator=random, dtype=DTYPE)], -1)
    size = robot.rod.force_scale * (0.5 + 1.5 * torch.rand(B, 2, generator=random, dtype=DTYPE))
    turn = 2 * math.pi * torch.rand(B, 1, generator=random, dtype=DTYPE) + math.pi * torch.arange(2)
    F = torch.stack([size * turn.cos(), size * turn.sin(), 0 * turn], -1)
    rod = solve_shape(robot, (PointForces(F, place),), None, S, B, 160)
    p = rod.p + 4e-4 * torch.randn(rod.p.shape, generator=random, dtype=DTYPE)
    problem = Problem(robot, Unknowns(GaussianCoordinates(1, L, robot.rod.force_scale)), [Markers(S, p, 4e-4)])
    found = analyze(problem, contact_hypotheses(problem), sampled=True)
    assert found.intervals is not None and found.evidence is not None
    truth, interval = rod.base_wrench[:, :3].norm(dim=-1), found.intervals.resultant[:, 3]
    inside = (truth >= interval[:, 0]) & (truth <= interval[:, 1])
    told = torch.tensor(["tip" in found.evidence.names[h] for h in found.evidence.choice.tolist()])
    assert int(told.sum()) >= 10
    assert float(inside[told].double().mean()) > 0.75 and float(inside.double().mean()) > 0.85
