"""Sound files of every kind that torchrod reads, what reads them, and how they are damaged.

A reader may answer or refuse, in one sentence (InputError); anything else that it raises, a file that it leaves behind after a
refusal, or more than SECONDS is a failure.
"""

import io
import json
import random
import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import roma  # noqa: F401  # which takes longer to load than any file to read
import torch

from torchrod import Robot, read_robot, read_shapes, write_shapes
from torchrod.cli import main
from torchrod.data.spec_file import read_dataset_spec
from torchrod.io import read_base_pose, read_fit, read_uncertainty, write_calibrated
from torchrod.io.lab_formats import convert, read_layout, read_recording
from torchrod.learned.network import Network, load_checkpoint, save_checkpoint
from torchrod.util.errors import InputError

SECONDS = 20
MOST_LETTERS = 1000  # of a refusal
ROBOT = """name = "rod"
[rod]
length = 0.4
diameter = 0.0014
youngs_modulus = 207e9
shear_modulus = 79e9
mass_per_length = 0.012
gravity = [0.0, 0.0, -9.81]
reference_curvature = [[0.0, 0.1, 0.0, 0.0], [0.4, 0.2, 0.0, 0.0]]
[[rod.masses]]
s_mm = 200
mass = 0.001
[[tendons]]
offset = [0.008, 0.0]
ends_at = 0.3
friction = 0.1
motion = "pull"
[[tendons]]
routing = [[0.0, 0.0, 0.008], [0.2, 0.001, 0.008], [0.4, 0.002, 0.008]]
tension_offset = 0.1
[base]
position_mm = [10, 0, 5]
rotation_deg = [0, 90, 0]
[uncertainty]
stiffness = 0.03
tension = 0.05
frame = [0.001, 0.01]
"""
SECTIONS = """[rod]
length_mm = 400
youngs_modulus = 207e9
shear_modulus = 79e9
[[rod.sections]]
to = 0.1
diameter = [0.002, 0.0014]
inner_diameter = 0.0004
[[rod.sections]]
to = 0.3
axes = [0.0014, 0.001]
angle_deg = 30
[[rod.sections]]
K_se = [1e5, 1e5, 3e5]
K_bt = [0.04, 0.04, 0.03]
mass_per_length = 0.01
"""
PLAIN = "[rod]\nlength = 0.4\ndiameter = 0.0014\nyoungs_modulus = 207e9\nshear_modulus = 79e9\n"
SPEC = """[dataset]
samples = 3
noise = 1e-4
[robot]
file = "plain.toml"
[loads]
contacts = 2
family = "gaussian"
force = [0.1, 0.2]
location = [0.2, 1.0]
width = [0.01, 0.1]
min_gap = 0.1
[markers]
at = [0.1, 0.5, 1.0]
"""
NAMES = ("A", "B", "C")
S = (0.1, 0.25, 0.4)
MARKERS = f"[base]\nposition = [0.1, 0, 0]\nrotation_deg = [0, 0, 90]\n[markers]\nnames = {list(NAMES)}\ns = {list(S)}\n"
BODIES = f"[bodies]\nnames = ['a', 'b']\ns = {list(S[1:])}\nrotation_deg = [0, 0, 30]\noffset_mm = [[0, 1, 0], [0, 0, 0]]\n"
CORES = "core_mm = [[0.03, 0], [-0.015, 0.026], [-0.015, -0.026]]\n"
PLATE = """up = "y"
[base]
names = ["P", "Q", "R"]
at_mm = [[30, 0, 0], [-20, 25, 0], [-20, -25, 0]]
[markers]
names = ["A", "B", "C"]
s_mm = [100, 250, 400]
offset = [0, 0.001, 0]
"""
FORMS = ("motive", "headerless", "vicon", "qualisys", "trc", "aurora", "toolbox", "fbgs", "luna", "wide", "line", "c3d")
FRAMES = 3


def _points(digits: int, scale: float) -> list[str]:
    """Cells of A, B and C in every frame, in the lab."""
    p = [[0.1 - 0.01 * k * s, 0.002 * k * s, (1 - 1e-3 * k) * s] for k in range(FRAMES) for s in S]
    return [",".join(f"{scale * v:.{digits}f}" for row in p[k * len(S) : (k + 1) * len(S)] for v in row) for k in range(FRAMES)]


def _threes(row: str) -> list[tuple[float, ...]]:
    values = [float(v) for v in row.split(",")]
    return [tuple(values[i : i + 3]) for i in range(0, len(values), 3)]


def _texts() -> dict[str, tuple[str, str]]:
    """Of every text format a small file and its layout."""
    mm, m = _points(4, 1e3), _points(7, 1.0)
    tools = [",".join(f"{v:.4f}" for v in (0.0, 0.0, 1e3 * s, 0.9999, 0.0, 0.0141, 0.0)) for s in S]
    found = {}
    head = "Format Version,1.23,Take Name,t,Rotation Type,Quaternion,Length Units,Millimeters\n\n,Type" + ",Marker" * 18
    head += "\n,Name" + "".join(f",{n}" * 3 for n in "PQRABC") + "\n,ID" + ",1" * 18 + "\n," + ",Position" * 18
    head += "\nFrame,Time (Seconds)" + ",X,Y,Z" * 6 + "\n"
    plate = "30,0,0,-20,0,-25,-20,0,25"  # in a world whose y axis points up
    up = [",".join(f"{x},{z},{-y}" for x, y, z in _threes(row)) for row in mm]
    found["motive"] = head + "\n".join(f"{k},{0.01 * k},{plate},{up[k]}" for k in range(FRAMES)), PLATE
    three = MARKERS.replace("'A', 'B', 'C'", "'point 1', 'point 2', 'point 3'")
    found["headerless"] = "\n".join(f"{k},{0.01 * k},{m[k]}" for k in range(FRAMES)), three
    head = "Trajectories\n100\n,,A,,,B,,,C,,\nFrame,Sub Frame" + ",X,Y,Z" * 3 + "\n,," + ",".join(["mm"] * 9) + "\n"
    found["vicon"] = head + "\n".join(f"{k},0,{mm[k]}" for k in range(FRAMES)) + "\n\nModel Outputs\n", MARKERS
    head = "NO_OF_FRAMES\t3\nFREQUENCY\t100\nMARKER_NAMES\tA\tB\tC\nFrame\tTime" + "".join(f"\t{n} X\t{n} Y\t{n} Z" for n in NAMES)
    found["qualisys"] = head + "\n" + "\n".join(f"{k}\t{0.01 * k}\t" + mm[k].replace(",", "\t") for k in range(FRAMES)), MARKERS
    head = "PathFileType\t4\t(X/Y/Z)\tx.trc\nDataRate\tUnits\n100\tmm\nFrame#\tTime\tA\t\t\tB\t\t\tC\n\t\tX1\tY1\tZ1\n"
    found["trc"] = head + "\n".join(f"{k}\t{0.01 * k}\t" + mm[k].replace(",", "\t") for k in range(FRAMES)), MARKERS
    head = "Test Date:\nSample:,Hour,Minutes,Seconds,ms" + "".join(f",X{n},Y{n},Z{n},qo{n},qx{n},qy{n},qz{n}" for n in "ab")
    found["aurora"] = head + "\n" + "\n".join(f"{k}, 23, 59, 59, {k},{tools[1]},{tools[2]}," for k in range(FRAMES)), BODIES
    group = ",Frame,Face,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error"
    rows = [f"2,a,{k},0,OK,1,0,0,0,0,0,250,0.1,b,{k},0,{'OK' if k else 'Missing'},1,0,0,0,0,0,400,0.1" for k in range(FRAMES)]
    found["toolbox"] = f"Tools,Port 1{group},Port 2{group}\n" + "\n".join(rows), "rate = 40\n" + BODIES
    names = [[f"G{i}C{c}" for c in range(3)] for i in range(2)]
    rows = [f"2022-04-14T13:00:0{k}+02:00\t\t{k}\t0;0" + "".join(f"\t{c + k}.5" for c in range(6)) for k in range(FRAMES)]
    head = "FBGS header\n" + "\t".join(["Date", "Time", "Linenumber", "Error status", *np.ravel(names)])
    found["fbgs"] = head + "\n" + "\n".join(rows), f"[gratings]\ns_mm = [100, 300]\ncores = {names}\n{CORES}"
    head = "Test name:\tt\nUnits:\tmicrostrain\n------\nx-axis\t\t\t" + "\t".join(f"{0.1 * i:.1f}" for i in range(16))
    rows = [f"2023-01-02 10:00:0{k}.5\tmeasurement\tstrain\t" + "\t".join(f"{i + k}" for i in range(16)) for k in range(FRAMES)]
    found["luna"] = head + "\n" + "\n".join(rows), f"[gratings]\ns = [0.05, 0.2]\nstart = [0.1, 0.6, 1.1]\n{CORES}"
    head = "clock;" + ";".join(f"{n}_{a}" for n in NAMES for a in "xyz")
    found["wide"] = (
        head + "\n" + "\n".join(f"{0.01 * k};" + m[k].replace(",", ";") for k in range(FRAMES)),
        f"time = 'clock'\nunits = 'm'\n{MARKERS}",
    )
    rows = [f"{k},{x},{y},{z}" for k in range(FRAMES) for x, y, z in _threes(mm[k])]
    found["line"] = "Frame,X,Y,Z\n" + "\n".join(rows), "units = 'mm'\nrate = 10\n[base]\nposition = [0.1, 0, 0]\n[centre_line]\n"
    return found


def sound(folder: Path) -> dict[str, str]:
    """Write one small sound file of every kind, and what belongs to it; the kinds, each with the name of its file."""
    for name, text in {"robot.toml": ROBOT, "sections.toml": SECTIONS, "plain.toml": PLAIN, "spec.toml": SPEC}.items():
        (folder / name).write_text(text)
    good = [(0.1 * i, 0.01 * i, -0.002 * i, 0.0999 * i) for i in range(1, 5)]
    rows = [f"{b};{0.5 * b};{s};{x};{y};{z};0;0;0;1" for b in range(2) for s, x, y, z in good]
    (folder / "shapes.csv").write_text('# units = "m"\nsample;time;s;x;y;z;qx;qy;qz;qw\n' + "\n".join(rows) + "\n")
    header = "sample,time,s,x,y,z,rx,ry,rz,sx,kx,ky,base_fx,base_fy,base_fz,base_mx,base_my,base_mz,tension_1,tension_2\n"
    rest = "0,0.001,0,0.001,0.1,0.2,0,0,0.1,0.01,0,0,2.5,-0.01\n"
    (folder / "everything.csv").write_text(header + "".join(f"a,0,{s},{x},{y},{z},{rest}" for s, x, y, z in good))
    (folder / "markers.csv").write_text("s,x,y,z\n" + "\n".join(",".join(map(str, row)) for row in good) + "\n")
    table = np.array(good)
    np.savez(folder / "shapes.npz", s=table[:, 0], positions=table[None, :, 1:], time=np.zeros(1), sample=np.array(["a"]))
    np.savez_compressed(folder / "deflated.npz", s=1e3 * table[:, 0], curvature=np.zeros((2, 4, 2)), units="mm")
    for name in ("result.json", "result.npz"):
        made = ["estimate", str(folder / "plain.toml"), str(folder / "markers.csv"), "--steps", "10", "--out", str(folder / name)]
        if main(made):
            raise RuntimeError("the sound files cannot be made")
    card = {"contacts": 1, "load_priors": ["contact"], "tendons": [0, 0], "active": False, "predicted_spread": True}
    save_checkpoint(folder / "start.safetensors", Network(6, 1, 4, 2), card | {"range": {"amp": [0.0, 1.0]}})
    names = [
        "robot.toml",
        "sections.toml",
        "spec.toml",
        "shapes.csv",
        "everything.csv",
        "shapes.npz",
        "deflated.npz",
        "tensions.csv",
    ]
    names += ["result.json", "result.npz", "start.json", "start.safetensors"]
    kinds = {name: name for name in names} | {"calibrated": "plain.toml"}
    (folder / "timed.csv").write_text(
        "time,s,x,y,z\n" + "".join(f"{0.1 * k},0.2,0,0,0.2\n{0.1 * k},0.4,0,0,0.4\n" for k in range(3))
    )
    (folder / "tensions.csv").write_text("time;tension_1;tension_2\n" + "".join(f"{0.03 * k};{k};{2.5}\n" for k in range(9)))
    for name, (text, layout) in _texts().items():
        (folder / f"{name}.txt").write_text(text)
        (folder / f"{name}.toml").write_text(layout)
        kinds[name] = f"{name}.txt"
        kinds[f"layout of {name}"] = f"{name}.toml"
    if _c3d(folder / "c3d.c3d"):
        (folder / "c3d.toml").write_text(MARKERS)
        kinds["c3d"] = "c3d.c3d"
    robot = read_robot(folder / "plain.toml")
    for kind in kinds:
        if refused(folder, kind, robot):
            raise RuntimeError(f"the sound file of {kind} is refused")
    return kinds


def _c3d(path: Path) -> bool:
    try:
        import ezc3d
    except ImportError:
        return False
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["LABELS"]["value"] = list(NAMES)
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    whole = np.array([[float(v) for v in row.split(",")] for row in _points(4, 1e3)]).reshape(FRAMES, -1, 3)
    file["data"]["points"] = np.concatenate([whole, np.ones_like(whole[..., :1])], -1).transpose(2, 1, 0)
    file.write(str(path))
    return True


def read(folder: Path, kind: str, robot: Robot) -> None:
    """Read the file of a kind as the command does that takes it, and write what is made of it. Errors: InputError."""
    path, name = folder / kind, kind.removeprefix("layout of ")
    if name in FORMS:
        layout = read_layout(folder / f"{name}.toml")
        form = "motive" if name == "headerless" else name
        file = folder / ("c3d.c3d" if name == "c3d" else f"{name}.txt")
        found = read_recording(form, file, layout)
        write_shapes(folder / "out.csv", convert(file, found, layout, robot, None).shapes)
    elif kind in ("robot.toml", "sections.toml"):
        read_robot(path)
        read_base_pose(path)
        read_uncertainty(path)
    elif kind == "calibrated":
        write_calibrated(folder / "out.toml", folder / "plain.toml", read_robot(folder / "plain.toml"))
    elif kind.startswith("result"):
        read_fit(path, "0", None, None, 0.4)
    elif kind == "spec.toml":
        read_dataset_spec(path)
    elif kind.startswith("start"):
        load_checkpoint(folder / "start.safetensors")
    elif kind == "tensions.csv":
        write_shapes(folder / "out.csv", read_shapes(folder / "timed.csv", read_robot(folder / "robot.toml"), None, path))
    else:
        write_shapes(
            folder / "out.csv", read_shapes(path, read_robot(folder / "robot.toml") if kind == "everything.csv" else robot)
        )


@contextmanager
def within(seconds: int) -> Iterator[None]:
    """TimeoutError after so long."""

    def late(*_: object) -> None:
        raise TimeoutError(f"more than {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def refused(folder: Path, kind: str, robot: Robot) -> bool:
    """Whether a file is refused, as it should be; any other end raises."""
    try:
        with warnings.catch_warnings(), within(SECONDS):
            warnings.simplefilter("ignore")
            read(folder, kind, robot)
    except InputError as error:
        if len(str(error)) > MOST_LETTERS:
            raise AssertionError(f"a refusal of {len(str(error))} letters") from None
        if left := [name for name in ("out.csv", "out.toml") if (folder / name).exists()]:
            raise AssertionError(f"{left[0]} is left behind a refusal") from None
        return True
    for name in ("out.csv", "out.toml"):
        (folder / name).unlink(missing_ok=True)
    return False


# Damage.

WORDS = [
    b"1e999",
    b"-1",
    b"nan",
    b"inf",
    b"null",
    b'""',
    b"[]",
    b"{}",
    b"true",
    b"0x" + b"f" * 5000,
    b"[" * 5000,
    b"\\u0000",
    b"\0",
]
WORDS += [b"'", b'"', b"#", b"", b"0", b"1e300", b"-1e-300", b"999999999999", b"x", b"\xff", b"\r", b"1_0", b"  ", b"\xef\xbb\xbf"]
MARKS = b",;\t =[]\n"


def _of_bytes(content: bytes, chance: random.Random) -> bytes:
    """A few bytes changed, dropped, doubled or replaced by a word."""
    out = bytearray(content)
    for _ in range(chance.choice([1, 1, 2, 5])):
        i, n = chance.randrange(len(out) + 1), chance.choice([0, 1, 1, 4, 16])
        fresh = chance.choice([b"", chance.randbytes(n), chance.choice(WORDS), bytes(out[i : i + n]) * 2])
        out[i : i + n] = fresh
    return bytes(out)


def _of_lines(content: bytes, chance: random.Random) -> bytes:
    """Lines dropped, doubled, exchanged or emptied."""
    lines = content.split(b"\n")
    for _ in range(chance.choice([1, 1, 3])):
        i, j = chance.randrange(len(lines)), chance.randrange(len(lines))
        what = chance.randrange(4)
        if what == 0 and len(lines) > 1:
            del lines[i]
        elif what == 1:
            lines.insert(j, lines[i])
        elif what == 2:
            lines[i], lines[j] = lines[j], lines[i]
        else:
            lines[i] = b""
    return b"\n".join(lines)


def _of_cells(content: bytes, chance: random.Random) -> bytes:
    """What stands between two marks replaced by a word, by another such place, or by nothing with its mark."""
    ends = [i for i, byte in enumerate(content) if byte in MARKS] + [len(content)]
    for _ in range(chance.choice([1, 1, 2, 4])):
        k = chance.randrange(len(ends))
        first, last = (ends[k - 1] + 1 if k else 0), ends[k]
        other = chance.randrange(len(ends))
        fresh = chance.choice([chance.choice(WORDS), content[(ends[other - 1] + 1 if other else 0) : ends[other]], b""])
        gone = last + chance.choice([0, 0, 1])
        content = content[:first] + fresh + content[gone:]
        ends = [i for i, byte in enumerate(content) if byte in MARKS] + [len(content)]
    return content


def _of_arrays(content: bytes, chance: random.Random) -> bytes:
    """An array of an NPZ left out, added, of another shape, type or value."""
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays: dict[str, np.ndarray] = {name: file[name] for name in file.files}
    for _ in range(min(len(arrays), chance.choice([1, 1, 2]))):
        name = chance.choice(sorted(arrays))
        old = arrays[name]
        what = chance.randrange(7)
        if what == 0:
            del arrays[name]
        elif what == 1:
            arrays[chance.choice(["extra", name[:-1] or "x", name.upper(), "units", "tensions", "offsets"])] = old
        elif what == 2:
            arrays[name] = chance.choice(
                [old.reshape(1, *old.shape), old.reshape(-1), old.reshape(-1)[:0], np.ones(()), old.ravel()[:1], old.T]
            )
        elif what == 3:
            fresh = [np.int8, np.uint64, np.complex128, np.float16, bool, "U3", "S2", "M8[s]", "longdouble"]
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    arrays[name] = old.astype(chance.choice(fresh))
                except (ValueError, TypeError, RuntimeError):
                    arrays[name] = np.array(["x"])
        elif old.dtype.kind == "f" and old.size:
            value = chance.choice([np.nan, np.inf, -np.inf, 1e308, -1.0, 0.0, 5e-324, 1e6])
            flat = old.flatten()
            flat[chance.randrange(old.size)] = value
            arrays[name] = np.full_like(old, value) if what == 4 else flat.reshape(old.shape)
    whole = io.BytesIO()
    np.savez(whole, **arrays)  # pyright: ignore[reportArgumentType]
    return whole.getvalue()


def _of_values(content: bytes, chance: random.Random) -> bytes:
    """A value of a JSON file replaced by one of another type or shape, left out or moved."""
    whole = json.loads(content)
    places: list[tuple[dict | list, str | int]] = []

    def collect(value: object) -> None:
        if isinstance(value, dict | list):
            for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
                places.append((value, key))
                collect(inner)

    collect(whole)
    for _ in range(chance.choice([1, 1, 2])):
        home, key = chance.choice(places)
        values = [None, "x", True, -1, 1e300, [], [[1.0]], {"a": 1}, 10**9, 10**400, "\ud800", 1e-320]
        fresh = chance.choice([*values, chance.choice(places)[0]])
        try:
            json.dumps(fresh)
            home[key] = json.loads(json.dumps(fresh))  # pyright: ignore[reportArgumentType, reportCallIssue]
        except (LookupError, ValueError):
            continue
    return json.dumps(whole).encode()


def damaged(content: bytes, name: str, chance: random.Random) -> bytes:
    """A file with a few changes of its bytes or of its structure, or cut off."""
    ways: list[Callable[[bytes, random.Random], bytes]] = [_of_bytes]
    if name.endswith(".npz"):
        ways += [_of_arrays] * 2
    elif name.endswith(".json"):
        ways += [_of_values] * 2
    elif not name.startswith(("c3d.c3d", "start.safetensors")):
        ways += [_of_lines, _of_cells, _of_cells]
    out = chance.choice(ways)(content, chance)
    return out[: chance.randrange(len(out) + 1)] if chance.random() < 0.1 else out


def trial(folder: Path, kind: str, file: str, content: bytes, robot: Robot, seed: int) -> bool:
    """Damage a file by a seed and read it: whether it was refused. Anything but an answer or a refusal raises."""
    torch.set_default_dtype(torch.float64)
    (folder / file).write_bytes(damaged(content, file, random.Random(f"{kind} {seed}")))
    try:
        return refused(folder, kind, robot)
    finally:
        (folder / file).write_bytes(content)
