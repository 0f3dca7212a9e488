"""The parts of scripts/trust.py run, and their figures say what the page says."""

from matplotlib.figure import Figure
from trusting import coverage, frame, mistakes

from torchrod import Estimate


def test_coverage_of_a_contact():
    ours, linear, by = coverage.measured(coverage.ROWS[0], 100, 100)
    assert min(ours[:5]) > 0.88
    assert max(linear) < min(ours[2:5])
    assert len(by) == 12


def test_mistakes_are_told():
    rows = {row.name: row for row in mistakes.ROWS}
    assert list(mistakes.measured(rows["nothing wrong"], 10, 1)) == [10, 0, 0, 0, 0, 0]
    assert list(mistakes.measured(rows["one pair exchanged"], 6, 2)) == [0, 6, 0, 0, 0, 0]


def test_one_frame_for_many_shapes():
    true, clean = frame._cases(12)
    fit = frame._one_frame(12, 12, 3)
    assert isinstance(fit, Estimate)
    alone = frame.estimate(frame.model(1), clean, frame.NOISE)
    for i in (0, 1):
        assert frame._errors(fit, true)[i] < 1.6 * frame._errors(alone, true)[i]
    axes = Figure().subplots()
    frame._figure(
        axes, {"perfect frame": [1, 1], "frame off, --registration": [3, 5], "off, --one-frame, 9 shapes": [1, 1]}, [1, 1]
    )
    assert len(axes.lines) == 3
