"""Markers in a wrong unit, frame or order, through the command line: a reason to act on, and the rest of the batch goes on."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.conftest import reference
from tests.robots import toml_of
from torchrod import Markers
from torchrod.cli import main
from torchrod.model.marker_geometry import misplaced, too_far, unit_hint

CASE = next(c for c in reference("shape") if c["name"] == "passive-point-1")
GOOD = [[s, *p] for s, p in zip(CASE["s"], CASE["positions"], strict=True)]
LAST = len(GOOD) - 1

WRONG = {
    "no marker": ([[s, "", "", ""] for s, *_ in GOOD], "No marker was seen"),
    "one marker": (GOOD[9:10], "Only one marker was seen: a contact needs at least two"),
    "one of many": ([row if i == LAST else [row[0], "", "", ""] for i, row in enumerate(GOOD)], "Only one marker was seen"),
    "wrong side": ([[s, x, y, -z] for s, x, y, z in GOOD], "leaves the base along -z, but the rod leaves it along +z"),
    "other axis": ([[s, z, y, x] for s, x, y, z in GOOD], "leaves the base along +x"),
    "millimetres": ([[s, 1e3 * x, 1e3 * y, 1e3 * z] for s, x, y, z in GOOD], "are they in millimetres? give metres"),
    "centimetres": ([[s, 1e2 * x, 1e2 * y, 1e2 * z] for s, x, y, z in GOOD], "are they in centimetres? give metres"),
    "too small": ([[s, 1e-3 * x, 1e-3 * y, 1e-3 * z] for s, x, y, z in GOOD], "give positions in metres"),
    "s too small": ([[1e-3 * s, x, y, z] for s, x, y, z in GOOD], "give the arc lengths s in metres"),
    "from the tip": ([[GOOD[LAST - i][0], *row[1:]] for i, row in enumerate(GOOD)][::-1], "count s from the base to the tip"),
    "other origin": ([[s, x + 0.3, y, z] for s, x, y, z in GOOD], "whose origin is where the rod leaves the base"),
    "inches": ([[s, 39.37 * x, 39.37 * y, 39.37 * z] for s, x, y, z in GOOD], "are they in inches? give metres"),
    "one in millimetres": (
        [[s, 1e3 * x, 1e3 * y, 1e3 * z] if i == 7 else [s, x, y, z] for i, (s, x, y, z) in enumerate(GOOD)],
        f"(s = {1e3 * GOOD[7][0]:.4g} mm): up to 155 m from the others",
    ),
}
REFUSED = {
    "millimetres": (WRONG["millimetres"][0], "on a rod of 0.4 m; are they in millimetres? give metres"),
    "s in millimetres": ([[1e3 * row[0], *row[1:]] for row in GOOD], "is it in millimetres? give metres"),
    "s in kilometres": ([[1e-3 * row[0], *row[1:]] for row in GOOD], "the markers end at s = 0.0004 m of a rod of 0.4 m"),
    "all in kilometres": ([[1e-3 * v for v in row] for row in GOOD], "are the file and the robot's length in the same unit?"),
    "camera frame": ([[s, x + 1.5, y, z] for s, x, y, z in GOOD], "the unit fits, so give them in the robot's base frame"),
    "camera frame, millimetres": ([[s, 1e3 * x - 900, 1e3 * y, 1e3 * z + 700] for s, x, y, z in GOOD], "are they in millimetres?"),
    "the same s twice": ([*GOOD[:5], GOOD[4], *GOOD[5:]], "two markers at s = 0.1 m; keep one"),
    "one marker": (GOOD[9:10], "a single marker cannot tell a contact and its place; add markers or"),
}


def write(folder: Path, samples: dict[str, list[list]]) -> list[str]:
    (folder / "robot.toml").write_text(toml_of(CASE["robot"], "rod"))
    rows = [",".join([name, *map(str, row)]) for name, sample in samples.items() for row in sample]
    (folder / "shapes.csv").write_text("\n".join(["sample,s,x,y,z", *rows]) + "\n")
    return [str(folder / "robot.toml"), str(folder / "shapes.csv")]


@pytest.mark.parametrize("contacts", ["1", "auto"])
@pytest.mark.many_fits
def test_a_sequence_of_wrong_samples_leaves_the_good_ones_alone(tmp_path, capsys, contacts):
    samples = {"before": GOOD} | {name: rows for name, (rows, _) in WRONG.items()} | {"after": GOOD}
    out = str(tmp_path / "result.json")
    assert main(["estimate", *write(tmp_path, samples), "--contacts", contacts, "--warm-start", "off", "--out", out]) == 0
    first, *wrong, last = json.loads(Path(out).read_text())["results"]
    report = capsys.readouterr().out
    for name, record in zip(WRONG, wrong, strict=True):
        assert not record["accepted"], name
        assert WRONG[name][1] in record["message"], name
        assert record["message"] in report, name
        assert record["suspect_markers"] == [], name
    (truth,) = CASE["points"]
    for record in (first, last):
        assert record["accepted"]
        assert record["message"] == "Converged."
        assert abs(record["loads"][0]["location_m"] - truth["s"]) < 2e-3
        assert abs(record["loads"][0]["magnitude_N"] - math.hypot(truth["fx"], truth["fy"])) < 0.02
    assert first["loads"] == last["loads"]


@pytest.mark.parametrize("name", REFUSED)
def test_a_file_without_a_usable_sample_is_refused(tmp_path, capsys, name):
    rows, words = REFUSED[name]
    assert main(["estimate", *write(tmp_path, {"0": rows})]) == 2
    captured = capsys.readouterr()
    assert words in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""


def test_a_bent_rod_is_not_misplaced():
    """Every reference shape, also with its base frame off by 5 mm, and with half of its markers."""
    for case in reference("shape"):
        z = torch.tensor([case["positions"], case["positions"]]) + 3e-3
        markers = Markers(torch.tensor(case["s"]), z, 1e-3)
        z[1, ::2] = torch.nan
        for b in (0, 1):
            assert misplaced(markers, b, case["robot"]["length"]) == "", case["name"]
    assert "another unit or frame" in unit_hint(1e7)


def test_the_unit_is_told_however_the_rod_is_bent():
    """Every reference shape in every unit: by the distance of neighbours, so that a rod bent into its own base is told as well."""
    for case in reference("shape"):
        z, s = torch.tensor([case["positions"]]), torch.tensor(case["s"])
        for factor, name in ((1e6, "micrometres"), (1e3, "millimetres"), (1e2, "centimetres"), (39.37, "inches")):
            assert f"are they in {name}?" in too_far(Markers(s, factor * z, 1e-3), case["robot"]["length"]), case["name"]
        assert too_far(Markers(s, z, 1e-3), case["robot"]["length"]) == ""


@pytest.mark.parametrize("options", [["--contacts", "2"], ["--contacts", "auto"], ["--contacts", "auto", "--noise", "auto"]])
@pytest.mark.many_fits
def test_too_few_markers_are_invalid_and_the_rest_go_on(tmp_path, options):
    """No marker, and one that has been moved: no count of contacts and no noise can be told from them, auto or not."""
    one = [row if i == LAST else [row[0], "", "", ""] for i, row in enumerate(GOOD)]
    out = tmp_path / "result.json"
    files = write(tmp_path, {"good": GOOD, "none": WRONG["no marker"][0], "one": one})
    assert main(["estimate", *files, *options, "--out", str(out)]) == 0
    good, *rest = json.loads(out.read_text())["results"]
    assert good["status"] == "converged"
    assert good["accepted"]
    for record, words in zip(rest, ("No marker was seen", "Only one marker was seen"), strict=True):
        assert record["status"] == "invalid"
        assert not record["accepted"]
        assert words in record["message"]


@pytest.mark.parametrize("options", [[], ["--contacts", "auto"]])
def test_npz_is_refused_as_csv_is(tmp_path, capsys, options):
    (tmp_path / "robot.toml").write_text(toml_of(CASE["robot"], "rod"))
    for name, (rows, words) in REFUSED.items():
        s, p = np.array([row[0] for row in rows]), np.array([[row[1:] for row in rows]])
        np.savez(tmp_path / "shapes.npz", s=s, positions=p)
        assert main(["estimate", str(tmp_path / "robot.toml"), str(tmp_path / "shapes.npz"), *options]) == 2, name
        captured = capsys.readouterr()
        assert words in captured.err
        assert captured.err.count("\n") == 1


def test_noise_in_millimetres_is_refused(tmp_path, capsys):
    assert main(["estimate", *write(tmp_path, {"0": GOOD}), "--noise", "0.5"]) == 2
    assert "it is in metres: 1 mm is 1e-3" in capsys.readouterr().err


def test_coordinates_too_large_to_add_are_no_markers():
    """Once a traceback, of an empty median: 29 of 10,000 damaged files."""
    s = torch.tensor([0.1, 0.2, 0.3])
    whole = torch.full((1, 3, 3), 1e308, dtype=torch.float64)
    assert too_far(Markers(s, whole, 1e-3), 0.4) == ""
    whole[0, 0] = 1e4
    assert "1e+04 m" in too_far(Markers(s, whole, 1e-3), 0.4)
