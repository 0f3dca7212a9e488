"""The parts of scripts/trust.py run, and their figures say what the page says."""

import pytest
from matplotlib.figure import Figure
from studies.trust import coverage, drag, frame, markers, mistakes, robots, scores, unknown_noise

from torchrod import Estimate, estimate, solve_shape

pytestmark = [pytest.mark.many_fits, pytest.mark.study]


def test_coverage_of_a_contact():
    ours, linear, by = coverage.measured(coverage.ROWS[0], 100, 100)
    assert min(ours[:5]) > 0.88
    assert max(linear) < min(ours[2:5])
    assert len(by) == 12


def test_drag_that_is_stated_is_covered():
    plain, stated = drag.measured(drag.Row(0.4, True, 1e-3), 60, 700)
    assert max(plain[1:3]) < 0.75
    assert min(stated[1:4]) > 0.88
    assert stated[8] > 0.9


def test_mistakes_are_told():
    rows = {row.name: row for row in mistakes.ROWS}
    assert list(mistakes.measured(rows["nothing wrong"], 10, 1)) == [10, 0, 0, 0, 0, 0, 0, 0]
    assert list(mistakes.measured(rows["one pair exchanged"], 6, 2)) == [0, 6, 0, 0, 0, 0, 0, 0]
    assert list(mistakes.measured(rows["2 markers 50 mm off"], 6, 3)) == [0, 0, 0, 6, 0, 0, 0, 0]


def test_one_frame_for_many_shapes():
    true, clean = frame._cases(12)
    fit = frame._one_frame(12, 12, 3)
    assert isinstance(fit, Estimate)
    alone = estimate(frame.posed(clean, frame.pushed(1)))
    for i in (0, 1):
        assert frame._errors(fit, true)[i] < 1.6 * frame._errors(alone, true)[i]
    axes = Figure().subplots()
    frame._figure(
        axes, {"perfect frame": [1, 1], "frame off, --registration": [3, 5], "off, --one-frame, 9 shapes": [1, 1]}, [1, 1]
    )
    assert len(axes.lines) == 3


def test_missing_markers_cost_what_the_bounds_say():
    """6 of 20: mean errors grow by no more than the bounds do, to within what 400 cases tell; all accepted."""
    location, _, force, _, (held, _, accepted) = markers.missing(markers.MISSING[0], 400, 400)
    for mean, low, high, bound in (location, force):
        assert low < mean < high
        assert low < bound
        assert mean < 1.2 * bound
    assert held > 0.92
    assert accepted > 0.98


def test_markers_that_are_off_lead_two_contacts_astray_no_more():
    """Of 20 markers 2 are 50 mm off: within 1.5 of clean, mean and RMS; from the plain fit alone forces were 1.6 and 2.1."""
    *ratios, (named, others, accepted, without) = markers.off(markers.OFF[-1], 600, 504)
    for mean, *_ in ratios:
        assert mean < 1.5
    assert named > 0.99
    assert others < 0.005
    assert accepted > 0.98
    assert without > 2


def test_noise_and_count_unknown():
    known, unknown, accepted, mean, least, most, far = unknown_noise.measured(unknown_noise.ROWS[4], 30, 1)
    assert min(known, unknown, accepted) > 0.95
    assert abs(mean - 1) < 0.1
    assert 0.5 < least < most < 1.6
    assert far < 0.1


def test_z_scores_of_another_solver(monkeypatch):
    """Its shapes are those of many steps; z-scores of a cell of each table."""
    monkeypatch.setattr(scores, "WITHIN", 9.0)  # without draws
    for ratio in (1.0, 1e6):
        problem, pushes, _ = scores.drawn(scores.Cell(1e-12, ratio, True), 8, scores.generator(1))
        loads = problem.unknowns.loads.loads(pushes.gamma(problem.robot.rod.force_scale))
        fine = solve_shape(problem.robot, loads, None, problem.s, 8, 640).p
        assert float((fine - problem.reading[:, :60].unflatten(1, (20, 3))).abs().max()) < 1e-9
    for cell in (scores.Cell(1e-5, 500.0, False), scores.Cell(1e-2, 1.0, False), scores.Cell(1e-6, 1e6, True)):
        found = scores.measured(cell, 120, 2)
        assert found.converged == 1
        rms = found.z.square().mean(0).sqrt()
        assert float((rms - 1).abs().max()) < 0.25


def test_pushes_on_a_strip_no_wider_than_a_ribbon_are_all_fitted():
    """A push across hardly shows; in units of both sides together one fit in ten ended in one of thousands of soft force scales."""
    cell = scores.Cell(1e-3, 1e6, False)
    problem, pushes, _ = scores.drawn(cell, 100, scores.generator(3))
    fit = estimate(problem)
    assert fit.accepted.all()
    off, std = scores.errors(fit, pushes)
    assert float((off / std)[:, [0, 2]].square().mean(0).sqrt().max()) < 1.5


def test_robots_that_are_off():
    """A row of each table."""
    cells = robots.measured(("passive: stiffness 10 %", 0.001), 24, 5)[0].split(" | ")
    exact, stated = (int(cell.split("/")[0]) for cell in (cells[3], cells[5]))
    assert exact < 60 < 85 < stated
    line, counts = robots.counted(("passive: set 0.1/m", 0.0025), 4, 5)
    assert line.startswith("| passive: set 0.1/m | 0.25 |")
    assert counts[1, :3].tolist() == [[0, 4], [4, 4], [4, 4]]  # where the set is stated: nothing, and one push
