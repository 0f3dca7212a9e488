"""scripts/validate.py --quick: the forward model is as close to the references as docs/validation.md says."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
pytestmark = [pytest.mark.many_fits, pytest.mark.study]  # of fits, or of as many forward solves
PARTS = ("sorosim", "tendons", "elastica", "beam", "shapes")


def validate(folder: Path, **environment: str) -> tuple[str, dict]:
    """What the script prints, and its figures."""
    command = [sys.executable, str(ROOT / "scripts" / "validate.py"), "--quick", "--json", str(folder / "f.json")]
    done = subprocess.run(
        [*command, "--out", str(folder)], capture_output=True, text=True, check=False, env=os.environ | environment
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout, json.loads((folder / "f.json").read_text())


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("validation")
    return folder, *validate(folder)


def rows_of(data: dict, part: str) -> dict[tuple[str, str], dict]:
    """The rows of a part by reference and unit; skips where the part had no data."""
    if "skipped" in data[part]:
        pytest.skip(data[part]["skipped"])
    return {(row["reference"], row["unit"]): row for row in data[part]["rows"]}


def test_sorosim(run):
    rows = rows_of(run[2], "sorosim")
    assert [row["cases"] for row in rows.values()] == [250, 250, 10]
    for row in rows.values():
        assert row["worst"] < 7e-4
        assert row["median"] < 2e-4


def test_tendons(run):
    row = rows_of(run[2], "tendons")["C++ Rucker-Webster", "m"]
    assert row["cases"] == 19
    assert row["worst"] < 1.2e-4
    assert run[2]["tendons"]["fitted_m"] < 1e-6, "their shapes obey our equations"


def test_closed_forms_and_order(run):
    rows = rows_of(run[2], "elastica")
    for name in ("elastica, table", "elastica, elliptic integrals"):
        assert rows[name, "relative"]["worst"] < 1e-6
    assert rows["circle under a moment", "m"]["worst"] < 1e-9
    for name, slope in run[2]["elastica"]["slopes"].items():
        assert abs(slope - 4) < 0.2, name


def test_beam(run):
    assert rows_of(run[2], "beam")["motion capture, silicone beam", "m"]["cases"] == 12
    for name, figures in run[2]["beam"]["runs"].items():
        assert abs(figures["predicted_m"] - figures["measured_m"]) < 1e-3, name


def test_shapes(run):
    rows = rows_of(run[2], "shapes")
    assert rows["8th-order solver", "m"]["worst"] < 1e-6
    assert rows["8th-order solver", "N"]["worst"] < 2e-5
    assert rows["8th-order solver", "N m"]["worst"] < 2e-5


def test_page_and_pictures(run):
    folder, printed, data = run
    page = (folder / "validation.md").read_text()
    assert page in printed
    for part in PARTS:
        if "skipped" not in data[part]:
            assert f"(validation_{part}.png)" in page
            assert (folder / f"validation_{part}.png").stat().st_size > 5000


def test_missing_data_are_skipped_and_said(tmp_path):
    """With an empty data folder the parts that need third-party data say so, on the screen and on the page; the others run."""
    empty, out = tmp_path / "empty", tmp_path / "out"
    empty.mkdir()
    out.mkdir()
    printed, data = validate(out, TORCHROD_SHARED=str(empty))
    for part, folder in (("sorosim", "sorosim"), ("beam", "beam_mocap")):
        assert folder in data[part]["skipped"]
        for text in (printed, (out / "validation.md").read_text()):
            assert f"skipped: no folder third_party/{folder}" in text
    for part in ("tendons", "elastica", "shapes"):
        assert data[part]["rows"]
