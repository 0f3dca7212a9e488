"""scripts/reproduce.py --quick: the studies run, and their figures say what the README says."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


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
    for noise, rows in data["study1"].items():
        for prior in ("point", "contact", "none"):
            assert rows["rows"][prior]["converged"] == 1.0, (noise, prior)
    clean, noisy = data["study1"]["clean"], data["study1"]["noise_1mm"]
    assert clean["location_m_mean"] < 1e-4
    assert clean["force_N_mean"] < 1e-3
    assert noisy["iterations_mean"] < 10
    assert 0.5 < noisy["efficiency_location"] < 1.6
    for region in ("region_95", "magnitude_95", "location_95"):
        assert data["coverage"][region] > 0.88, region
    for name in ("reproduction.md", "study1.png", "coverage.png"):
        assert (tmp_path / name).stat().st_size > 500
