"""The command line as a user meets it: the reference shapes, the files, and what it says of bad input."""

import csv
import io
import json
import math
import re
import runpy
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.conftest import reference
from tests.robots import csv_of, steel_rod, toml_of
from torchrod import (
    InputError,
    Markers,
    PointCoordinates,
    PointForces,
    Problem,
    Shapes,
    Unknowns,
    bounds,
    estimate,
    read_robot,
    read_shapes,
    solve_shape,
    write_shapes,
)
from torchrod.analysis.marker_placement import even_layout
from torchrod.cli import main
from torchrod.cli.parser import COMMANDS
from torchrod.cli.table import _pairs
from torchrod.plotting.observability import Layout, draw_observability
from torchrod.util.progress import bar

CASES = {case["name"]: case for case in reference("shape")}
ROD = toml_of(CASES["passive-point-0"]["robot"], "rod")
TENDON = toml_of(CASES["onetendon-point-0"]["robot"], "tendon robot")
SOFT = "[rod]\nlength = 0.4\nK_se = [1, 1, 1]\nK_bt = {K_bt}\n"
STRAIGHT = "s,x,y,z\n" + "".join(f"{0.1 * i:g},0,0,{0.1 * i:g}\n" for i in range(1, 5))


def run(folder: Path, robot: str, shapes: str, *options: str) -> dict:
    (folder / "robot.toml").write_text(robot)
    (folder / "shapes.csv").write_text(shapes)
    out = folder / "result.json"
    assert main(["estimate", str(folder / "robot.toml"), str(folder / "shapes.csv"), "--out", str(out), *options]) == 0
    return json.loads(out.read_text())


@pytest.mark.parametrize("name", CASES)
def test_every_reference_shape(tmp_path, name):
    """Shapes from an independent solver: single loads within 1 % and 1 mm, two within 2 % and 2 mm, Gaussians without a prior."""
    case = CASES[name]
    points = case["points"]
    prior = "point" if points else "none"
    options = ["--contacts", str(max(1, len(points))), "--noise", "1e-4", "--load-prior", prior]
    result = run(tmp_path, toml_of(case["robot"], name), csv_of(case), *options)
    assert result["robot"] == name
    (sample,) = result["results"]
    assert sample["status"] == "converged"
    assert sample["accepted"] is True
    truth = sorted((p["s"], math.hypot(p["fx"], p["fy"])) for p in points) or [(case["desc"]["mu"], case["desc"]["F"])]
    loads = sorted(sample["loads"], key=lambda load: load["location_m"])
    share, distance = (0.02, 2e-3) if len(points) != 1 else (0.01, 1e-3)
    for (s, force), load in zip(truth, loads, strict=True):
        size = load["magnitude_N"] if points else math.hypot(*load["net_force_local_N"])
        assert abs(size / force - 1) < share
        assert abs(load["location_m"] - s) < distance
        if not points:
            assert abs(load["width_m"] * math.sqrt(2 * case["desc"]["c"]) - 1) < 0.05
    assert np.allclose(sample["base_wrench"]["force_N"], case["base_wrench"][:3], atol=0.02)


def test_simulate_estimate_and_plot(tmp_path, capsys):
    """The three commands in a row, and a figure that is a picture."""
    robot, shape, result, figure = (str(tmp_path / n) for n in ("robot.toml", "shape.csv", "result.npz", "figure.png"))
    Path(robot).write_text(ROD)
    assert main(["simulate", robot, "--point", "0.25", "0.6", "-0.3", "--noise", "1e-4", "--seed", "3", "--out", shape]) == 0
    again = Path(shape).read_text()
    assert main(["simulate", robot, "--point", "0.25", "0.6", "-0.3", "--noise", "1e-4", "--seed", "3", "--out", shape]) == 0
    assert Path(shape).read_text() == again
    assert main(["estimate", robot, shape, "--noise", "1e-4", "--load-prior", "point", "--out", result, "--plot", figure]) == 0
    assert "0.67" in capsys.readouterr().out
    with np.load(result, allow_pickle=False) as arrays:
        assert np.allclose(arrays["force"][0, 0], [0.6, -0.3], atol=0.01)
    first = Path(figure).read_bytes()
    assert first[:8] == b"\x89PNG\r\n\x1a\n"
    assert main(["plot", robot, shape, result, "--out", figure]) == 0
    assert len(Path(figure).read_bytes()) > 20_000


def test_a_name_with_a_dollar_is_drawn(tmp_path, monkeypatch):
    """Matplotlib would take it for mathematics, and this for a mistake in it."""
    monkeypatch.chdir(tmp_path)
    name = "two $^_$ rods"
    Path("r.toml").write_text(toml_of(CASES["passive-point-0"]["robot"], name))
    Path("s.csv").write_text("sample,s,x,y,z\n" + "".join(f"{name},{0.1 * i:g},{1e-3 * i},0,{0.1 * i:g}\n" for i in range(1, 5)))
    assert main(["estimate", "r.toml", "s.csv", "--out", "e.json", "--plot", "e.png", "--steps", "10"]) == 0
    robot = read_robot("r.toml")
    s = even_layout(robot, 3)
    draw_observability("o.svg", [Layout(name, s, bounds(robot, s, 1e-3, 1.0))] * 2, 0.4, name)


def test_a_result_is_drawn_on_its_own_robot_and_shapes_only(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("r.toml").write_text(ROD)
    Path("other.toml").write_text(toml_of(CASES["passive-point-0"]["robot"], "other"))
    Path("s.csv").write_text(STRAIGHT)
    Path("fewer.csv").write_text(STRAIGHT.replace("0.1,0,0,0.1\n", ""))
    name = read_robot("r.toml").name
    for result in ("e.npz", "e.json"):
        assert main(["estimate", "r.toml", "s.csv", "--steps", "10", "--out", result]) == 0
        capsys.readouterr()
        assert main(["plot", "other.toml", "s.csv", result, "--out", "p.png"]) == 2
        expected = f"torchrod: {result}: is of robot {name!r}, not of 'other'; give the robot that was estimated\n"
        assert capsys.readouterr().err == expected
    for result in ("e.npz", "e.json"):
        assert main(["plot", "r.toml", "fewer.csv", result, "--out", "p.png"]) == 2
        assert "is of 4 markers, not of 3; give the shapes" in capsys.readouterr().err
    Path("e.json").write_text(Path("e.json").read_text().replace(f'"robot": "{name}", ', ""))
    assert main(["plot", "other.toml", "s.csv", "e.json", "--out", "p.png"]) == 0


def test_the_table_shows_two_digits_of_a_spread(tmp_path, capsys):
    """Of a push of 1 mN and of one of 1 N, in columns."""
    (tmp_path / "r.toml").write_text(ROD)
    robot, shape = str(tmp_path / "r.toml"), str(tmp_path / "s.csv")
    for force, pattern in (
        ("0.001", r"1 +0\.0010\d\d \+- 0\.0000\d\d +0\.00\d{4} +-?0\.000\d{3} "),
        ("1", r"1 +[01]\.\d{4} \+- 0\.\d{4} +[01]\.\d{4} +-?0\.\d{4} "),
    ):
        noise = "1e-6" if force == "0.001" else "1e-3"
        assert main(["simulate", robot, "--point", "0.2", force, "0", "--noise", noise, "--out", shape]) == 0
        capsys.readouterr()
        assert main(["estimate", robot, shape, "--noise", noise, "--steps", "20"]) == 0
        head, row = capsys.readouterr().out.splitlines()[:2]
        assert re.search(pattern, row), row
        assert len(head) == len(row)
    assert _pairs([1e-9, 2e-9], [1e-11, math.nan], 4) == ["1.000e-09 +- 1.000e-11", "2.000e-09 +- nan"]
    assert _pairs([2e-3], [math.nan], 4) == ["0.00200 +- nan"]
    assert _pairs([0.0], [0.0], 1) == ["0.0 +- 0.0"]


def test_auto_finds_no_load_on_a_straight_rod_and_one_on_a_pushed_one(tmp_path):
    """Two samples in one file: each decides for itself, and a missing marker is an empty cell."""
    pushed = CASES["passive-point-4"]
    rows = ["sample,s,x,y,z"]
    for i, (s, p) in enumerate(zip(pushed["s"], pushed["positions"], strict=True)):
        rows.append(f"straight,{s!r},0,0,{s!r}" if i != 3 else f"straight,{s!r},,,")
        rows.append(f"pushed,{s!r},{p[0]!r},{p[1]!r},{p[2]!r}")
    result = run(tmp_path, ROD, "\n".join(rows), "--contacts", "auto", "--noise", "1e-3", "--steps", "20")
    straight, bent = result["results"]
    assert (straight["sample"], bent["sample"]) == ("straight", "pushed")
    assert straight["loads"] == []
    assert len(bent["loads"]) == 1
    assert straight["accepted"]
    assert bent["accepted"]


@pytest.mark.many_fits
def test_the_hypothesis_of_an_npz_has_a_name(tmp_path):
    (tmp_path / "r.toml").write_text(ROD)
    (tmp_path / "s.csv").write_text(csv_of(CASES["passive-point-4"]))
    paths = [str(tmp_path / name) for name in ("r.toml", "s.csv")]
    for out in ("e.npz", "e.json"):
        options = ["--contacts", "auto", "--noise", "auto", "--steps", "20", "--out", str(tmp_path / out)]
        assert main(["estimate", *paths, *options]) == 0
    (record,) = json.loads((tmp_path / "e.json").read_text())["results"]
    with np.load(tmp_path / "e.npz", allow_pickle=False) as arrays:
        assert arrays["messages"][arrays["message"][0]] == record["message"]
        assert arrays["hypotheses"][arrays["hypothesis"][0]] == record["evidence"]["chosen"]
        told = list(record["evidence"]["bic"])
        assert [name for name in arrays["hypotheses"].tolist() if name in told] == told, "those that were tried, in their order"
        assert arrays["bic"].shape == arrays["bic_foreseen"].shape == (1, len(arrays["hypotheses"]))
        assert arrays["noise"].shape == arrays["noise_std"].shape == (1,)


def test_progress_is_drawn_on_a_terminal_only(monkeypatch):
    """Where stderr goes to a file, a bar would be thousands of lines."""
    with bar(3, "contacts") as shown:
        assert shown.disable
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(sys, "stderr", terminal)
    with bar(3, "contacts") as shown:
        assert not shown.disable


def test_python_m_is_the_command(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["torchrod", "estimate", "no.toml", "no.csv"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("torchrod", run_name="__main__")
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith("torchrod: no.toml: cannot be read")
    done = subprocess.run([sys.executable, "-m", "torchrod", "--version"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, f"torchrod {version('torchrod')}\n")


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_help_imports_neither_torch_nor_lightning(option):
    code = f"import sys; from torchrod.cli import main\ntry: main([{option!r}])\nexcept SystemExit: pass\n"
    code += "bad = {'torch', 'lightning', 'matplotlib', 'scipy'} & set(sys.modules); assert not bad, bad"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert ("estimate" if option == "--help" else version("torchrod")) in done.stdout


@pytest.mark.parametrize("command", COMMANDS)
def test_help_speaks_of_the_command_and_not_of_python(command):
    said = COMMANDS[command][0]().format_help()
    for word in ("lambda", "<", "%", "null", "None", "type:", "False"):
        assert word not in said, word
    if command == "estimate":
        assert "(default: contact)" in said and "(default: 100)" in said


def npz(path: Path, **arrays) -> None:
    np.savez(path, **arrays)


BAD = {
    "missing robot": (None, STRAIGHT, [], "robot.toml: cannot be read"),
    "missing shapes": (ROD, None, [], "shapes.csv: no such file"),
    "not toml": ("length = = 3", STRAIGHT, [], "(Invalid value (at line 1, column 10)); correct that place"),
    "name": ("name = [1, 2]\n" + ROD.split("\n", 1)[1], STRAIGHT, [], "robot.toml: name is [1, 2]; it must be a text"),
    "no rod": ("name = 'x'", STRAIGHT, [], "has no [rod] table"),
    "unknown key": (ROD.replace("diameter", "diametre"), STRAIGHT, [], "unknown key 'diametre'; is it diameter? known keys"),
    "missing key": (ROD.replace("diameter", "#"), STRAIGHT, [], "rod.diameter is missing"),
    "negative number": (ROD.replace("diameter = ", "diameter = -"), STRAIGHT, [], "must be positive"),
    "infinite number": (ROD.replace("youngs_modulus = 207000000000.0", "youngs_modulus = inf"), STRAIGHT, [], "must be finite"),
    "text for a number": (ROD.replace("diameter = 0.0014", "diameter = 'thin'"), STRAIGHT, [], "must be a number"),
    "bad gravity": (ROD + "gravity = [0, 9.81]\n", STRAIGHT, [], "a list of 3 numbers"),
    "tendon past the tip": (TENDON.replace("ends_at = 0.4", "ends_at = 0.5"), STRAIGHT, [], "beyond the rod's length"),
    "empty file": (ROD, "", [], "is empty"),
    "header only": (ROD, "s,x,y,z\n", [], "no rows"),
    "no z": (ROD, "s,x,y\n0.1,0,0\n", [], "column 'z' is missing"),
    "column twice": (ROD, "s,x,y,z,z\n0.1,0,0,0.1,0.1\n", [], "column 'z' stands twice"),
    "column misspelt": (
        ROD,
        "s,x,y,z,base_f_x\n0.1,0,0,0.1,0\n",
        [],
        "unknown column 'base_f_x'; if it is 'base_fx', call it that",
    ),
    "gravity above [rod]": ("gravity = [0, 0, -9.81]\n" + ROD, STRAIGHT, [], "gravity stands outside of [rod]; put it below"),
    "Poisson's ratio": (ROD + "poisson_ratio = 0.3\n", STRAIGHT, [], "give shear_modulus = E / (2 (1 + nu))"),
    "thicker than long": (ROD.replace("0.0014", "1.4"), STRAIGHT, [], "1.4 m across, more than the rod's length"),
    "a rod that is none": ("rod = 5\n", STRAIGHT, [], "rod must be a table of keys"),
    "a turn in degrees": (ROD + "[base]\nrotation = [0, 90, 0]\n", STRAIGHT, [], "turns by 90 rad, more than once around"),
    "half a rotation": (ROD, "s,x,y,z,qx,qw\n0.1,0,0,0.1,0,1\n", [], "column 'qy' is missing; qx,qy,qz,qw come together"),
    "no rotation": (ROD, "s,x,y,z,qx,qy,qz,qw\n0.1,0,0,0.1,0,0,0,2\n", [], "a rotation is a unit quaternion"),
    "text in a cell": (ROD, STRAIGHT + "0.4,a,0,0\n", [], "line 6, column x: 'a' is not a number"),
    "short line": (ROD, STRAIGHT + "0.4,1\n", [], "line 6 has 2 cells"),
    "s outside": (ROD, STRAIGHT + "0.5,0,0,0.5\n", [], "outside the rod"),
    "s not increasing": (ROD, STRAIGHT + "0.3,0,0,0.3\n", [], "s increases"),
    "s missing": (ROD, STRAIGHT + ",0,0,0.3\n", [], "column s: must be a finite number"),
    "millimetres": (ROD, "s,x,y,z\n" + "".join(f"{0.1 * i:g},0,0,{100 * i}\n" for i in range(1, 5)), [], "give metres"),
    "too few markers": (ROD, "s,x,y,z\n0.4,0,0,0.4\n", [], "add markers"),
    "no tensions": (TENDON, STRAIGHT, [], "tensions are missing"),
    "tensions of a passive rod": (ROD, "s,x,y,z,tension_1\n0.2,0,0,0.2,1\n0.4,0,0,0.4,1\n", [], "leave them out, or add a"),
    "tensions that change": (TENDON, "s,x,y,z,tension_1\n0.2,0,0,0.2,1\n0.4,0,0,0.4,2\n", [], "differ from row to row"),
    "noise": (ROD, STRAIGHT, ["--noise", "-1"], "--noise is -1.0"),
    "noise is a word": (ROD, STRAIGHT, ["--noise", "much"], "much"),
    "contacts": (ROD, STRAIGHT, ["--contacts", "many"], "must be auto or a number"),
    "prior": (ROD, STRAIGHT, ["--load-prior", "wide"], "wide"),
    "location": (ROD, STRAIGHT, ["--location", "0.7"], "must lie on the rod"),
    "output folder": (ROD, STRAIGHT, ["--out", "/no/such/folder/r.json"], "create it first"),
    "output suffix": (ROD, STRAIGHT, ["--out", "result.txt"], "end in .json or .npz"),
    "figure suffix": (ROD, STRAIGHT, ["--plot", "figure.xyz"], "end in .png"),
    "output is a folder": (ROD, STRAIGHT, ["--out", "folder.json"], "is a folder"),
    "checkpoint": (ROD, STRAIGHT, ["--warm-start", "x.safetensors"], "torchrod: x.safetensors: no such file"),
    "noise below round-off": (ROD, STRAIGHT, ["--noise", "1e-200"], "from 1e-9 to 1"),
    "locations twice": (ROD, STRAIGHT, ["--location", "0.2", "0.2"], "give it once"),
    "locations and contacts": (
        ROD,
        STRAIGHT,
        ["--contacts", "1", "--location", "0.1", "0.2"],
        "--location names 2 places; give one place per load",
    ),
    "huge number": (ROD.replace("length = 0.4", "length = " + "1" * 400), STRAIGHT, [], "must be finite"),
    "asymmetric stiffness": (
        SOFT.format(K_bt="[[1e-9, 5e-10, 0], [0, 1e-9, 0], [0, 0, 1e-9]]"),
        STRAIGHT,
        [],
        "symmetric positive",
    ),
    "two sections": (SOFT.format(K_bt="[1, 1, 1]") + "diameter = 0.001\n", STRAIGHT, [], "either the stiffnesses or"),
    "two rows of stiffness": (
        SOFT.format(K_bt="[[1, 0, 0], [0, 1, 0]]"),
        STRAIGHT,
        [],
        "must be symmetric positive definite, in N (K_se) or N m^2 (K_bt)",
    ),
    "short curvature": (ROD + "reference_curvature = [1, 2]\n", STRAIGHT, [], "[1, 2]; it must be a list of 3 numbers"),
    "short routing": (
        TENDON.replace("offset = [0.007, 0.0]", "routing = [[0.1, 0.007, 0], [0.2, 0.007, 0]]"),
        STRAIGHT,
        [],
        "must cover 0",
    ),
    "negative tension": (TENDON, "s,x,y,z,tension_1\n0.2,0,0,0.2,-1\n0.4,0,0,0.4,-1\n", [], "can only pull"),
    "offset twice": (
        ROD,
        "s,x,y,z,rx,ry,rz\n" + "".join(f"0.2,0,0,0.2,{r},0,0\n" for r in (0, 1, 0)),
        [],
        "two markers at s = 0.2",
    ),
    "blank lines": (ROD, "s,x,y,z\n\n\n0.1,q,0,0\n", [], "line 4, column x"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_line_and_exit_2(tmp_path, capsys, monkeypatch, name):
    robot, shapes, options, words = BAD[name]
    monkeypatch.chdir(tmp_path)
    Path("folder.json").mkdir()
    for file, content in (("robot.toml", robot), ("shapes.csv", shapes)):
        if content is not None:
            Path(file).write_text(content)
    assert main(["estimate", "robot.toml", "shapes.csv", *options]) == 2
    captured = capsys.readouterr()
    assert words in captured.err
    assert captured.err.count("\n") == 1, captured.err
    assert captured.out == ""


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        (dict(s=np.array([0.1, 0.2]), positions=np.array([[{}, {}]], dtype=object)), "plain numbers"),
        (dict(s=np.array([0.1, 0.2])), "'positions' is missing"),
        (dict(s=np.array([0.1, 0.2]), positions=np.zeros((3, 3))), "expected (B, P, 3)"),
        (dict(s=np.array([0.1, 0.2]), positions=np.zeros((1, 2, 3)), offset=np.zeros((2, 3))), "unknown array 'offset'"),
        (dict(s=np.array([0.1, 0.2]), positions=np.full((1, 2, 3), np.inf)), "only positions may be NaN"),
        (dict(s=np.array([0.1, 0.2]), positions=np.zeros((1, 2, 3)), offsets=np.zeros((3, 3))), "expected (P, 3)"),
        (dict(s=np.array([0.1, 0.1]), positions=np.zeros((1, 2, 3))), "two markers at s = 0.1"),
        (dict(s=np.array(["a", "b"]), positions=np.zeros((1, 2, 3))), "does not hold numbers"),
        (dict(s=np.zeros(0), positions=np.zeros((1, 0, 3))), "holds no marker"),
        (dict(s=np.array([0.1, 0.2]), positions=np.zeros((0, 2, 3))), "holds no marker"),
        (dict(s=np.array([0.1, 0.400001]), positions=np.zeros((1, 2, 3))), "outside the rod"),
        (dict(s=np.array([0.1, np.nan]), positions=np.zeros((1, 2, 3))), "not finite"),
    ],
)
def test_bad_npz(tmp_path, capsys, arrays, words):
    (tmp_path / "robot.toml").write_text(ROD)
    npz(tmp_path / "shapes.npz", **arrays)
    assert main(["estimate", str(tmp_path / "robot.toml"), str(tmp_path / "shapes.npz")]) == 2
    captured = capsys.readouterr()
    assert words in captured.err
    assert captured.err.count("\n") == 1


def test_the_tip_in_single_precision_is_the_tip(tmp_path):
    """0.3 m is 0.30000001 there; from a file and in the library."""
    (tmp_path / "r.toml").write_text(ROD.replace("length = 0.4", "length = 0.3"))
    robot, s = read_robot(tmp_path / "r.toml"), np.linspace(0.1, 0.3, 5, dtype=np.float32)
    assert float(s[-1]) > 0.3
    npz(tmp_path / "s.npz", s=s, positions=np.stack([0 * s, 0 * s, s], -1)[None])
    shapes = read_shapes(tmp_path / "s.npz", robot)
    assert float(shapes.s[-1]) == 0.3
    unknowns = Unknowns(PointCoordinates(1, 0.3, robot.rod.force_scale))
    seen = [Markers(x, shapes.positions, 1e-3) for x in (shapes.s, torch.from_numpy(s.astype(float)))]
    exact, beyond = (estimate(Problem(robot, unknowns, [markers], steps=10)) for markers in seen)
    assert beyond.accepted.all()
    assert torch.allclose(exact.base_wrench, beyond.base_wrench, atol=1e-6)


def test_a_rod_of_400_metres_gets_a_warning_and_an_answer(tmp_path, capsys):
    robot = ROD.replace("length = 0.4", "length = 400.0").replace("diameter = 0.0014", "diameter = 1.4")
    shapes = "s,x,y,z\n" + "".join(f"{100 * i},0,0,{100 * i}\n" for i in range(1, 5))
    run(tmp_path, robot, shapes, "--noise", "0.1", "--steps", "10")
    assert "are the units metres?" in capsys.readouterr().err


def test_simulate_refuses_what_it_cannot_do(tmp_path, capsys):
    (tmp_path / "r.toml").write_text(TENDON)
    robot, out = str(tmp_path / "r.toml"), str(tmp_path / "s.csv")
    for options, words in (
        ([], "give one per tendon"),
        (["--tension", "1", "--seed", "-1"], "from 0 to 2^63"),
        (["--tension", "1", "--out", str(tmp_path / "s.npz")], "end in .csv"),
        (["--tension", "-1"], "at least 0 N"),
        (["--tension", "1", "--displacement", "0.001"], "give one of them"),
        (["--displacement", "0.001", "0.001"], "give one per tendon"),
        (["--displacement", ".nan"], "must be finite"),
        (["--tension", "1", "--at", "0.1", "0.9"], "lie on the rod"),
        (["--tension", "1", "--at", "0.1", "--markers", "5"], "--markers and --at both say"),
        (["--tension", "1", "--markers", "0"], "from 1 to 10000"),
        (["--tension", "1", "--point", "0.1", "x", "0"], "three numbers"),
        (["--tension", "1", "--point", "0.9", "1", "0"], "must lie on the rod"),
    ):
        assert main(["simulate", robot, "--out", out, *options]) == 2
        assert words in capsys.readouterr().err
    assert not Path(out).exists()


def test_a_displaced_tendon_is_simulated_with_its_tension(tmp_path, capsys):
    """What --displacement writes, tensions included, is what --tension makes of those tensions."""
    (tmp_path / "r.toml").write_text(TENDON)
    robot, one, two = (str(tmp_path / name) for name in ("r.toml", "one.csv", "two.csv"))
    assert main(["simulate", robot, "--displacement", "0.004", "--out", one]) == 0
    tension = Path(one).read_text().splitlines()[1].split(",")[-1]
    assert main(["simulate", robot, "--tension", tension, "--out", two]) == 0
    first, second = ([[float(v) for v in r.split(",")] for r in Path(f).read_text().splitlines()[1:]] for f in (one, two))
    assert max(abs(x - y) for a, b in zip(first, second, strict=True) for x, y in zip(a, b, strict=True)) < 1e-7
    assert float(tension) > 0
    assert "tensions" in capsys.readouterr().out


def test_tension_columns_are_taken_by_their_number(tmp_path):
    """tension_2 before tension_1 in the header, and names that look like numbers kept as they are."""
    case = CASES["twotendon-point-1"]
    rows = ["sample,s,tension_2,tension_1,x,y,z"]
    for s, p in zip(case["s"], case["positions"], strict=True):
        rows.append(",".join(["007", *(repr(v) for v in [s, case["tensions"][1], case["tensions"][0], *p])]))
    (sample,) = run(tmp_path, toml_of(case["robot"]), "\n".join(rows), "--noise", "1e-4", "--load-prior", "point")["results"]
    assert sample["sample"] == "007"
    assert sample["accepted"]
    assert abs(sample["loads"][0]["location_m"] - case["points"][0]["s"]) < 1e-3


def test_a_sample_without_markers_is_invalid_whatever_the_count(tmp_path, capsys):
    for count in ("0", "1", "auto"):
        shapes = "s,x,y,z\n" + "".join(f"{0.1 * i:g},,,\n" for i in range(1, 5))
        (sample,) = run(tmp_path, ROD, shapes, "--contacts", count, "--plot", str(tmp_path / "f.png"))["results"]
        assert sample["status"] == "invalid"
        assert sample["accepted"] is False
    assert "not written" in capsys.readouterr().err


@pytest.mark.parametrize("content", [b"PK\x03\x04 broken", b"\x93NUMPY\x01\x00", b"\xff\xfe\x00", b""])
def test_damaged_binary_files_are_refused(tmp_path, capsys, content):
    (tmp_path / "r.toml").write_text(ROD)
    (tmp_path / "ok.csv").write_text(STRAIGHT)
    (tmp_path / "bad.npz").write_bytes(content)
    robot, bad = str(tmp_path / "r.toml"), str(tmp_path / "bad.npz")
    assert main(["estimate", robot, bad]) == 2
    assert main(["plot", robot, str(tmp_path / "ok.csv"), bad, "--out", str(tmp_path / "f.png")]) == 2
    assert capsys.readouterr().err.count("\n") == 2


IDLE = {
    "--noise": (["--noise", "1e-3"], "states the noise of every position, sx"),
    "--angle-noise": (["--angle-noise", "0.01"], "has no orientations qx,qy,qz,qw"),
    "--curvature-noise": (["--curvature-noise", "1"], "has no curvatures kx,ky"),
    "--base-noise": (["--base-noise", "1", "1"], "has no base wrenches base_fx, .."),
    "--tension-std": (["--tension-std", "1"], "has no tendons"),
    "--load-prior": (["--load-prior", "point", "--contacts", "0"], "--contacts 0 leaves no load"),
    "--intervals sampled": (
        ["--intervals", "sampled", "--registration", "--one-frame"],
        "the error of a base frame that all share",
    ),
    "--profile on": (["--profile", "on"], "only RESULT.json and RESULT.npz have profiles"),
}


@pytest.mark.parametrize("option", IDLE)
def test_options_with_nothing_to_act_on_are_told(tmp_path, capsys, monkeypatch, option):
    """Each in one line, and none of them is told where there is something."""
    monkeypatch.chdir(tmp_path)
    given, why = IDLE[option]
    rows = STRAIGHT.splitlines()
    text = [rows[0] + (",sx" * (option == "--noise")), *(row + (",0.001" * (option == "--noise")) for row in rows[1:])]
    (tmp_path / "robot.toml").write_text(ROD)
    (tmp_path / "shapes.csv").write_text("\n".join(text))
    assert main(["estimate", "robot.toml", "shapes.csv", "--steps", "5", *given]) == 0
    said = capsys.readouterr().err
    assert f"warning: {option} has no effect: " in said and why in said and said.count("\n") == 1
    assert main(["estimate", "robot.toml", "shapes.csv", "--steps", "5", "--contacts", "0"]) == 0
    assert "no effect" not in capsys.readouterr().err


def test_the_intervals_are_the_same_whatever_is_written(tmp_path, capsys, monkeypatch):
    """Of draws by default, in the table, in LOADS.csv and in RESULT.json; of a weak push the covariance's are others."""
    monkeypatch.chdir(tmp_path)
    Path("r.toml").write_text(ROD)
    s = torch.linspace(0.02, 0.4, 20, dtype=torch.float64)
    push = PointForces(torch.tensor([[[0.15, 0.0, 0.0]]]), torch.tensor([[0.06]]))
    p = solve_shape(read_robot("r.toml"), (push,), None, s, 1).p
    write_shapes("s.csv", Shapes(s, p + 1e-3 * torch.randn(p.shape, generator=torch.Generator().manual_seed(1)), ["0"]))
    tables = []
    for out in ([], ["--out", "r.csv"], ["--out", "r.json"]):
        assert main(["estimate", "r.toml", "s.csv", "--noise", "1e-3", *out]) == 0
        tables.append(capsys.readouterr().out)
    assert tables[0] == tables[1] == tables[2]
    (row,) = csv.DictReader(Path("r.csv").read_text().splitlines())
    (load,) = json.loads(Path("r.json").read_text())["results"][0]["loads"]
    ends = [float(row[f"magnitude_{end}_N"]) for end in ("low", "high")]
    assert ends == load["interval_95"]["magnitude_N"]
    assert f"+- {(ends[1] - ends[0]) / 3.92:.2f}" in tables[0]
    assert abs((ends[1] - ends[0]) / 3.92 - float(row["magnitude_std_N"])) > 0.1 * float(row["magnitude_std_N"])


def test_the_row_of_a_force_at_the_tip_says_how_well_it_is_known(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("r.toml").write_text(ROD)
    s = torch.linspace(0.02, 0.4, 20, dtype=torch.float64)
    push = PointForces(torch.tensor([[[0.6, 0.2, 0.0]]]), torch.tensor([[0.4]]))
    write_shapes("s.csv", Shapes(s, solve_shape(read_robot("r.toml"), (push,), None, s, 1).p, ["0"]))
    for out in ("r.csv", "r.npz"):
        assert (
            main(["estimate", "r.toml", "s.csv", "--noise", "1e-3", "--contacts", "0", "--unknown-tip", "force", "--out", out]) == 0
        )
    (row,) = csv.DictReader(Path("r.csv").read_text().splitlines())
    with np.load("r.npz") as fit:
        F, C = fit["tip"][0, :3], fit["tip_covariance"][0, :3, :3]
    assert row["load"] == "tip" and float(row["magnitude_std_N"]) == pytest.approx(math.sqrt(F @ C @ F) / float(np.linalg.norm(F)))


def test_gravity_in_another_unit_is_told(tmp_path):
    (tmp_path / "r.toml").write_text(ROD + "mass_per_length = 0.01\ngravity = [0, 0, -9810]\n")
    with pytest.warns(UserWarning, match=r"rod.gravity is \[0.0, 0.0, -9810.0\]; give it in m/s\^2"):
        read_robot(tmp_path / "r.toml")


def test_one_sample_of_an_npz_is_a_batch_of_one(tmp_path):
    np.savez(tmp_path / "s.npz", s=np.linspace(0.1, 0.4, 10), positions=np.zeros((10, 3)))
    with pytest.raises(InputError, match=r"has shape \(10, 3\); expected \(B, P, 3\) with P = 10; one sample has B = 1"):
        read_shapes(tmp_path / "s.npz", steel_rod())


def test_a_table_of_loads_is_not_drawn(tmp_path, capsys):
    run(tmp_path, ROD, STRAIGHT, "--steps", "5", "--contacts", "0")
    names = [str(tmp_path / name) for name in ("robot.toml", "shapes.csv", "loads.csv", "f.png")]
    assert main(["plot", *names[:3], "--out", names[3]]) == 2
    assert "a table of loads lacks what a figure needs; write RESULT.json by estimate --out" in capsys.readouterr().err


def test_what_an_unknown_wrench_at_the_tip_hides_is_said(tmp_path, capsys):
    """Where a push is told beside it, and not beside a force, nor where nothing pushes."""
    shapes = "s,x,y,z\n" + "".join(f"{s:.2f},{0.3 * s * s},0,{s - 0.06 * s**3}\n" for s in (0.05 * i for i in range(1, 9)))
    for options, said in (
        (("--unknown-tip", "wrench"), True),
        (("--unknown-tip", "force"), False),
        (("--unknown-tip", "wrench", "--contacts", "0"), False),
        (("--unknown-tip", "wrench", "--location", "0.2"), False),
    ):
        run(tmp_path, ROD, shapes, *options)
        assert ("hides much of it" in capsys.readouterr().out) == said, options


def test_the_table_shows_the_intervals_of_the_result(tmp_path, capsys):
    """+- is a 95 % interval's width over 3.92: of draws, which RESULT holds, not of the covariance. Of markers far better than
    their stated noise there is a word.
    """
    s = torch.linspace(0.02, 0.4, 20, dtype=torch.float64)
    push = PointForces(torch.tensor([[[0.5, 0.2, 0.0]]]), torch.tensor([[0.22]]))
    p = solve_shape(steel_rod(), (push,), None, s, 1).p[0]
    p = p + 1e-3 * torch.randn(p.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    rows = [f"{at},{x},{y},{z}\n" for at, (x, y, z) in zip(s.tolist(), p.tolist(), strict=True)]
    ratios = []
    for noise, generous in (("1e-3", False), ("5e-3", True)):
        result = run(tmp_path, ROD, "s,x,y,z\n" + "".join(rows), "--noise", noise, "--load-prior", "auto")
        said = capsys.readouterr().out
        (load,) = result["results"][0]["loads"]
        cells = said.splitlines()[1].split()
        low, high = load["interval_95"]["location_m"]
        shown = float(cells[cells.index("+-", cells.index("+-") + 1) + 1])
        assert shown == pytest.approx(1e3 * (high - low) / 3.92, rel=0.06, abs=0.06)
        assert ("the readings are better than their stated noise" in said) == generous
        ratios.append((high - low) / 3.92 / load["std"]["location_m"])
    assert max(abs(ratio - 1) for ratio in ratios) > 0.15  # the covariance says something else


def test_where_loads_may_be_spread_is_said(tmp_path, capsys):
    case = CASES["passive-point-0"]
    for options, word in (((), True), (("--load-prior", "auto"), False), (("--location", "0.2"), False)):
        run(tmp_path, ROD, csv_of(case), "--noise", "1e-4", *options)
        assert ("where one may be spread along the rod, try --load-prior auto" in capsys.readouterr().out) == word
