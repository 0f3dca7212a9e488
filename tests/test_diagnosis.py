"""Exchanged labels, a base frame that is off, and a load too few: told where they are, and only there."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import roma
import torch

from tests.problems import unknowns_of
from tests.robots import T, steel_rod
from tests.study import study1
from torchrod import (
    Diagnosis,
    GaussianCoordinates,
    Markers,
    PointForces,
    PointWrenches,
    Poses,
    Problem,
    Registration,
    Robot,
    Rod,
    Settings,
    Shapes,
    Tendon,
    Tendons,
    Uncertainty,
    Unknowns,
    analyze,
    contact_hypotheses,
    diagnose,
    estimate,
    solve_shape,
    write_shapes,
)
from torchrod.analysis import diagnosis, suspects
from torchrod.analysis.count import parts_of, select
from torchrod.analysis.diagnosis import _misfit, _stretch
from torchrod.cli import main

L = 0.4
ROD = "[rod]\nlength = 0.4\ndiameter = 0.0014\nyoungs_modulus = 207e9\nshear_modulus = 79e9\n"


def seen(markers: Markers, count: int = 1) -> Problem:
    """Markers of so many contacts on the steel rod."""
    robot = steel_rod()
    return Problem(robot, unknowns_of(robot, count), [markers])


def noisy(count: int, seed: int = 3) -> Markers:
    study = study1(count, seed)
    generator = torch.Generator().manual_seed(seed)
    return Markers(study.s, study.positions + 1e-3 * torch.randn(study.positions.shape, generator=generator), 1e-3)


def off(positions: torch.Tensor) -> torch.Tensor:
    """The base frame off by 5 mm and 3 degrees."""
    R = roma.rotvec_to_rotmat(math.radians(3) * T([0.8, 0.6, 0.0]))
    return positions @ R.T + 5e-3 * T([0.6, 0.0, 0.8])


def exchanged(markers: Markers, pairs: list[tuple[int, int]]) -> Markers:
    positions = markers.positions.clone()
    for b, (i, j) in enumerate(pairs):
        positions[b, [i, j]] = markers.positions[b, [j, i]]
    return replace(markers, positions=positions)


def test_the_cost_of_every_exchange_is_that_of_making_it():
    """O(P^3) bookkeeping against exchanging and evaluating (1) anew; a missing marker and offsets included."""
    generator = torch.Generator().manual_seed(0)
    z, fitted = torch.randn(2, 5, 3, generator=generator), torch.randn(2, 5, 3, generator=generator)
    z[1, 3] = torch.nan
    markers = Markers(torch.linspace(0.1, 0.5, 5), z, 1e-3, 0.05 * torch.rand(5, 3, generator=generator))
    after, beside = _stretch(markers, z), _misfit(fitted, z)
    for i, j in ((0, 1), (1, 4), (2, 2), (0, 4)):
        order = list(range(5))
        order[i], order[j] = j, i
        assert torch.allclose(_stretch(markers, z[:, order])[:, 2, 2], after[:, i, j])
        assert torch.allclose((z[:, order] - fitted).square().sum(-1).nansum(-1), beside[:, i, j])


@pytest.mark.many_fits
def test_exchanged_labels_are_found_and_nothing_else():
    """Neighbours 2 cm apart and far ones; the clean samples in between stay unsuspected, and the fit is not touched."""
    pairs = [(6, 7), (0, 0), (2, 15), (18, 19), (5, 5), (0, 1), (3, 9), (10, 11)]
    problem = seen(exchanged(noisy(8), pairs))
    fit = estimate(problem)
    diagnosis = diagnose(problem, fit)
    assert [list(c) for c in diagnosis.exchanged] == [[] if i == j else [(i, j)] for i, j in pairs]
    assert diagnosis.registration.isnan().all()
    assert "Markers 7 and 8 (s = 140 and 160 mm) look exchanged" in diagnosis.message(0)
    assert diagnosis.message(1) == ""
    assert fit.residual[0].abs().max() > 5e-3, "the fit is that of the markers as they are labelled"


@pytest.mark.many_fits
def test_three_labels_in_a_ring_are_one_group():
    markers = noisy(1)
    positions = markers.positions.clone()
    positions[0, [4, 9, 12]] = markers.positions[0, [9, 12, 4]]
    problem = seen(replace(markers, positions=positions))
    diagnosis = diagnose(problem, estimate(problem))
    assert diagnosis.suspects(0)[0]["markers"] == [5, 10, 13]
    assert "5, 10 and 13" in diagnosis.message(0)


@pytest.mark.many_fits
def test_arc_lengths_that_are_off_are_told_and_stated_they_are_accepted(tmp_path, capsys):
    """3 mm along the rod at 0.3 mm noise; not of an oval rod, nor of a push too few, whose residual lies across."""
    count, noise, study = 6, 3e-4, study1(6, 3)
    g = torch.Generator().manual_seed(1)

    def read(p: torch.Tensor) -> torch.Tensor:
        return p + noise * torch.randn(p.shape, generator=g)

    at = study.s + 3e-3 * torch.randn(len(study.s), generator=g).clamp(-1.5, 1.5)
    at[-1] = study.s[-1]
    one = PointForces(torch.cat([study.force, 0 * study.force[:, :1]], -1).unsqueeze(1), study.location.unsqueeze(1))
    wrong = Markers(study.s, read(solve_shape(steel_rod(), (one,), None, at, count).p), noise)
    two = PointForces(T([[[0.8, 0.0, 0.0], [0.0, -0.7, 0.0]]]).repeat(count, 1, 1), T([[0.15, 0.35]]).repeat(count, 1))
    fewer = Markers(study.s, read(solve_shape(steel_rod(), (two,), None, study.s, count).p), noise)
    soft = replace(steel_rod(), rod=replace(steel_rod().rod, K_bt=T([1.0, 0.5, 1.0]).diag().double() * steel_rod().rod.K_bt))
    oval = Markers(study.s, read(solve_shape(soft, (one,), None, study.s, count).p), noise)
    for markers, slipped in ((wrong, True), (fewer, False), (oval, False)):
        problem = seen(markers)
        fit = estimate(problem)
        diagnosis = diagnose(problem, fit)
        assert ["arc lengths that are off by about" in diagnosis.message(b) for b in range(count)] == [slipped] * count
    (tmp_path / "rod.toml").write_text(ROD)
    write_shapes(tmp_path / "s.csv", Shapes(study.s, wrong.positions, [str(b) for b in range(count)]))
    command = ["estimate", str(tmp_path / "rod.toml"), str(tmp_path / "s.csv"), "--noise", str(noise)]
    assert main([*command, "--s-std", "3"]) == 2
    assert "--s-std is 3 m on a rod of 0.4 m; it is in metres" in capsys.readouterr().err
    assert main([*command, "--s-std", "0.003"]) == 0
    assert f"{count} accepted" in capsys.readouterr().out
    q = solve_shape(steel_rod(), (one,), None, study.s, count).q
    write_shapes(tmp_path / "q.csv", Shapes(study.s, wrong.positions, [str(b) for b in range(count)], readings={"orientations": q}))
    assert main(["estimate", str(tmp_path / "rod.toml"), str(tmp_path / "q.csv"), "--noise", "0.01", "--s-std", "0.003"]) == 0
    assert "--s-std has no effect" in capsys.readouterr().err


def test_a_pose_alone_leads_to_an_unknown_tip():
    """Where one contact explains it, too."""
    robot, at = steel_rod(), T([L])
    push = PointWrenches(T([[[0.3, 0.1, 0.0]]]), torch.zeros(1, 1, 3), at)
    tip = solve_shape(robot, (push,), None, at, 1)
    problem = Problem(robot, unknowns_of(robot), [Poses(at, tip.p, tip.q, 1e-3, 0.01)])
    found = analyze(problem)
    assert found.estimate.accepted.all()
    assert "try --contacts 0 --unknown-tip force" in found.message(0)


@pytest.mark.many_fits
def test_a_base_frame_that_is_off_is_told_with_its_size():
    clean = noisy(6)
    problem = seen(replace(clean, positions=off(clean.positions)))
    fit = estimate(problem)
    diagnosis = diagnose(problem, fit)
    assert not fit.accepted.any()
    assert torch.isfinite(diagnosis.registration).all()
    assert abs(diagnosis.registration[:, :3].norm(dim=-1).mean() - 5e-3) < 2e-3
    assert abs(diagnosis.registration[:, 3:].norm(dim=-1).mean() - math.radians(3)) < math.radians(1)
    assert "try --registration" in diagnosis.message(0)
    assert not diagnosis.one_more.any()
    unhurt = diagnose(seen(clean), estimate(seen(clean)))
    assert [unhurt.message(b) for b in range(6)] == [""] * 6


@pytest.mark.many_fits
def test_a_load_too_few_is_no_base_frame():
    robot, s = steel_rod(), torch.linspace(0.02, 0.4, 20)
    push = PointForces(T([[[0.8, 0.2, 0.0], [-0.6, 0.7, 0.0]]]), T([[0.15, 0.32]]))
    problem = seen(Markers(s, solve_shape(robot, (push,), None, s, 1).p, 1e-3))
    diagnosis = diagnose(problem, estimate(problem), Settings())
    assert diagnosis.one_more[0]
    assert diagnosis.registration.isnan().all()


@pytest.mark.many_fits
@pytest.mark.many_fits
def test_a_base_frame_speaks_against_an_accepted_fit_where_it_is_better_by_ten():
    """Frames off by 0 to 5 mm and 3 degrees, which often pass for loads. BIC by hand: 3 numbers a load, 6 the frame."""
    B, random, study = 60, torch.Generator().manual_seed(3), study1(60, 3)
    much, axis, way = (torch.randn(B, 1, 3, generator=random) for _ in range(3))
    much, axis, way = much[..., :1].abs().clamp(max=1.0), *(v / v.norm(dim=-1, keepdim=True) for v in (axis, way))
    R = roma.rotvec_to_rotmat(math.radians(3) * (much * axis).squeeze(1))
    p = study.positions @ R.mT + 5e-3 * much * way
    problem = seen(Markers(study.s, p + 1e-3 * torch.randn(p.shape, generator=random), 1e-3))
    candidates = contact_hypotheses(problem)
    fit, evidence = select(problem, candidates)
    loads = torch.isfinite(fit.force[..., 0]).sum(-1)
    by_frame = torch.full((B,), torch.inf)
    for count in (1, 2):
        other = estimate(replace(problem, unknowns=replace(unknowns_of(steel_rod(), count), registration=Registration())))
        score = other.chi2 + (3 * count + 6) * math.log(60)
        by_frame = torch.where(other.accepted & ((loads == count + 1) | (count == 1)), torch.minimum(by_frame, score), by_frame)
    better = fit.chi2 + 3 * loads * math.log(60) - by_frame
    looked_at = fit.accepted & (loads > 1)
    told = torch.isfinite(diagnose(problem, fit, parts=parts_of(candidates, evidence)).registration).all(-1)
    assert torch.equal(told[looked_at], better[looked_at] > 10)
    assert (better[looked_at & told] < 15).any() and (better[looked_at & ~told] > 5).any()


def test_the_command_line_tells(tmp_path, capsys):
    """In the report and in RESULT.json, with one contact and with auto, and the samples beside them are as without."""
    (tmp_path / "robot.toml").write_text(ROD)
    clean = noisy(3)
    positions = exchanged(clean, [(6, 11), (0, 0), (0, 0)]).positions
    positions[1] = off(positions[1])
    write_shapes(tmp_path / "shapes.csv", Shapes(clean.s, positions, ["swapped", "moved", "clean"]))
    for count in ("1", "auto"):
        options = ["--contacts", count, "--out", str(tmp_path / "result.json")]
        assert main(["estimate", str(tmp_path / "robot.toml"), str(tmp_path / "shapes.csv"), *options]) == 0
        said = capsys.readouterr().out
        assert "Markers 7 and 12 (s = 140 and 240 mm) look exchanged" in said
        assert "sample moved: " in said
        assert "try --registration" in said
        swapped, moved, unhurt = json.loads((tmp_path / "result.json").read_text())["results"]
        (suspect,) = swapped["suspect_markers"]
        assert suspect == {"markers": [7, 12], "s_m": clean.s[[6, 11]].tolist(), "suspicion": "exchanged"}
        assert swapped["accepted"] is False
        assert "try --registration" in moved["message"]
        assert moved["suspect_markers"] == unhurt["suspect_markers"] == []
        assert unhurt["message"] == "Converged."
        if count == "1":
            options[-1] = str(tmp_path / "result.npz")
            assert main(["estimate", str(tmp_path / "robot.toml"), str(tmp_path / "shapes.csv"), *options]) == 0
            capsys.readouterr()
            with np.load(tmp_path / "result.npz", allow_pickle=False) as arrays:
                assert arrays["messages"][arrays["message"]].tolist() == [record["message"] for record in (swapped, moved, unhurt)]


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.many_fits
def test_outliers_are_named_where_nothing_else_explains_the_markers(count):
    """2 of 20 markers 50 mm off, in every other sample: those two are told, and none of clean markers."""
    markers = noisy(8)
    positions = markers.positions.clone()
    positions[::2, 6, 0] += 0.05
    positions[::2, 13, 1] -= 0.05
    problem = seen(replace(markers, positions=positions), count)
    diagnosis = diagnose(problem, estimate(problem))
    assert diagnosis.outliers == ((6, 13), ()) * 4
    assert "Markers 7 and 14 (s = 140 and 280 mm) look like outliers; try --robust." in diagnosis.message(0)
    assert [group["suspicion"] for group in diagnosis.suspects(0)] == ["outlier", "outlier"]
    robust = Settings(robust=10.0)
    assert diagnose(problem, estimate(problem, robust), robust).outliers == ((),) * 8


def off_by(what: str) -> Problem:
    """24 pushed shapes of a rod with weight: bent by 0.3/m, read 4 mm along the rod from where it is said, or under tensions that
    are off by a fifth.
    """
    random, B = torch.Generator().manual_seed(8), 24
    rod = replace(steel_rod().rod, mass_per_length=T(0.0122))
    tendons = Tendons((Tendon.straight(0.006, 0.0, L), Tendon.straight(-0.003, 0.005, L)))
    robot = Robot(rod, tendons if what == "tension" else Tendons(()), T([0.0, -9.81, 0.0]))
    tension = 2 + 4 * torch.rand(B, 2, generator=random) if what == "tension" else None
    size, turn = 0.5 + 0.5 * torch.rand(B, 1, generator=random), 6.28 * torch.rand(B, 1, generator=random)
    load = PointForces(
        torch.stack([size * turn.cos(), size * turn.sin(), 0 * size], -1), 0.12 + 0.25 * torch.rand(B, 1, generator=random)
    )
    s, shapes = torch.linspace(0.02, L - 0.01, 20), []
    for b in range(B):
        own, at, pull = robot, s, None if tension is None else tension[b : b + 1]
        if what == "set":
            a = 6.28 * float(torch.rand(1, generator=random))
            own = replace(robot, rod=replace(rod, reference_curvature=T([[0.0, 0.3 * math.cos(a), 0.3 * math.sin(a), 0.0]])))
        if what == "arc lengths":
            at = s + 0.004 * torch.randn(20, generator=random).clamp(-2, 2)
            at = at.clamp(max=L).sort().values
        if pull is not None:
            pull = pull * (1 + 0.2 * torch.randn(1, 2, generator=random).clamp(-1.5, 1.5))
        shapes.append(solve_shape(own, (load.take(torch.tensor([b])),), pull, at, 1, 80).p)
    p = torch.cat(shapes)
    p = p + 2e-4 * torch.randn(p.shape, generator=random)
    return Problem(robot, Unknowns(GaussianCoordinates(1, L, rod.force_scale)), [Markers(s, p, 2e-4)], tension)


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("set", ["bent, unloaded"]),
        ("arc lengths", ["arc lengths that are off by about", "--s-std"]),
        ("tension", ["tensions that are off", "bent, unloaded"]),  # straight tendons bend a rod as a set does
    ],
)
def test_what_is_off_of_the_robot_is_named(what, said):
    """Where no load explains the shape; once "one more contact" was, or nothing."""
    found = analyze(off_by(what))
    refused = (~found.estimate.accepted).nonzero().squeeze(-1).tolist()
    assert len(refused) > 8
    assert sum(any(words in found.message(b) for words in said) for b in refused) > 0.6 * len(refused)
    assert any(said[0] in found.message(b) for b in refused)


@pytest.mark.parametrize("bent", [True, False])
def test_a_bend_that_passes_for_contacts_is_named(bent):
    """One push on a rod that is bent, unloaded, other than its file says, is accepted as two contacts; two pushes are two."""
    random, B, robot, noise = torch.Generator().manual_seed(0), 16, steel_rod(), 4e-4
    count, s, shapes = 1 if bent else 2, torch.linspace(0.02, L, 20), []
    for _ in range(B):
        rod, a = robot.rod, 6.28 * float(torch.rand(1, generator=random))
        if bent:
            rod = replace(rod, reference_curvature=T([[0.0, 0.3 * math.cos(a), 0.3 * math.sin(a), 0.0]]))
        size, turn = 0.5 + torch.rand(1, count, generator=random), 6.28 * torch.rand(1, count, generator=random)
        place = 0.12 + 0.08 * torch.rand(1, count, generator=random) + 0.16 * torch.arange(count)
        load = PointForces(torch.stack([size * turn.cos(), size * turn.sin(), 0 * size], -1), place)
        shapes.append(solve_shape(replace(robot, rod=rod), (load,), None, s, 1, 80).p)
    p = torch.cat(shapes)
    p = p + noise * torch.randn(p.shape, generator=random)
    problem = Problem(robot, Unknowns(GaussianCoordinates(1, L, robot.rod.force_scale)), [Markers(s, p, noise)])
    found = analyze(problem, contact_hypotheses(problem))
    several = torch.isfinite(found.estimate.location).sum(-1) > 1
    wrong = (found.estimate.accepted & several).nonzero().squeeze(-1).tolist()
    assert len(wrong) > 8
    said = ["explained as well by a rod that is bent, unloaded" in found.diagnosis.message(b) for b in wrong]
    if bent:
        assert sum(said) > 0.7 * len(wrong)
        assert any('with 1 contact instead of 2: state "set = 0.25"' in found.diagnosis.message(b) for b in wrong)
    else:
        assert not any("explain" in found.diagnosis.message(b) for b in range(B))


@pytest.mark.parametrize(("count", "accepted", "loads"), [(0, True, [0]), (1, True, [1]), (3, True, [3, 1, 2]), (3, False, [3])])
def test_suspects_never_take_more_contacts_than_the_fit(count, accepted, loads, monkeypatch):
    tried = []

    def asked(part, x, settings):
        tried.append(part.unknowns.loads.count)
        return suspects.Suspected(torch.full((part.batch,), torch.inf), [""] * part.batch)

    monkeypatch.setattr(diagnosis, "suspected", asked)
    problem = off_by("set").take(torch.arange(2))
    family = replace(problem.unknowns.loads, count=count)  # pyright: ignore[reportArgumentType]
    problem = problem.of(replace(problem.unknowns, loads=family, tip="none" if count else "force"))
    own = torch.full((2,), 50.0 if accepted else torch.inf)
    diagnosis._by_robot(problem, torch.zeros(2, problem.size), own, torch.ones(2, dtype=torch.bool), Settings(max_iterations=3))
    assert tried == loads


def test_a_suspect_pays_for_what_its_fit_narrows_down(monkeypatch):
    """(1) of analysis.suspects, by hand, of a bent rod; arc lengths pay ln(1 + a^2) for every marker."""
    problem = off_by("set").take(torch.arange(4))
    x, own = estimate(problem).x, problem.of(replace(problem.unknowns, uncertainty=Uncertainty(set=0.25)))
    fit, at = estimate(own), own.state.parameters.at
    by_hand = fit.chi2 + 3 * math.log(60) - torch.linalg.slogdet(fit.covariance[:, at, at])[1]
    monkeypatch.setattr(suspects, "_along", lambda *_: 0.0)
    monkeypatch.setattr(suspects, "suspects", lambda _: [suspects.Suspect("set", 0.25, str)])
    score = suspects.suspected(problem, x, Settings()).score
    assert fit.accepted.all() and torch.allclose(score, by_hand, atol=0.1)
    markers = problem.markers
    assert markers is not None
    framed = problem.of(replace(problem.unknowns, registration=Registration()))
    fit = estimate(framed)
    paid = (suspects._score(framed, fit, torch.zeros(4)) - fit.chi2)[fit.accepted]
    assert len(paid) and torch.allclose(paid, T((3 + 6) * math.log(60))), "a base frame's numbers count as a load's do"
    _, price = suspects._loose(problem, 2e-3)
    assert torch.allclose(price, torch.full((4,), 20 * math.log(101.0)))


def test_arc_lengths_that_are_off_are_told_in_a_base_frame_that_is_unknown():
    """By their own size, not by that of the frame's error: 16 mm and 9 degrees."""
    problem = off_by("arc lengths").take(torch.arange(6))
    markers = problem.markers
    assert markers is not None
    zeta = T([5e-3, -3e-3, 15e-3, 0.1, -0.12, 0.0])
    R, t = roma.rotvec_to_rotmat(zeta[3:].double()), zeta[:3].double()
    plain, framed = (
        diagnose(some, estimate(some))
        for some in (
            problem,
            problem.of(replace(problem.unknowns, registration=Registration())).moved(R, t),
        )
    )

    def told(diagnosis: Diagnosis) -> list[float]:
        found = [re.search(r"off by about ([0-9.]+) mm", diagnosis.message(b)) for b in range(problem.batch)]
        return [float(size[1]) for size in found if size]

    assert len(told(framed)) >= 3
    assert max(told(framed)) < 1.3 * max(told(plain))


@pytest.mark.parametrize("turned", [0.0, 0.3])
def test_a_strip_that_no_load_explains_has_a_diagnosis(turned):
    """Which to its soft side has less stiffness than a round rod is off by."""
    rod, L = steel_rod().rod, 0.4
    R = roma.rotvec_to_rotmat(T([0.0, 0.0, turned]).double())
    K = R @ T([0.05, 20.0, 0.2]).double().diag() @ R.mT * rod.bending_stiffness
    robot = Robot(Rod.from_stiffness(L, rod.K_se, 0.5 * (K + K.mT)))
    load = PointForces(T([[[0.02, 0.02, 0.0], [-0.02, 0.01, 0.0]]]), T([[0.15, 0.35]]))
    s = torch.linspace(0.02, L, 20)
    problem = Problem(
        robot,
        Unknowns(GaussianCoordinates(1, L, robot.rod.force_scale)),
        [Markers(s, solve_shape(robot, (load,), None, s, 1).p + 4e-3 * (s > 0.2).double().unsqueeze(-1), 1e-4)],
    )
    fit = estimate(problem)
    assert not bool(fit.accepted)
    assert "stiffer to one side" not in diagnose(problem, fit).message(0)
