"""Files of measuring systems: small ones of each form, made here, with what they must give back; and real ones where there are."""

import json
import math
import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.robots import T, steel_rod
from torchrod import CentreLine, PointForces, Shapes, read_shapes, solve_shape
from torchrod.cli import main
from torchrod.cli.lab_import import _warn_of_distance
from torchrod.cli.parser import IMPORTED
from torchrod.io import Noises
from torchrod.io.lab_formats import FORMATS, Imported, labels
from torchrod.io.lab_formats.labels import labelled, rod_of
from torchrod.util.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
ROD = (ROOT / "docs" / "example" / "rod.toml").read_text()
REAL = ROOT.parent / "shared" / "data" / "third_party" / "lab_files"
PLATE = np.array([[30.0, 0, 0], [-20, 25, 0], [-20, -25, 0], [10, 15, 8]]) * 1e-3
POSE = Rotation.from_rotvec([0.0, math.pi, 0.0]) * Rotation.from_rotvec([0.4, 0.2, -0.9])  # hangs down, turned
ORIGIN = np.array([0.3, -1.2, 0.8])
S = np.linspace(0.05, 0.4, 8)


@dataclass
class Take:
    """A rod pushed ever harder: its markers and the plate's in the lab's frame (m), z up; quaternions of its sections there."""

    time: np.ndarray
    base: np.ndarray
    markers: np.ndarray
    q: np.ndarray
    own: np.ndarray

    @property
    def named(self) -> dict[str, np.ndarray]:
        plate = {f"B{i}": np.repeat(z[None], len(self.time), 0) for i, z in enumerate(self.base)}
        return plate | {f"M{i}": self.markers[:, i] for i in range(len(S))}


def take(frames: int = 5, push: float = 1.2) -> Take:
    force = torch.zeros(frames, 1, 3)
    force[:, 0, 0], force[:, 0, 1] = torch.linspace(0, push, frames), 0.3
    shape = solve_shape(steel_rod(), (PointForces(force, T([[0.3]] * frames)),), None, T(S), frames, 80)
    own, q = shape.p.numpy(), Rotation.from_quat(shape.q.numpy().reshape(-1, 4))
    lab = (POSE.apply(own.reshape(-1, 3)) + ORIGIN).reshape(own.shape)
    return Take(0.01 * np.arange(frames), POSE.apply(PLATE) + ORIGIN, lab, (POSE * q).as_quat().reshape(frames, -1, 4), own)


def layout(*lines: str, markers: bool = True) -> str:
    plate = f"[base]\nnames = {[f'B{i}' for i in range(4)]}\nat_mm = {(1e3 * PLATE).tolist()}"
    rod = f"[markers]\nnames = {[f'M{i}' for i in range(len(S))]}\ns_mm = {(1e3 * S).tolist()}"
    return "\n".join([*lines, plate, *([rod] if markers else [])])


def imported(folder: Path, form: str, text: str | bytes, plan: str, out: str = "s.csv", robot: str = ROD):
    """What import makes of a file."""
    (folder / "rod.toml").write_text(robot)
    (folder / "layout.toml").write_text(plan)
    (folder / "file").write_bytes(text if isinstance(text, bytes) else text.encode("cp1252"))
    names = [str(folder / n) for n in ("file", "rod.toml", "layout.toml", out)]
    assert main(["import", form, names[0], "--robot", names[1], "--layout", names[2], "--out", names[3]]) == 0
    return read_shapes(folder / out, steel_rod())


def cells(values, digits: int, mark: str = ",") -> str:
    return mark.join("" if math.isnan(v) else f"{v:.{digits}f}" for v in values)


def y_up(p: np.ndarray) -> np.ndarray:
    """The lab's z up in a world whose y axis points up."""
    return p @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


# A file of each form with these points, and what its layout has to say; each to the digits that the system writes.


def motive(t: Take, points: dict[str, np.ndarray], scale: float = 1e3, units: str = "Millimeters") -> str:
    names = list(points)
    head = f"Format Version,1.23,Take Name,t,Capture Frame Rate,100,Rotation Type,Quaternion,Length Units,{units}"
    rows = [head, "", ",Type" + ",Marker" * 3 * len(names), ",Name" + "".join(f",Robot:{n}" * 3 for n in names)]
    rows += [",ID" + ",1" * 3 * len(names), "," + ",Position" * 3 * len(names), "Frame,Time (Seconds)" + ",X,Y,Z" * len(names)]
    for k, time in enumerate(t.time):
        rows.append(f"{k},{time:.6f}," + cells(np.concatenate([scale * y_up(points[n][k]) for n in names]), 6))
    return "\n".join(rows)


def vicon(t: Take, points: dict[str, np.ndarray]) -> str:
    names = list(points)
    rows = ["Trajectories", "100", ",," + ",".join(f"{n},," for n in names), "Frame,Sub Frame" + ",X,Y,Z" * len(names)]
    rows += [",," + ",".join(["mm"] * 3 * len(names))]
    rows += [f"{k + 1},0," + cells(np.concatenate([1e3 * points[n][k] for n in names]), 4) for k in range(len(t.time))]
    return "\r\n".join(rows) + "\r\n\r\nDevices\r\n1000\r\n"


def qualisys(t: Take, points: dict[str, np.ndarray]) -> str:
    names = list(points)
    keys = {"NO_OF_FRAMES": len(t.time), "NO_OF_MARKERS": len(names), "FREQUENCY": 100, "DATA_INCLUDED": "3D"}
    rows = [f"{key}\t{value}" for key, value in keys.items()] + ["MARKER_NAMES\t" + "\t".join(names)]
    rows += ["TRAJECTORY_TYPES" + "\tMeasured" * len(names), "Frame\tTime\t" + "\t".join(f"{n} {a}" for n in names for a in "XYZ")]
    for k, time in enumerate(t.time):
        values = np.concatenate([1e3 * points[n][k] for n in names])
        rows.append(f"{k + 1}\t{time:.5f}\t" + cells(np.nan_to_num(values), 3, "\t"))
    return "\n".join(rows)


def trc(t: Take, points: dict[str, np.ndarray]) -> str:
    names = list(points)
    rows = [
        "PathFileType\t4\t(X/Y/Z)\tx.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
        f"100\t100\t{len(t.time)}\t9\tmm",
    ]
    rows += ["Frame#\tTime\t" + "\t\t\t".join(names), "\t\t" + "\t".join(f"{a}{i}" for i in range(len(names)) for a in "XYZ"), ""]
    for k, time in enumerate(t.time):
        rows.append(f"{k + 1}\t{time:.5f}\t" + cells(np.concatenate([1e3 * points[n][k] for n in names]), 5, "\t"))
    return "\n".join(rows)


def wide(t: Take, points: dict[str, np.ndarray]) -> str:
    names = list(points)
    rows = ["clock;" + ";".join(f"{n}_{a}" for n in names for a in "xyz")]
    rows += [f"{time};" + cells(np.concatenate([points[n][k] for n in names]), 9, ";") for k, time in enumerate(t.time)]
    return "\n".join(rows)


def headerless(t: Take, points: dict[str, np.ndarray]) -> str:
    rows = [f"{k},{time:.6f}," + cells(np.concatenate([y_up(p[k]) for p in points.values()]), 6) for k, time in enumerate(t.time)]
    return "\n".join(rows)


def renamed(plan: str, name) -> str:
    return re.sub(r"'([BM]\d)'", lambda match: f"'{name(match[1])}'", plan)


FORMS = {
    "motive": (motive, renamed(layout("up = 'y'"), lambda n: f"Robot:{n}"), 2e-9),
    "vicon": (vicon, layout(), 2e-7),
    "qualisys": (qualisys, layout(), 2e-6),
    "trc": (trc, layout(), 2e-8),
    "wide": (wide, layout("units = 'm'", "time = 'clock'"), 3e-9),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_file_of_each_form_comes_back(tmp_path, form):
    """To the digits that the system writes, in the base frame; a marker that was not seen is missing, and no other."""
    write, plan, digits = FORMS[form]
    t = take()
    t.markers[2, 3] = np.nan
    shapes = imported(tmp_path, form, write(t, t.named), plan)
    lost = torch.isnan(shapes.positions).any(-1)
    assert lost.nonzero().tolist() == [[2, 3]]
    expected = np.where(np.isnan(t.markers), np.nan, t.own)
    assert np.allclose(shapes.positions.numpy(), expected, rtol=0, atol=3 * digits, equal_nan=True)
    assert np.allclose(shapes.s.numpy(), S)
    assert shapes.time is not None and np.allclose(shapes.time.numpy(), t.time)


def test_c3d(tmp_path):
    """By ezc3d, which writes single precision."""
    ezc3d = pytest.importorskip("ezc3d")
    t, file = take(), ezc3d.c3d()
    t.markers[2, 3] = np.nan
    points = t.named
    file["parameters"]["POINT"]["LABELS"]["value"] = list(points)
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    whole = np.stack([1e3 * p for p in points.values()], 1)
    file["data"]["points"] = np.concatenate([whole, np.ones_like(whole[..., :1])], -1).transpose(2, 1, 0)
    file.write(str(tmp_path / "a.c3d"))
    shapes = imported(tmp_path, "c3d", (tmp_path / "a.c3d").read_bytes(), layout())
    expected = np.where(np.isnan(t.markers), np.nan, t.own)
    assert np.allclose(shapes.positions.numpy(), expected, rtol=0, atol=5e-7, equal_nan=True)
    assert main(["import", "c3d", str(tmp_path / "rod.toml"), *_options(tmp_path)]) == 2


def _options(folder: Path) -> list[str]:
    return ["--robot", str(folder / "rod.toml"), "--layout", str(folder / "layout.toml"), "--out", str(folder / "o.csv")]


def aurora(t: Take) -> str:
    rows = [
        "Test Date: ",
        "day, month",
        "2, 2",
        "",
        "Sample:,Hour,Minutes,Seconds,ms" + "".join(f",X{n},Y{n},Z{n},qo{n},qx{n},qy{n},qz{n}" for n in "ab"),
    ]
    for k in range(len(t.time)):
        tools = [np.r_[1e3 * t.markers[k, i], t.q[k, i][[3, 0, 1, 2]]] if (k, i) != (1, 7) else np.zeros(7) for i in (3, 7)]
        rows.append(f"{k + 1}, 23 , 59, 59, {10 * k}," + "".join(f"{v:.4f} , " for tool in tools for v in tool))
    return "\r\n".join([*rows, "9, 23, 59,"])


def toolbox(t: Take) -> str:
    group = ",Frame,Face,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error"
    rows = ["Tools,Port 1" + group + ",Port 2" + group]
    for k in range(len(t.time)):
        line = "2"
        for name, i in (("a", 3), ("b", 7)):
            values = [*t.q[k, i][[3, 0, 1, 2]], *(1e3 * t.markers[k, i]), 0.1]
            seen = (k, i) != (1, 7)
            line += f",{name},{k + 1},0,{'OK' if seen else 'Missing'}," + (cells(values, 4) if seen else "," * 7)
        rows.append(line)
    return "\n".join([*rows, ""])


@pytest.mark.parametrize(("form", "write"), [("aurora", aurora), ("toolbox", toolbox)])
def test_trackers_with_six_degrees_of_freedom(tmp_path, form, write):
    """Positions and orientations in the base frame that is stated; a tool that was not seen is missing; mounted at an angle."""
    t = take()
    mounting = Rotation.from_rotvec([0.0, 0.5, 0.2])
    t.q = (Rotation.from_quat(t.q.reshape(-1, 4)) * mounting).as_quat().reshape(t.q.shape)
    plan = f"rate = 40\n[base]\nposition = {ORIGIN.tolist()}\nrotation = {POSE.as_quat().tolist()}\n"
    plan += f"[bodies]\nnames = ['a', 'b']\ns = {S[[3, 7]].tolist()}\nrotation = {mounting.as_rotvec().tolist()}\n"
    shapes = imported(tmp_path, form, write(t), plan)
    seen = np.ones((5, 2), dtype=bool)
    seen[1, 1] = False
    assert np.array_equal(torch.isfinite(shapes.positions[:5]).all(-1).numpy(), seen)
    assert len(shapes.samples) == (6 if form == "aurora" else 5)  # the last line of a file that was cut off: nothing was seen
    assert np.abs(shapes.positions[:5].numpy() - t.own[:, [3, 7]])[seen].max() < 1e-7
    own = (POSE.inv() * Rotation.from_quat(t.q[:, [3, 7]].reshape(-1, 4)) * mounting.inv()).as_matrix().reshape(5, 2, 3, 3)
    found = shapes.readings["orientations"][:5].numpy()[seen]
    assert np.abs(Rotation.from_quat(found).as_matrix() - own[seen]).max() < 5e-4


@pytest.mark.parametrize("wrong", ["w first", "inverse", "none"])
def test_rotations_that_do_not_go_with_the_positions_are_told(tmp_path, capsys, wrong):
    """w first in columns that are called x, y, z, w, or inverse rotations: said at import, and where shapes are read."""
    t = take(6, 2.0)
    q, lab = Rotation.from_quat(t.q.reshape(-1, 4)), POSE.as_quat()
    q = (q.inv() if wrong == "inverse" else q).as_quat().reshape(t.q.shape)[:, [1, 4, 7]]
    names = [f"qw{i},qx{i},qy{i},qz{i}" if wrong == "none" else f"qx{i},qy{i},qz{i},qw{i}" for i in "abc"]
    if wrong != "inverse":
        q = q[..., [3, 0, 1, 2]]
    rows = [",".join(f"{n},x{i},y{i},z{i}" for n, i in zip(names, "abc", strict=True))]
    rows += [cells(np.concatenate([np.r_[q[k, i], t.markers[k, m]] for i, m in enumerate((1, 4, 7))]), 9) for k in range(6)]
    plan = f"units = 'm'\n[base]\nposition = {ORIGIN.tolist()}\nrotation = {lab.tolist()}\n"
    plan += f"[bodies]\nnames = ['a', 'b', 'c']\ns = {S[[1, 4, 7]].tolist()}\n"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of reading it back, which is looked at below
        imported(tmp_path, "wide", "\n".join(rows), plan)
    said = capsys.readouterr().err
    assert said.count("\n") == (wrong != "none")
    assert ("read with w first they would" in said) == (wrong == "w first")
    assert ("read as the inverse rotation they would" in said) == (wrong == "inverse")
    own = solve_shape(steel_rod(), (PointForces(T([[[1.0, 0.3, 0.0]]]), T([[0.3]])),), None, T(S), 1)
    order = [3, 0, 1, 2] if wrong == "w first" else [0, 1, 2, 3]
    q = own.q[..., order] * (T([-1, -1, -1, 1]) if wrong == "inverse" else 1)
    np.savez(tmp_path / "q.npz", s=S, positions=own.p.numpy(), orientations=q.numpy())
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        read_shapes(tmp_path / "q.npz", steel_rod())
    assert len(told) == (wrong != "none")


CORES = np.array([[math.cos(a), math.sin(a)] for a in (0.3, 2.4, 4.5)]) * 35e-6


def strains(kx, ky, common) -> np.ndarray:
    """Of the cores, from the definition: the length of a fibre at (x, y) in a rod of curvature k."""
    return common[..., None] + kx[..., None] * CORES[:, 1] - ky[..., None] * CORES[:, 0]


def test_gratings(tmp_path):
    """FBGS: strains of three cores at four gratings give the curvatures they were made of, whatever the temperature."""
    g = np.random.default_rng(0)
    kx, ky, common = g.normal(0, 5, (6, 4)), g.normal(0, 5, (6, 4)), g.normal(0, 1e-4, (6, 4))
    e = 1e6 * strains(kx, ky, common)
    names = [[f"G{i}C{c}" for c in range(3)] for i in range(4)]
    rows = ["\t".join(["Date", "Time", "Linenumber", "Error status", *np.ravel(names)])]
    rows += ["\t".join([f"2022-04-14T13:00:0{k}+02:00", "", str(k), "0;0", *(f"{v:.4f}" for v in e[k].ravel())]) for k in range(6)]
    text = "FBGS \xb5 header\n" + "\n".join(rows)
    plan = f"[gratings]\ns_mm = [50, 150, 250, 350]\ncores = {names}\ncore_mm = {(1e3 * CORES).tolist()}\n"
    shapes = imported(tmp_path, "fbgs", text, plan, "s.npz")
    found = shapes.readings["curvature"].numpy()
    assert np.allclose(found, np.stack([kx, ky], -1), atol=1e-10 / 35e-6 * 2)
    assert shapes.time is not None and shapes.time.tolist() == list(range(6))
    table = ["t," + ",".join(f"kx{i},ky{i}" for i in range(4))]
    table += [f"{k}," + ",".join(f"{float(kx[k, i])!r},{float(ky[k, i])!r}" for i in range(4)) for k in range(6)]
    columns = "\n".join(f"{k} = {[f'{k}{i}' for i in range(4)]}" for k in ("kx", "ky"))
    plan = f"time = 't'\n[gratings]\ns_mm = [50, 150, 250, 350]\n{columns}\n"
    again = imported(tmp_path, "wide", "\n".join(table), plan)
    assert np.array_equal(again.readings["curvature"].numpy(), np.stack([kx, ky], -1))


def test_a_fibre(tmp_path):
    """Luna: three cores one after the other on one fibre, strain between the samples interpolated."""
    x, start = np.linspace(0, 1.6, 1601), [0.1, 0.6, 1.1]
    s = np.array([0.05, 0.2005, 0.4])
    curve = np.stack([np.stack([4 * np.sin(5 * (x - a)), 3 + x - a], -1) for a in start], 1)
    e = np.zeros_like(x)
    for c, a in enumerate(start):
        there = (x >= a - 0.01) & (x <= a + 0.42)
        e[there] = strains(curve[there, c, 0], curve[there, c, 1], np.full(there.sum(), 5e-5))[:, c]
    head = ["Test name:\tt", "Channel:\t1", "Units:\tmicrostrain", "-" * 20, "Gage/Segment Name\t\t\tAll gages"]
    rows = [*head, "Tare\ttare\tstrain\t" + "\t".join(["0.0"] * len(x)), "x-axis\t\t\t" + "\t".join(f"{v:.4f}" for v in x)]
    rows += [f"2023-01-02 10:00:0{k}.5\tmeasurement\tstrain\t" + "\t".join(f"{1e6 * v:.5f}" for v in (k + 1) * e) for k in range(2)]
    plan = f"[gratings]\ns = {s.tolist()}\nstart = {start}\ncore = {CORES.tolist()}\n"
    shapes = imported(tmp_path, "luna", "\n".join(rows), plan)
    expected = np.stack([4 * np.sin(5 * s), 3 + s], -1)
    assert np.allclose(shapes.readings["curvature"].numpy(), np.stack([expected, 2 * expected]), atol=1e-3)
    assert shapes.time is not None and shapes.time.tolist() == [0.0, 1.0]


@given(seed=st.integers(0, 10**6))
@settings(max_examples=4, deadline=None)
def test_the_rod_labels_its_markers(tmp_path_factory, seed):
    """Points in another order in every frame, gaps, ghosts, plate and rod unnamed: what is labelled is right, and nearly all is."""
    g = np.random.default_rng(seed)
    t = take(30, 1.5)
    gone = g.random((30, len(S))) < 0.1
    t.markers[gone] = np.nan
    points = [*t.named.values(), *(np.repeat((ORIGIN + g.normal(0, 0.3, 3))[None], 30, 0) for _ in range(2))]
    whole = np.stack(points, 1)
    for k in range(30):
        whole[k] = whole[k, g.permutation(whole.shape[1])]
    text = headerless(t, {str(i): whole[:, i] for i in range(whole.shape[1])})
    plan = f"up = 'y'\n[base]\nat_mm = {(1e3 * PLATE).tolist()}\n[markers]\ns_mm = {(1e3 * S).tolist()}\n"
    shapes = imported(tmp_path_factory.mktemp("label"), "motive", text, plan)
    found = shapes.positions.numpy()
    told = np.isfinite(found).all(-1)
    assert np.abs(found - t.own)[told].max() < 1e-5
    assert not (told & gone).any()
    assert (told | gone).mean() > 0.95


def test_what_is_no_rod_ends_soon(tmp_path, capsys, monkeypatch):
    """100 frames of points near the base that lie as on no such rod: refused after a few first frames, in one sentence."""
    begun, tried = labels._begun, []
    monkeypatch.setattr(labels, "_begun", lambda *a: tried.append(0) or begun(*a))
    t, g = take(100), np.random.default_rng(0)
    points = {str(i): g.normal(0, 0.05, (100, 3)) for i in range(9)}
    (tmp_path / "rod.toml").write_text(ROD)
    (tmp_path / "layout.toml").write_text(f"up = 'y'\n[base]\nposition = [0, 0, 0]\n[markers]\ns_mm = {(1e3 * S).tolist()}\n")
    (tmp_path / "file").write_text(headerless(t, points))
    assert main(["import", "motive", str(tmp_path / "file"), *_options(tmp_path)]) == 2
    assert 0 < len(tried) <= 3 * labels.PATIENCE
    said = capsys.readouterr().err
    assert "in hardly any of its 100 frames" in said and said.count("\n") == 1
    assert not (tmp_path / "o.csv").exists()


def test_a_rod_that_was_lost_is_found_again():
    """In no more than twice the frames that it was away for."""
    t, g, away = take(45), np.random.default_rng(0), 15
    frames = t.own.copy()
    frames[10 : 10 + away] = g.normal(0, 0.05, (away, *t.own.shape[1:]))
    found = labelled(rod_of(steel_rod(), S, None), frames)
    told = np.isfinite(found[..., 0])
    assert told[:10].all() and told[10 + 2 * away :].all()
    assert told[10 : 10 + away].mean() < 0.05


@pytest.mark.parametrize("form", ["solid", "flat", "unlabelled"])
def test_left_handed_exports_are_told(tmp_path, capsys, form):
    """A mirrored world, with a plate whose markers are in one plane or not: it is said, and left_handed = true mends it."""
    t = take()
    t.markers, t.base = (v * [1.0, -1.0, 1.0] for v in (t.markers, t.base))
    points = t.named
    plan = layout("units = 'm'", "time = 'clock'")
    system, text = ("motive", motive(t, points)) if form == "unlabelled" else ("wide", wide(t, points))
    if form == "unlabelled":
        plan = f"up = 'y'\n[base]\nat_mm = {(1e3 * PLATE).tolist()}\n[markers]\ns_mm = {(1e3 * S).tolist()}\n"
    if form == "flat":
        plan = plan.replace("'B2', 'B3'", "'B2'").replace(f", {(1e3 * PLATE).tolist()[3]}", "")
    (tmp_path / "rod.toml").write_text(ROD)
    (tmp_path / "layout.toml").write_text(plan)
    (tmp_path / "file").write_text(text)
    assert main(["import", system, str(tmp_path / "file"), *_options(tmp_path)]) == 2
    assert "left-handed (mirrored)" in capsys.readouterr().err
    found = imported(tmp_path, system, text, "left_handed = true\n" + plan).positions.numpy()
    there = np.isfinite(found)
    assert there.mean() > (0.9 if form == "unlabelled" else 0.999)
    assert np.allclose(found[there], t.own[there], atol=1e-8)


@pytest.mark.parametrize("suffix", ["csv", "npz"])
def test_a_centre_line(tmp_path, suffix):
    """Points in any order, of frames with different numbers of them, in another world: what is written is read, in any unit."""
    t, g = take(3), np.random.default_rng(0)
    order = [g.permutation(len(S))[: len(S) - k] for k in range(3)]
    rows = [f"{k};{';'.join(f'{1e3 * v:.9f}' for v in t.markers[k, i])}" for k in range(3) for i in order[k]]
    plan = f"units = 'mm'\nrate = 10\n[base]\nposition = {ORIGIN.tolist()}\nrotation = {POSE.as_quat().tolist()}\n[centre_line]\n"
    shapes = imported(tmp_path, "line", "Frame;X;Y;Z\n" + "\n".join(rows), plan, f"s.{suffix}")
    assert shapes.time is not None and shapes.time.tolist() == [0.0, 0.1, 0.2]
    assert not torch.isfinite(shapes.positions).any() and float(shapes.s[-1]) == 0.4
    for k in range(3):
        p = shapes.points[k].numpy()
        assert np.allclose(p[np.isfinite(p).all(-1)], t.own[k, order[k]], atol=1e-9)
    (sensor,) = shapes.sensors(Noises(1e-3, 0.01))
    assert isinstance(sensor, CentreLine) and int(sensor.present.sum()) == 3 * len(S) - 3
    (tmp_path / "far.csv").write_text("x,y,z\n" + "\n".join(f"{1e3 * v[0]},{1e3 * v[1]},{1e3 * v[2]}" for v in t.own[0]))
    with pytest.raises(InputError, match=r"centre line are up to .* give metres or --units"):
        read_shapes(tmp_path / "far.csv", steel_rod())
    assert read_shapes(tmp_path / "far.csv", steel_rod(), "mm").points.shape == (1, len(S), 3)


def test_from_the_export_to_the_load(tmp_path):
    """Two commands: y up, millimetres, a base that hangs away from the origin; the load in the lab's frame as well."""
    t = take(3)
    write, plan, _ = FORMS["motive"]
    robot = f"{ROD}\n[base]\nposition = {ORIGIN.tolist()}\nrotation = {POSE.as_quat().tolist()}\n"
    imported(tmp_path, "motive", write(t, t.named), plan, robot=robot)
    command = ["estimate", str(tmp_path / "rod.toml"), str(tmp_path / "s.csv"), "--load-prior", "point", "--noise", "1e-5"]
    assert main([*command, "--out", str(tmp_path / "r.json")]) == 0
    last = json.loads((tmp_path / "r.json").read_text())["results"][-1]
    (load,) = last["loads"]
    assert last["time_s"] == pytest.approx(0.02)
    assert load["location_m"] == pytest.approx(0.3, abs=2e-3)
    assert np.allclose(load["position_lab_m"], POSE.apply(load["position_m"]) + ORIGIN)


def test_the_command_knows_every_format():
    assert tuple(FORMATS) == IMPORTED


LAB = {
    "vicon_markers_head.csv": ("vicon", ["boite:gauche_ext", "boite:gauche_int", "boite:droite_int"], ""),
    "markers_head.trc": ("trc", ["boite_gauche_ext", "boite_gauche_int", "boite_droite_int"], ""),
    "markers_analogs.c3d": ("c3d", ["boite:gauche_ext", "boite:gauche_int", "boite:droite_int"], ""),
    "motive_headerless.csv": ("motive", ["point 1", "point 2", "point 3"], "up = 'y'"),
    "ndi_aurora.csv": ("aurora", ["a", "b", "d"], ""),
    "fbgs_illumisense_head.txt": ("fbgs", None, ""),
}


@pytest.mark.parametrize("file", LAB)
@pytest.mark.skipif(not REAL.is_dir(), reason="the shared lab files are not here")
def test_real_files(tmp_path, file):
    """Each is imported by a layout of at most 15 lines, and the numbers in it come out."""
    form, names, head = LAB[file]
    if form == "c3d":
        pytest.importorskip("ezc3d")
    what = "bodies" if form == "aurora" else "markers"
    plan = [head, "[base]", "position = [0, 0, 0]", f"[{what}]", f"names = {names}" if names else "", "s_mm = [100, 200, 300]"]
    if form == "fbgs":
        plan = ["[gratings]", "s_mm = [100, 200]", "core_mm = [[0.03, 0], [-0.015, 0.026], [-0.015, -0.026]]"]
        plan += ["cores = [['W-N-01', 'W-N-02', 'W-N-03'], ['W-N-04', 'W-N-05', 'W-N-06']]"]
    assert len(plan) <= 15
    (tmp_path / "rod.toml").write_text(ROD)
    (tmp_path / "layout.toml").write_text("\n".join(plan))
    assert main(["import", form, str(REAL / file), *_options(tmp_path)]) == 0
    rows = [line.split(",") for line in (tmp_path / "o.csv").read_text().splitlines()]
    column = {name: i for i, name in enumerate(rows[0])}
    first = rows[1]
    known = {
        "vicon_markers_head.csv": ("x", 0.0441628),
        "ndi_aurora.csv": ("sample", 0),
        "fbgs_illumisense_head.txt": ("s", 0.1),
        "motive_headerless.csv": ("x", 0.20519),
    }.get(file)
    if known:
        assert float(first[column[known[0]]]) == pytest.approx(known[1], abs=1e-9)
    frames = {row[0] for row in rows[1:]}
    lines = len((REAL / file).read_bytes().splitlines()) if form != "c3d" else 580
    assert len(frames) in range(lines - 7, lines + 1) or form == "c3d"


def test_positions_of_another_frame_are_told(recwarn):
    """A rod that stands 0.7 m beside the origin; noise, stretch and a missing marker are no such thing."""
    s = torch.linspace(0.02, 0.4, 20)
    p = solve_shape(steel_rod(), (PointForces(T([[[0.6, 0.1, 0.0]]]), T([[0.3]])),), None, s, 1).p
    p[0, 3] = torch.nan
    near = p * 1.02 + 5e-3 * torch.randn(p.shape, generator=torch.Generator().manual_seed(0))
    _warn_of_distance("a.csv", Imported(Shapes(s, near, ["0"]), None, None))
    assert not len(recwarn)
    with pytest.warns(UserWarning, match=r"a.csv: 19 of 20 places are farther from the base than the rod reaches"):
        _warn_of_distance("a.csv", Imported(Shapes(s, p + T([0.7, 0.0, 0.0]), ["0"]), None, None))
