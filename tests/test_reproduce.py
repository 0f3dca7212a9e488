"""scripts/reproduce.py --quick: the studies run, and their figures say what the README says."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from studies.reproduction import paper_mode, printed_rows, study2

from tests.robots import steel_rod
from torchrod import Markers, PaperCoordinates, paper_settings

ROOT = Path(__file__).resolve().parents[1]
PAPER = {"I": (0.32, 0.0198), "II": (0.61, 0.0419), "III": (0.65, 0.0398)}  # mean errors of its printed rows, N and m


def check_tables(rows):
    """An entry for every printed row, under both readings, and mean errors below the paper's in all three tables."""
    assert [sum(r["table"] == t for r in rows) for t in PAPER] == [10, 16, 10]
    for table, (force, location) in PAPER.items():
        mine = [r for r in rows if r["table"] == table]
        for reading in ("negative_is_pulled", "size_only"):
            fits = [r["readings"][reading]["with_mismatch"] for r in mine]
            assert all(f["simulated"] == 1.0 for f in fits)
            assert sum(f["force_error_N_mean"] for f in fits) / len(fits) < force
            assert sum(f["location_error_m_mean"] for f in fits) / len(fits) < location
            for r, f in zip(mine, fits, strict=True):
                assert f["location_m"]["p5"] <= f["location_m"]["median"] <= f["location_m"]["p95"]
                assert abs(f["location_m"]["median"] - r["measured_m"]) < 0.15
    slack = {r["pair"] for r in rows if r["readings"]["negative_is_pulled"]["without_mismatch"]["slack"] == [1.0]}
    assert {"1", "2", "7", "8"} <= slack, "a tendon let go carries nothing"


def test_paper_mode_is_the_best_of_the_search():
    """What paper_problem and paper_settings have is what the table of the search says did best."""
    with paper_mode.TABLE.open(newline="") as file:
        best = min((r for r in csv.DictReader(file) if r["stage"] == "check"), key=paper_mode.rank)
    problem = paper_mode.paper_problem(steel_rod(), Markers(torch.tensor([0.4]), torch.zeros(1, 1, 3), 1e-3))
    settings, c = paper_settings(problem), problem.unknowns.loads
    assert isinstance(settings.Q, torch.Tensor)
    assert isinstance(settings.Sigma0, torch.Tensor)
    assert isinstance(c, PaperCoordinates)
    wanted = [float(best[k]) for k in ("a", "a", "eta", "c", "n", "n", "n", "m", "m", "m")]
    assert torch.allclose(settings.Q.sqrt(), torch.tensor(wanted))
    assert torch.allclose((settings.Sigma0 / settings.Q).sqrt(), torch.tensor(float(best["ratio"])))
    assert c.width == float(best["width"])
    assert c.beta1 == -float(best["beyond"])
    assert problem.tip_std == (float(best["tip_N"]), float(best["tip_Nm"]))


def test_study_2_stays_below_the_papers_limit():
    study = study2.study2(20)
    assert study.load.coefficients.shape == (20, 2, 11)
    top = study.load.density(torch.linspace(0, 0.4, 3001)).norm(dim=-1).amax(-1)
    assert (top < 5.0).all()
    assert (top > 2.4).all()


def test_the_printed_rows_are_those_of_the_shared_facts():
    shared = ROOT.parent / "shared" / "data" / "paper_tables.csv"
    if not shared.exists():
        pytest.skip("the facts of the paper are not beside the repository")
    assert printed_rows.ROWS.read_text() == shared.read_text()


@pytest.mark.many_fits
@pytest.mark.study
def test_quick_reproduction(tmp_path):
    """The parts of fits; tests/test_figures.py runs the others."""
    command = [
        sys.executable,
        str(ROOT / "scripts" / "reproduce.py"),
        *("study1", "study2", "coverage", "tables"),
        "--quick",
        "--json",
        str(tmp_path / "f.json"),
        "--out",
        str(tmp_path),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    data = json.loads((tmp_path / "f.json").read_text())
    for noise in ("clean", "noise_1mm"):
        for prior in ("point", "contact", "none"):
            assert data["study1"][noise]["rows"][prior]["converged"] == 1.0, (noise, prior)
    clean, noisy = data["study1"]["clean"], data["study1"]["noise_1mm"]
    assert clean["location_m_mean"] < 1e-4
    assert clean["force_N_mean"] < 1e-3
    assert noisy["iterations_mean"] < 10
    for what in ("location", "force"):
        assert 0.6 < noisy[f"efficiency_{what}"] < 1.4
    for noise in ("clean", "noise_1mm"):
        mode = data["study1"]["paper_mode"][noise]
        assert {"converged", "iterations_mean", "location_m_mean", "force_N_mean"} <= set(mode)
        assert mode["converged"] >= 0.94
        assert mode["accepted"] >= 0.94
        assert mode["location_m_mean"] < 0.0201
        assert mode["force_N_mean"] < 0.53
    for family in ("gaussian", "fourier", "point"):
        assert data["study2"][family]["converged"] == 1.0, family
        assert data["study2"][family]["shape_rms_m_mean"] < 4e-5, family
    check_tables(data["tables"])
    for region in ("region_95", "magnitude_95", "location_95"):
        assert data["coverage"][region] > 0.88, region
    for name in ("reproduction.md", "study1.png", "study2.png", "coverage.png", "figure6.png"):
        assert (tmp_path / name).stat().st_size > 500
