"""What readers take, and what becomes of files that are damaged: an answer, or one sentence, and never a traceback."""

import io
import json
import math
import random
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from studies import fuzz

from tests.robots import steel_rod
from torchrod import Markers, Robot, Rod, Shapes, Tendon, Tendons, read_robot, read_shapes, write_shapes
from torchrod.cli import main
from torchrod.io import read_fit
from torchrod.io.npz_file import UNREADABLE, read_arrays
from torchrod.learned.network import load_checkpoint, numbers_in
from torchrod.model.marker_geometry import misplaced
from torchrod.util.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "docs" / "example"
ROD = (EXAMPLE / "rod.toml").read_text()
GOOD = [(0.1 * i, 0.01 * i, -0.002 * i, 0.0999 * i) for i in range(1, 5)]
NAMES = st.text(st.characters(exclude_categories=["Cs", "Cc"]) | st.sampled_from('#;,\t"\n'), min_size=1, max_size=8)


def shapes_of(text: str | bytes, folder: Path, robot: Robot | None = None) -> Shapes:
    path = folder / "shapes.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_shapes(path, robot or steel_rod())


@given(
    mark=st.sampled_from([",", ";", "\t", "; ", ",\t"]),
    comma=st.booleans(),
    upper=st.booleans(),
    end=st.sampled_from(["\n", "\r\n"]),
    remarks=st.lists(st.sampled_from(["# a remark; with, marks", "  # 1,2,3,4", "#", ""]), max_size=4),
    name=st.sampled_from(["7", "a b", "nine"]),
)
@settings(max_examples=60, deadline=None)
def test_dialects_read_alike(tmp_path_factory, mark, comma, upper, end, remarks, name):
    """Semicolons, tabs, decimal commas where they do not divide cells, remarks anywhere, headers in capitals."""
    folder = tmp_path_factory.mktemp("csv")
    rows = [[name, *map(repr, row)] for row in GOOD]
    if comma and "," not in mark:
        rows = [[cell.replace(".", ",") for cell in row] for row in rows]
    header = ["Sample", "S", "X", "Y", "Z"] if upper else ["sample", "s", "x", "y", "z"]
    lines = [mark.join(row) for row in [header, *rows]]
    for i, remark in enumerate(remarks):
        lines.insert(min(2 * i, len(lines)), remark)
    shapes = shapes_of(end.join(lines), folder)
    assert shapes.samples == [name]
    assert torch.equal(shapes.positions, torch.tensor([[row[1:] for row in GOOD]], dtype=torch.float64))
    assert shapes.s.tolist() == [row[0] for row in GOOD]


def test_the_header_may_be_a_remark(tmp_path):
    """As numpy.savetxt writes it."""
    np.savetxt(tmp_path / "shapes.csv", GOOD, delimiter=",", header="s,x,y,z")
    assert read_shapes(tmp_path / "shapes.csv", steel_rod()).s.tolist() == pytest.approx([row[0] for row in GOOD])
    with pytest.raises(InputError, match="line 6, column x: 'q' is not a number"):
        shapes_of("# remark\ns,x,y,z\n#\n0.1,0,0,0.1\n\n0.2,q,0,0\n", tmp_path)


@given(names=st.lists(NAMES.map(str.strip).filter(bool), min_size=1, max_size=4, unique=True), data=st.data())
@settings(max_examples=60, deadline=None)
def test_what_is_written_is_read(tmp_path_factory, names, data):
    """Names with marks, quotes and line ends in them, missing markers, every digit."""
    path = tmp_path_factory.mktemp("round") / "shapes.csv"
    s = torch.tensor(sorted(data.draw(st.lists(st.floats(0.01, 0.4), min_size=2, max_size=5, unique=True))), dtype=torch.float64)
    numbers = st.floats(-0.4, 0.4).filter(bool) | st.just(math.nan)
    cells = st.lists(numbers, min_size=3 * len(s), max_size=3 * len(s))
    positions = torch.tensor([data.draw(cells) for _ in names], dtype=torch.float64).reshape(len(names), len(s), 3)
    write_shapes(path, Shapes(s, positions, names))
    back = read_shapes(path, steel_rod())
    assert back.samples == names
    assert torch.equal(back.s, s)
    assert torch.equal(back.positions.nan_to_num(9.0), positions.nan_to_num(9.0))


def test_a_name_for_every_sample(tmp_path):
    with pytest.raises(InputError, match="1 names for 2 samples"):
        write_shapes(tmp_path / "s.csv", Shapes(torch.tensor([0.1, 0.2]), torch.zeros(2, 2, 3), ["0"]))


def test_zeros_are_gaps(tmp_path, capsys):
    """Another program's (0, 0, 0) is a missing marker, with one warning whatever their number; on the base plate it is a place."""
    rows = [f"{name},{s!r},{x},{y},{z}" for name in "ab" for s, x, y, z in GOOD]
    rows[1], rows[6] = "a,0.2,0,0.0,0", "b,0.30000000000000004,0,0,-0.0"
    text = "\n".join(["sample,s,x,y,z", "a,0,0,0,0", *rows])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        markers = shapes_of(text, tmp_path).markers(1e-3)
    assert len(said) == 1
    assert "exactly (0, 0, 0), 2 in 2 of 2 samples (s = 200, 300 mm), are taken as missing" in str(said[0].message)
    assert markers.present[0].tolist() == [True, True, False, True, True]
    assert markers.present[1].tolist() == [False, True, True, False, True]
    zeroed = Markers(markers.s[1:], torch.zeros(1, 4, 3), 1e-3)
    assert "at exactly (0, 0, 0)" in misplaced(zeroed, 0, 0.4)


def test_a_gap_of_zeros_does_not_bend_the_answer(tmp_path, capsys):
    """One marker of a pushed rod, and then five, written as zeros: the fit is accepted, and that of the others."""
    robot, shape, out = (str(tmp_path / n) for n in ("rod.toml", "shape.csv", "r.json"))
    Path(robot).write_text(ROD)
    assert main(["simulate", robot, "--point", "0.27", "0.5", "0.3", "--noise", "5e-4", "--out", shape]) == 0
    rows = Path(shape).read_text().splitlines()
    for gaps in ([4], [4, 6, 9, 13, 17]):
        zeroed = [",".join([*row.split(",")[:2], "0", "0", "0"]) if i in gaps else row for i, row in enumerate(rows)]
        Path(shape).write_text("\n".join(zeroed))
        assert main(["estimate", robot, shape, "--noise", "5e-4", "--out", out]) == 0
        (record,) = json.loads(Path(out).read_text())["results"]
        assert record["accepted"]
        assert abs(record["loads"][0]["location_m"] - 0.27) < 0.01
        assert "units" not in record["message"]
        assert capsys.readouterr().err.count("\n") == 1


@given(turns=st.floats(0.6, 30), radius=st.floats(1e-3, 0.05), count=st.integers(5, 40))
@settings(max_examples=100, deadline=None)
def test_a_coil_is_not_misplaced(turns, radius, count):
    """A circle, or a helix where it turns more than once, that leaves the base along +z: no word on units, axes or order."""
    L, s = 0.4, torch.linspace(0.4 / count, 0.4, count)
    k = 2 * math.pi * turns / L
    a = min(radius, 0.99 / k)
    c = math.sqrt(1 - (a * k) ** 2)
    z = torch.stack([a * (1 - torch.cos(k * s)), c * s, a * torch.sin(k * s)], -1)
    tangent = torch.tensor([0.0, c, a * k])  # turned so that it begins along +z
    turn = torch.tensor([[1.0, 0, 0], [0, a * k, -c], [0, c, a * k]])
    assert (turn @ tangent - torch.tensor([0.0, 0, 1])).abs().max() < 1e-9
    assert misplaced(Markers(s, (z @ turn.T)[None], 1e-3), 0, L) == ""


def two_tendons(offset: float = 0.0) -> Robot:
    return Robot(steel_rod().rod, Tendons((Tendon.straight(0.007, 0, 0.4, offset), Tendon.straight(0, 0.007, 0.4))))


def test_slack_load_cells(tmp_path):
    """Readings below zero are those of slack tendons, with one warning; a cell that counts the other way is refused."""

    def read(pulls: list[tuple[float, float]], offset: float = 0.0) -> list[str]:
        rows = [f"{b},{s!r},{x},{y},{z},{t},{u}" for b, (t, u) in enumerate(pulls) for s, x, y, z in GOOD]
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            shapes = shapes_of("\n".join(["sample,s,x,y,z,tension_1,tension_2", *rows]), tmp_path, two_tendons(offset))
        assert shapes.tension is not None
        assert shapes.tension.tolist() == [list(p) for p in pulls]
        return [str(w.message) for w in said]

    (said,) = read([(1.0, 2.0), (-0.3, 2.0), (1.0, -0.01), (1.0, 1.0)])
    assert "negative tensions, 2 in 2 of 4 samples, down to -0.3 N" in said
    assert read([(5.0, -0.2)]) and not read([(1.0, 0.0)])
    assert not read([(-0.3, 1.0)], offset=0.5)
    with pytest.raises(InputError, match="can only pull"):
        read([(1.0, -2.0), (1.0, -1.0)])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("207000000000.0", "207.0", "207 Pa, which no rod has; give it in pascals (is it in GPa or MPa?"),
        ("207000000000.0", "207e15", "which no rod has"),
        ("207000000000.0", "0x" + "f" * 5000, "must be finite"),
        ("0.0014", "[[[" + "0x" + "f" * 5000 + "]]]", "must be a number"),
    ],
)
def test_moduli_of_no_rod(tmp_path, old, new, words):
    text = ROD.replace("207e9", "207000000000.0")
    assert old in text
    (tmp_path / "r.toml").write_text(text.replace(old, new))
    with pytest.raises(InputError) as refused:
        read_robot(tmp_path / "r.toml")
    assert words in str(refused.value)
    assert len(str(refused.value)) < 400


def test_a_modulus_in_megapascals_is_told(tmp_path):
    text = ROD.replace("207e9", "207000000000.0").replace("207000000000.0", "207000.0").replace("79000000000.0", "79000.0")
    (tmp_path / "r.toml").write_text(text.replace("79e9", "79000.0"))
    with pytest.warns(UserWarning, match="soft rubber, in a slender rod; if it is in MPa, give 2.07e") as said:
        read_robot(tmp_path / "r.toml")
    assert len(said) == 1


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Rod.from_stiffness(0.4, -torch.eye(3), torch.eye(3)), "K_se must be symmetric positive definite"),
        (lambda: Rod.from_stiffness(0.4, torch.eye(3), torch.eye(3) + torch.tensor([[0.0, 0.5, 0]] * 3)), "K_bt must be symmetric"),
        (lambda: Rod.from_stiffness(0.4, torch.eye(3) * torch.nan, torch.eye(3)), "K_se must be finite"),
        (lambda: Rod.from_stiffness(0.4, torch.ones(3), torch.eye(3)), "K_se has shape"),
        (lambda: Rod.from_stiffness(-0.4, torch.eye(3), torch.eye(3)), "length is -0.4 m"),
        (lambda: Rod.from_stiffness(math.nan, torch.eye(3), torch.eye(3)), "length is nan m"),
        (lambda: Rod.from_stiffness(0.4, torch.eye(3), torch.eye(3), -1.0), "mass_per_length is -1.0 kg/m"),
        (lambda: Rod.from_stiffness(0.4, torch.eye(3), torch.eye(3), 0.0, torch.zeros(4)), "reference_curvature has shape"),
        (lambda: Rod.from_stiffness(0.4, torch.eye(3), torch.eye(3), 0.0, torch.full((1, 4), torch.inf)), "must be finite"),
        (lambda: Rod.from_stiffness(0.4, torch.eye(3) + 0j, torch.eye(3)), "K_se is complex"),
        (lambda: Rod.circular(0.4, -0.001, 2e11, 8e10), "diameter is -0.001"),
        (lambda: Robot(steel_rod().rod, gravity=torch.zeros(2)), "gravity has shape"),
        (lambda: Robot(steel_rod().rod, Tendons((Tendon.straight(0.01, 0, 0.5),))), "beyond the rod's length"),
        (lambda: Tendon.straight(math.nan, 0, 0.4), "three finite numbers"),
        (lambda: Tendon(((0.1, 0, 0), (0.1, 0, 0)), 0.4), "s must increase"),
        (lambda: Tendon.straight(0.01, 0, -0.4), "ends at -0.4 m"),
        (lambda: Tendon.straight(0.01, 0, 0.4, math.inf), "tension_offset is inf"),
        (lambda: Markers(torch.tensor([0.1]), torch.zeros(1, 1, 3) + 0j, 1e-3), "Markers.positions is complex"),
    ],
)
def test_what_is_no_robot(make, words):
    with pytest.raises(ValueError, match=words) as refused:
        make()
    assert "\n" not in str(refused.value)


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[Path, dict[str, str]]:
    """A folder with one small sound file of every kind that is read, and their names by kind."""
    folder = tmp_path_factory.mktemp("sound")
    return folder, fuzz.sound(folder)


KINDS = [
    *("robot.toml", "sections.toml", "spec.toml", "calibrated", "shapes.csv", "everything.csv", "shapes.npz", "deflated.npz"),
    *("result.json", "result.npz", "start.json", "start.safetensors", "tensions.csv"),
    *(of for form in fuzz.FORMS if form != "c3d" for of in (form, f"layout of {form}")),
]


def test_every_kind_is_damaged(files):
    assert {*KINDS} == {*files[1]} - {"c3d"}


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 2**32))
@settings(max_examples=8, deadline=None)
def test_damaged_files_are_read_or_refused_in_one_sentence(files, kind, seed):
    """Bytes, lines, cells, arrays and values changed; scripts/fuzz.py does the same with thousands."""
    folder, names = files
    fuzz.trial(folder, kind, names[kind], (folder / names[kind]).read_bytes(), steel_rod(), seed)


@pytest.mark.parametrize("seed", range(3))
def test_damaged_c3d(files, seed):
    """In a process of its own, which may end as it likes."""
    pytest.importorskip("ezc3d")
    folder, names = files
    fuzz.trial(folder, "c3d", names["c3d"], (folder / names["c3d"]).read_bytes(), steel_rod(), seed)


COMMANDS = {
    "markers.csv": "estimate plain.toml markers.csv --steps 5 --max-iterations 5 --out out.json",
    "plain.toml": "estimate plain.toml markers.csv --steps 5 --max-iterations 5 --out out.json",
    "motive.txt": "import motive motive.txt --robot plain.toml --layout motive.toml --out out.csv",
    "motive.toml": "import motive motive.txt --robot plain.toml --layout motive.toml --out out.csv",
    "result.json": "plot plain.toml markers.csv result.json --sample 0 --out out.png",
}


@pytest.mark.parametrize("file", COMMANDS)
def test_commands_end_with_an_answer_or_one_line(files, monkeypatch, capsys, file):
    """Exit status 0 with a file, or 2 with one line beside the warnings and no file."""
    folder, _ = files
    monkeypatch.chdir(folder)
    command, sound = COMMANDS[file].split(), (folder / file).read_bytes()
    out, ends = folder / command[-1], set()
    for seed in range(3 if file == "result.json" else 8):  # figures take longer
        (folder / file).write_bytes(fuzz.damaged(sound, file, random.Random(seed)))
        status = main(command)
        (folder / file).write_bytes(sound)
        said = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("torchrod: warning: ")]
        assert (status, len(said), out.exists()) in ((0, 0, True), (2, 1, False))
        assert all(line.startswith("torchrod: ") for line in said)
        out.unlink(missing_ok=True)
        ends.add(status)
    assert ends == {0, 2}


@pytest.mark.parametrize("kind", ["result.json", "start.json"])
@pytest.mark.filterwarnings("ignore")
def test_values_of_other_types_are_refused(files, kind):
    """Every value of a JSON file in turn, replaced by one of another type or shape."""
    folder, _ = files
    sound = (folder / kind).read_bytes()

    def places(value, where=()):
        yield where
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ():
            yield from places(inner, (*where, key))

    for where in [w for w in places(json.loads(sound)) if w and "profile" not in w]:
        for other in (None, "x", True, -1, 1e300, [], [[1.0]], {"a": 1}, 10**9):
            fresh = json.loads(sound)
            inner = fresh
            for key in where[:-1]:
                inner = inner[key]
            inner[where[-1]] = other
            (folder / kind).write_text(json.dumps(fresh))
            fuzz.refused(folder, kind, steel_rod())
    (folder / kind).write_bytes(sound)


def test_a_card_of_an_enormous_network_is_refused_before_it_is_made(files, tmp_path):
    for name in ("start.json", "start.safetensors"):
        (tmp_path / name).write_bytes((files[0] / name).read_bytes())
    network, card = load_checkpoint(tmp_path / "start.safetensors")
    state = network.state_dict().values()
    assert sum(v.numel() for v in state) == numbers_in(**card["network"])
    for key in ("width", "depth", "inputs", "count"):
        huge = card | {"network": card["network"] | {key: 10**7}}
        (tmp_path / "start.json").write_text(json.dumps(huge))
        with pytest.raises(InputError, match="its card tells of a network of"):
            load_checkpoint(tmp_path / "start.safetensors")


def archive(change) -> bytes:
    """An NPZ with its first member changed."""
    whole = io.BytesIO()
    np.savez(whole, s=np.array([0.1, 0.2]), positions=np.zeros((1, 2, 3)))
    with zipfile.ZipFile(whole) as old:
        members = {name: old.read(name) for name in old.namelist()}
    fresh = io.BytesIO()
    with zipfile.ZipFile(fresh, "w") as new:
        for i, (name, content) in enumerate(members.items()):
            new.writestr(name, change(content) if i == 0 else content)
    return fresh.getvalue()


def header(text: bytes) -> bytes:
    text = text.ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(16)


ARCHIVES = {
    "encrypted": archive(bytes).replace(b"PK\x01\x02\x14\x03\x14\x00\x00\x00", b"PK\x01\x02\x14\x03\x14\x00\x01\x00"),
    "method": archive(bytes).replace(b"PK\x01\x02\x14\x03\x14\x00\x00\x00\x00\x00", b"PK\x01\x02\x14\x03\x14\x00\x00\x00\x63\x00"),
    "size": archive(lambda _: header(b"{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999999,), }")),
    "overflow": archive(lambda _: header(b"{'descr': '<f8', 'fortran_order': False, 'shape': (9999999999999999999999,), }")),
    "brackets": archive(lambda _: header(b"{'descr': '<f8', 'fortran_order': False, 'shape': ((((((((((")),
    "quotes": archive(lambda _: header(b"{'descr': '''<f8', 'fortran_order': False, 'shape': (2,), }")),
    "objects": archive(lambda _: header(b"{'descr': '|O', 'fortran_order': False, 'shape': (2,), }")),
}


@pytest.mark.parametrize("name", ARCHIVES)
def test_crafted_archives(tmp_path, name):
    for file in ("a.npz", "result.npz"):
        (tmp_path / file).write_bytes(ARCHIVES[name])
        with pytest.raises(InputError, match=r"is not an NPZ of plain numbers|is not a result of torchrod estimate"):
            read_fit(tmp_path / file, "a") if file == "result.npz" else read_shapes(tmp_path / file, steel_rod())
    with pytest.raises(UNREADABLE):
        read_arrays(tmp_path / "a.npz")


def test_tensions_over_time(tmp_path, capsys):
    """A file at another rate, cells read in turn, one a little below zero: interpolated, with one warning; otherwise refused."""
    (tmp_path / "robot.toml").write_text(ROD + "[[tendons]]\noffset = [0.007, 0]\n[[tendons]]\noffset = [0, 0.007]\n")
    times = [0.1, 0.25, 0.4]
    rows = [f"{t},{s!r},{x},{y},{z}" for t in times for s, x, y, z in GOOD]
    (tmp_path / "s.csv").write_text("time,s,x,y,z\n" + "\n".join(rows))
    ticks = [0.07 * k for k in range(7)]
    pulls = [f"{t!r};{2 * t if k % 2 == 0 else ''};{-0.01 if k % 2 else -0.02 + 0.1 * t};note" for k, t in enumerate(ticks)]
    (tmp_path / "t.csv").write_text("time;tension_1;tension_2;remark\n" + "\n".join(pulls))
    command = ["estimate", *(str(tmp_path / n) for n in ("robot.toml", "s.csv")), "--contacts", "0", "--steps", "5"]
    assert main([*command, "--tensions", str(tmp_path / "t.csv")]) == 0
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2 and "'remark' is not known" in said[0] and "negative tensions" in said[1] and "t.csv" in said[1]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        shapes = read_shapes(tmp_path / "s.csv", read_robot(tmp_path / "robot.toml"), None, tmp_path / "t.csv")
    assert shapes.tension is not None
    assert torch.allclose(shapes.tension[:, 0], torch.tensor([2 * t for t in times], dtype=torch.float64), atol=1e-12)
    refusals = {"by 1 s": "1 of 3 samples", "robot": "has no tendons", "times": "has no times"}
    (tmp_path / "t.csv").write_text("time;tension_1;tension_2\n0.2;1;1\n0.45;1;1\n")
    (tmp_path / "rod.toml").write_text(ROD)
    (tmp_path / "still.csv").write_text("s,x,y,z\n" + "\n".join(rows[0].partition(",")[2:]))
    for (robot, shapes), words in zip((("robot", "s"), ("rod", "s"), ("robot", "still")), refusals.values(), strict=True):
        command = ["estimate", str(tmp_path / f"{robot}.toml"), str(tmp_path / f"{shapes}.csv")]
        assert main([*command, "--tensions", str(tmp_path / "t.csv")]) == 2
        said = capsys.readouterr().err
        assert words in said and said.count("\n") == 1


def test_a_refusal_repeats_no_name_of_thousands_of_letters():
    """But a path whole."""
    path = "a/" * 100 + "rod.toml"
    said = str(InputError(f"{path}: unknown key '{'k' * 5000}'; known: length"))
    assert path in said
    assert said.endswith(" known: length")
    assert len(said) < 400
