"""Markers in a wrong unit, frame or order, through the command line: a reason to act on, and the rest of the batch goes on."""

import json
import math
from pathlib import Path

import pytest
import torch

from tests.conftest import reference
from tests.robots import toml_of
from torchrod import Markers
from torchrod.cli import main
from torchrod.geometry import misplaced, unit_hint

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
}
REFUSED = {
    "millimetres": (WRONG["millimetres"][0], "on a rod of 0.4 m; are they in millimetres? give metres"),
    "s in millimetres": ([[1e3 * row[0], *row[1:]] for row in GOOD], "is it in millimetres? give metres"),
    "the same s twice": ([*GOOD[:5], GOOD[4], *GOOD[5:]], "two markers at s = 0.1 m; keep one"),
    "one marker": (GOOD[9:10], "1 marker cannot determine 4 unknowns; add markers"),
}


def write(folder: Path, samples: dict[str, list[list]]) -> list[str]:
    (folder / "robot.toml").write_text(toml_of(CASE["robot"], "rod"))
    rows = [",".join([name, *map(str, row)]) for name, sample in samples.items() for row in sample]
    (folder / "shapes.csv").write_text("\n".join(["sample,s,x,y,z", *rows]) + "\n")
    return [str(folder / "robot.toml"), str(folder / "shapes.csv")]


@pytest.mark.parametrize("contacts", ["1", "auto"])
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
        markers = Markers(torch.tensor(case["s"]), z)
        z[1, ::2] = torch.nan
        for b in (0, 1):
            assert misplaced(markers, b, case["robot"]["length"]) == "", case["name"]
    assert "another unit or frame" in unit_hint(1e7)
