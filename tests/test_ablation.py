"""scripts/ablation.py --quick: the warm start saves iterations, costs nothing, and what has converged has converged."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from studies.ablation.cases import Case
from studies.ablation.measure import Run, compared

pytestmark = [pytest.mark.many_fits, pytest.mark.study]
ROOT = Path(__file__).resolve().parents[1]
CASES = ("study1_1mm", "nitinol", "one_tendon", "reference")
STARTS = {"cold", "warm", "oracle"}
ROW = {"iterations_mean", "iterations_median", "iterations_95", "converged", "accepted", "location_m_mean", "force_N_mean"}
ROW |= {"wall_s", "cpu_s", "warm_started", "iterations_mean_95"}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of a run, with the figures as figures.json."""
    folder = tmp_path_factory.mktemp("ablation")
    command = [sys.executable, str(ROOT / "scripts" / "ablation.py"), *CASES, "--quick"]
    command += ["--json", str(folder / "figures.json"), "--out", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return folder


@pytest.fixture(scope="module")
def figures(made):
    return json.loads((made / "figures.json").read_text())


def test_every_figure_is_there(made, figures):
    assert set(figures) == set(CASES)
    for name, case in figures.items():
        for start in STARTS:
            assert set(case[start]) == ROW, (name, start)
        assert {"warm_cold", "warm_cold_95", "warm_oracle", "warm_oracle_95"} == set(case["ratio"])
        assert {"accepted", "location_m", "force_N", "accepted_95", "location_m_95", "force_N_95"} == set(case["difference"])
        assert set(case["time"]) == {"start_s", "read_s", "cold_s", "solve_s", "network_s", "iteration_s"}
        low, high = case["ratio"]["warm_cold_95"]
        assert low <= case["ratio"]["warm_cold"] <= high, name
    for file in ("warm_start.md", "warm_start.png"):
        assert (made / file).stat().st_size > 500


@pytest.mark.parametrize("name", CASES)
def test_a_warm_start_costs_nothing(figures, name):
    case = figures[name]
    assert case["warm"]["accepted"] >= case["cold"]["accepted"] - 0.02
    assert case["difference"]["location_m"] < 1e-3
    assert case["worse"] <= 0.05


@pytest.mark.parametrize("name", CASES)
def test_what_has_converged_has_converged(figures, name):
    for start in ("cold", "warm"):
        assert -1e-6 < figures[name]["convergence"][start]["max"] < 0.01


def test_where_both_end_in_one_minimum_is_told_apart():
    """Three samples, of which the last ends elsewhere, cheaper and farther from the truth."""
    one, zero = torch.ones(3), torch.zeros(3)
    cold = Run(8 * one, one, one, zero, 10 * one, 0.01 * one, 0.1 * one, zero, (1.0, 1.0))
    warm = replace(cold, iterations=3 * one, chi2=torch.tensor([10.0, 10.005, 9.0]), force=torch.tensor([0.1, 0.1003, 0.4]))
    case = Case("three", "three samples", (), None, True)
    found = compared(case, {"cold": cold, "warm": warm, "oracle": cold})
    assert found["difference"]["force_N"] == pytest.approx(0.1001)
    assert found["same_minimum"] == {"share": pytest.approx(2 / 3), "location_m": 0.0, "force_N": pytest.approx(1.5e-4)}
    assert found["better"] == pytest.approx(1 / 3) and found["worse"] == 0


@pytest.mark.parametrize("name, bar", [("study1_1mm", 0.75), ("nitinol", 0.75), ("one_tendon", 0.65)])
def test_a_warm_start_saves_iterations(figures, name, bar):
    """The bars of docs/warm_start.md, with slack for the few samples of a quick run."""
    assert figures[name]["warm"]["warm_started"] > 0.8
    assert figures[name]["ratio"]["warm_cold"] < bar
