"""scripts/reproduce.py --quick: the studies run, and their figures say what the README says."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.many_fits
@pytest.mark.study
def test_quick_reproduction(tmp_path):
    command = [
        sys.executable,
        str(ROOT / "scripts" / "reproduce.py"),
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
    for family in ("gaussian", "fourier", "point"):
        assert data["study2"][family]["converged"] == 1.0, family
        assert data["study2"][family]["shape_rms_m_mean"] < 4e-5, family
    for table, (force, location) in {"I": (0.32, 0.0198), "II": (0.61, 0.0419), "III": (0.65, 0.0398)}.items():
        row = data["tables"][table]
        assert row["force_N_mean"] < force, table
        assert row["location_m_mean"] < location, table
        assert row["without_mismatch"]["efficiency_location"] < 1.6, table
    for region in ("region_95", "magnitude_95", "location_95"):
        assert data["coverage"][region] > 0.88, region
    for name in ("reproduction.md", "study1.png", "study2.png", "coverage.png", "figure6.png"):
        assert (tmp_path / name).stat().st_size > 500
