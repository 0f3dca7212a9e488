"""scripts/benchmark.py: the peers give torchrod's answers, and tables and figure can be made. No time is measured here."""

import json
from pathlib import Path

import numpy as np
import pytest
from studies import peers
from studies.benchmark import torchrod_path
from studies.benchmark.agreement import Disagreement, Tolerance, fit_differences, linear_differences, verify
from studies.benchmark.bars import bars, ratios, straight
from studies.benchmark.cases import ITERATION, STUDY, write, write_frames
from studies.benchmark.figure import figure
from studies.benchmark.measure import steady
from studies.benchmark.plans import FULL, QUICK, WHOLE
from studies.benchmark.processes import Process
from studies.benchmark.report import BEGIN, END, generated, write_page
from studies.benchmark.torchrod_path import TorchrodPeer, kernel_seconds
from studies.benchmark.worker import Worker, timed

from torchrod import Estimate, kernel

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("benchmark")


def canned() -> dict:
    """What a run would have found."""
    batches = [str(b) for b in FULL.batches]
    at = {"torchrod": 4e-6, "torchrod, eager": 3e-4, "numba": 1e-5, "jax": 8e-5, "jax, tuned": 4e-5}
    data = {
        "machine": {
            "processor": "a processor",
            "cores": 2,
            "versions": {"torch": "2"},
            "dgemm": {"1": 6e10, "2": 1.2e11},
            "floor": {"1": 6e-6, "2": 3e-6},
        },
        "iteration": {name: {b: t * (1 + 20 / int(b)) for b in batches} for name, t in at.items()} | {"scipy": {"1": 1e-2}},
        "growth": {w: {"torchrod": {str(v): 1e-6 * v for v in getattr(FULL, w)}} for w in ("steps", "markers", "loads")},
        "linear": {name: {str(b): 4e-6 for b in FULL.linear} for name in ("torchrod", WHOLE)},
        "cores": {"torchrod": {"1": 8e-6, "2": 4e-6}},
        "memory": {"256": {"peak": 6e8, "before": 5e8, "seconds": 0.1}, "65536": {"peak": 9e8, "before": 5e8, "seconds": 10.0}},
        "command_line": {"command_s": 3.0, "import_s": 1.5},
        "first_call": {"numba, cached": {"import_s": 0.4, "first_s": 0.1}},
        "single": {
            "frames": {"first_s": 0.1, "median_s": 2e-3, "p99_s": 5e-3, "count": 400},
            "estimate_s": {"torchrod": 2e-2, "numba": 5e-4},
        },
    }
    row = {"batch": 4096, "seconds": 1e-4, "iterations": 7.2, "converged": 1.0, "kernel_share": None}
    data["estimates"] = {"torchrod, cold": row, "torchrod, warm": row | {"seconds": 2e-4, "kernel_share": 0.75}, "numba, cold": row}
    same = {
        "h": 1e-15,
        "H": 1e-13,
        "x": 1e-9,
        "Sigma": 1e-9,
        "force": 1e-9,
        "location": 1e-9,
        "cost": 1e-9,
        "elsewhere": 0.0,
        "converged": 1.0,
    }
    data["agreement"] = {"numba": same | {"samples": 64}}
    data["ratios"] = ratios(data)
    data["bars"] = bars(data)
    return data


def test_ratios_and_bars():
    data = canned()
    assert data["ratios"]["torchrod"]["numba"]["256"] == pytest.approx(0.4)
    met = {bar["what"]: bar["met"] for bar in data["bars"]}
    assert met["an iteration, batch 4096: torchrod / numba"] is True
    assert met["whole estimates, cold, batch 4096: a second"] is True
    assert met["whole estimates, warm, batch 4096: a second"] is False
    assert met["whole estimates, warm, batch 4096: share of time outside the kernel"] is True
    assert met["one frame, median after the first"] is True
    assert met["one frame, 99 % point / median"] is False
    assert met["the command line on one shape, cold process"] is True
    assert met["peak memory (batch 65536)"] is True
    lines = {"torchrod": "an iteration's time per sample, batches 256 to 65536"}
    lines[WHOLE] = "a whole estimate's time per sample, batches 1024 to 65536"
    data["linear"][WHOLE]["256"] *= 2  # what it costs once
    for path, line in lines.items():
        assert met[f"{line}: largest / smallest"] is True
        assert {bar["what"]: bar["met"] for bar in bars(data)}[f"{line}: largest / smallest"] is True
        data["linear"][path]["4096"] *= 1.11
        assert {bar["what"]: bar["met"] for bar in bars(data)}[f"{line}: largest / smallest"] is False


def test_a_straight_line():
    """What a call costs once is no bend; a time per sample that creeps up is."""
    batches = (256, 1024, 4096, 16384, 65536)
    once, each, off = straight({b: (3e-3 + 4e-5 * b) / b for b in batches})
    assert (once, each) == pytest.approx((3e-3, 4e-5))
    assert off < 1e-9
    *_, off = straight({b: 4e-5 * (b / 256) ** 0.1 for b in batches})
    assert 0.1 < off < 0.2
    data = canned()
    for path in ("torchrod", WHOLE):
        assert [bar["met"] for bar in data["bars"] if "off the line" in bar["what"]] == [True, True]
        data["linear"][path] = {b: t * int(b) ** 0.1 for b, t in data["linear"][path].items()}
    assert [bar["met"] for bar in bars(data) if "off the line" in bar["what"]] == [False, False]


def test_a_machine_that_is_slower_for_a_while_is_so_for_all():
    found = steady({"256": [1.0, 2.0, 1.0], "4096": [1.1, 2.2, 1.1]})
    assert found == pytest.approx({"256": 1.0, "4096": 1.1})


def test_a_share_of_work_is_the_same_in_batches_of_every_size(folder, monkeypatch):
    worker, path = Worker("torchrod"), str(write(ITERATION, folder))
    assert worker.share(path, 16, 64)["seconds"] > 0
    calls = []
    monkeypatch.setattr("studies.benchmark.worker.clocked", lambda once: calls.append(once()) or 0.5)
    assert worker.share(path, 16, 64)["seconds"] == 2.0 and len(calls) == 4
    assert worker.share(path, 64, 64)["seconds"] == 0.5
    assert worker.share(str(write(STUDY, folder)), 32, 64, whole=True)["seconds"] == 1.0
    assert isinstance(calls[-1], Estimate) and len(calls[-1].status) == 32


def test_what_was_not_measured_is_said():
    data = canned()
    unknown = {bar["what"] for bar in data["bars"] if bar["met"] is None}
    assert unknown == {"whole estimates, cold, batch 4096: share of time outside the kernel"}
    del data["iteration"]["numba"]
    data["ratios"] = ratios(data)
    assert any(bar["what"].endswith("torchrod / numba") and bar["met"] is None for bar in bars(data))


def test_page_and_figure(tmp_path):
    data = json.loads(json.dumps(canned()))
    page = tmp_path / "performance.md"
    page.write_text(f"prose before\n{BEGIN}\nold\n{END}\nprose after\n")
    write_page(page, generated(data, " --quick"))
    text = page.read_text()
    assert text.startswith("prose before\n") and text.endswith("\nprose after\n") and "\nold\n" not in text
    assert "**missed**" in text and "benchmark.py --quick" in text
    figure(data, tmp_path / "performance.png")
    assert (tmp_path / "performance.png").stat().st_size > 20_000


def test_a_page_is_made_where_there_is_none(tmp_path):
    write_page(tmp_path / "performance.md", "figures\n")
    write_page(tmp_path / "performance.md", "newer figures\n")
    text = (tmp_path / "performance.md").read_text()
    assert text.count(BEGIN) == 1 and "newer figures" in text and "\nfigures" not in text


def test_quick_measures_all_that_the_bars_need():
    assert {256, 4096} <= set(QUICK.batches) <= set(FULL.batches)


def test_a_peer_that_disagrees_is_refused():
    found = {
        "h": 1e-12,
        "H": 1e-12,
        "x": 0.0,
        "Sigma": 0.0,
        "force": 0.0,
        "location": 0.0,
        "cost": 0.0,
        "elsewhere": 0.0,
        "converged": 1.0,
    }
    verify("good", found, Tolerance())
    for wrong in ({"H": 1e-6}, {"x": 1e-3}, {"force": 1e-3}, {"h": float("nan")}, {"converged": 0.9}, {"elsewhere": 0.1}):
        with pytest.raises(Disagreement, match="bad"):
            verify("bad", found | wrong, Tolerance())


def reference(folder: Path, samples: int):
    """The peer of the base case, its states, and torchrod's h and H there."""
    problem, arrays = peers.Problem.load(write(ITERATION, folder))
    x = arrays["near"][:samples]
    h, H = TorchrodPeer(problem).linearize(x)
    return problem, x, {"h": h, "H": H}


def test_scipy_linearizes_as_torchrod_does(folder):
    problem, x, ours = reference(folder, 4)
    h, H = peers.peer("scipy", problem).linearize(x)
    off = linear_differences(ours, {"h": h, "H": H})
    assert off["h"] < 1e-10 and off["H"] < 1e-5


def test_scipy_fits_as_torchrod_does(folder):
    problem, arrays = peers.Problem.load(write(STUDY, folder))
    start, positions = arrays["start"][:2], arrays["positions"][:2]
    ours, theirs = (one.estimate(start, positions) for one in (TorchrodPeer(problem), peers.peer("scipy", problem)))
    off = fit_differences(vars(ours), vars(theirs))
    assert off["force"] < 5e-3 and off["location"] < 2e-4 and off["elsewhere"] == 0 and off["converged"] == 1


def test_frames_go_through_an_estimator(folder, monkeypatch):
    worker = Worker("torchrod")
    film = str(write_frames(3, folder))

    class Frames:
        def __init__(self, robot, unknowns, s, noise):
            assert unknowns.state(robot).size == 10 and len(s) == 20 and noise == STUDY.noise

        def __call__(self, positions):
            assert positions.shape == (20, 3)

    monkeypatch.setattr(torchrod_path, "Tracker", Frames)
    assert len(worker.frames(film)["seconds"]) == 3


def test_the_kernel_s_share_is_taken_where_torchrod_counts_it(monkeypatch):
    monkeypatch.setattr(kernel, "seconds", lambda: 1.5, raising=False)
    assert kernel_seconds() == 1.5
    clock = iter(range(100))
    assert timed(lambda: None, 0.0, lambda: next(clock))["kernel_share"] > 0
    assert timed(lambda: 3, 0.0)["kernel_share"] is None


@pytest.mark.parametrize("name", ["numba", "jax", "jax, tuned"])
def test_a_peer_linearizes_as_torchrod_does(folder, name):
    if not peers.installed(name):
        pytest.skip(f"{name} is not installed; pip install -e '.[bench]' brings it")
    _, x, ours = reference(folder, 16)
    with Process(name, ROOT / "out" / "benchmark") as process:
        out = folder / f"{name}.npz"
        process.ask("answers", data=str(write(ITERATION, folder)), out=str(out), samples=len(x), fits=False)
    with np.load(out) as theirs:
        off = linear_differences(ours, dict(theirs))
    assert off["h"] < 1e-8 and off["H"] < 1e-8
