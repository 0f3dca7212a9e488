"""Robots in millimetres and degrees, their pose in the lab, and loads in the robot's and in the lab's frame."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.robots import T, steel_rod
from torchrod import PointForces, Shapes, read_robot, solve_shape, write_shapes
from torchrod.cli import main
from torchrod.io import read_base_pose
from torchrod.util.errors import InputError

ROD = (Path(__file__).resolve().parents[1] / "docs" / "example" / "rod.toml").read_text()
AT, FORCE = [0.2, 0.3], [[0.6, 0.2], [-0.3, 0.5]]


@given(
    axis=st.sampled_from([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [-0.3, 0.2, 0.9]]),
    angle=st.sampled_from([0.0, 1e-5, 1.0, math.pi / 2, math.pi - 1e-9, math.pi]),
    form=st.sampled_from(["quaternion", "negative", "vector", "degrees", "matrix"]),
)
@settings(max_examples=60, deadline=None)
def test_every_pose_is_read(tmp_path_factory, axis, angle, form):
    """Against scipy; half a turn about any axis included."""
    turn = Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis))
    key, value = {
        "quaternion": ("rotation", turn.as_quat()),
        "negative": ("rotation", -turn.as_quat()),
        "vector": ("rotation", turn.as_rotvec()),
        "degrees": ("rotation_deg", turn.as_rotvec(degrees=True)),
        "matrix": ("rotation", turn.as_matrix()),
    }[form]
    path = tmp_path_factory.mktemp("pose") / "r.toml"
    path.write_text(f"{ROD}\n[base]\nposition_mm = [100, -200.0, 50]\n{key} = {value.tolist()}\n")
    read_robot(path)
    pose = read_base_pose(path)
    assert pose is not None
    p = T([[0.1, 0.2, 0.3], [1.0, 0.0, -2.0]], dtype=torch.float64)
    assert np.allclose(pose.to_lab(p).numpy(), turn.apply(p.numpy()) + np.array([0.1, -0.2, 0.05]), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("rotation = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]", "is a reflection"),
        ("rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 2]]", "is no rotation matrix"),
        ("rotation = [0, 0, 0, 2]", "quaternion of length 2"),
        ("rotation = 'x'", "give a unit quaternion [x, y, z, w]"),
        ("position = [0, 0, 0]\nposition_mm = [0, 0, 0]", "base.position is given in two units"),
        ("place = [0, 0, 0]", "unknown key 'place'"),
    ],
)
def test_what_is_no_pose(tmp_path, lines, words):
    (tmp_path / "r.toml").write_text(f"{ROD}\n[base]\n{lines}\n")
    with pytest.raises(InputError) as refused:
        read_robot(tmp_path / "r.toml")
    assert words in str(refused.value)


def test_millimetres_and_degrees(tmp_path):
    """The same robot in both units."""
    rod = "youngs_modulus = 207e9\nshear_modulus = 79e9\n"
    tendons = "[[tendons]]\nradius = 0.007\nangle = 1.5707963267948966\nends_at = 0.3\n"
    tendons += "[[tendons]]\nrouting = [[0, 0.007, 0], [0.4, 0, 0.01]]\n"
    in_mm = "[[tendons]]\nradius_mm = 7\nangle_deg = 90\nends_at_mm = 300.0\n"
    in_mm += "[[tendons]]\nrouting_mm = [[0, 7, 0], [400, 0, 10.0]]\n"
    (tmp_path / "a.toml").write_text(f"name = 'r'\n[rod]\nlength = 0.4\ndiameter = 0.0014\n{rod}{tendons}")
    (tmp_path / "b.toml").write_text(f"name = 'r'\n[rod]\nlength_mm = 400\ndiameter_mm = 1.4\n{rod}{in_mm}")
    one, other = (read_robot(tmp_path / f"{name}.toml") for name in "ab")
    assert one.rod.length == pytest.approx(other.rod.length)
    assert torch.allclose(one.rod.K_bt, other.rod.K_bt)
    for a, b in zip(one.tendons.tendons, other.tendons.tendons, strict=True):
        assert np.allclose(a.routing, b.routing, atol=1e-15)
        assert a.ends_at == pytest.approx(b.ends_at)
    for wrong, words in (
        ("ends_at_mm = 500", "beyond the rod"),
        ("ends_at_mm = 'x'", "must be a number"),
        ("radius = 1", "two units"),
    ):
        (tmp_path / "b.toml").write_text(
            f"[rod]\nlength_mm = 400\ndiameter_mm = 1.4\n{rod}[[tendons]]\nradius_mm = 7\nangle_deg = 9\n{wrong}"
        )
        with pytest.raises(InputError, match=words):
            read_robot(tmp_path / "b.toml")


def test_loads_in_the_robots_and_in_the_labs_frame(tmp_path):
    """Known pushes of a rod that hangs at an angle in the lab: their force and place come back in either frame."""
    turn, origin = Rotation.from_rotvec([0.0, math.pi, 0.0]) * Rotation.from_rotvec([0.3, -0.4, 1.0]), np.array([1.0, -2.0, 0.5])
    (tmp_path / "r.toml").write_text(f"{ROD}\n[base]\nposition = {origin.tolist()}\nrotation = {turn.as_matrix().tolist()}\n")
    force = torch.nn.functional.pad(T(FORCE, dtype=torch.float64), (0, 1)).unsqueeze(1)
    loads, s = (
        (PointForces(force, T(AT, dtype=torch.float64).unsqueeze(-1)),),
        T([*np.linspace(0.02, 0.4, 20), *AT]).sort().values.unique(),
    )
    shape = solve_shape(steel_rod(), loads, None, s, 2, 200)
    write_shapes(tmp_path / "s.npz", Shapes(s, shape.p, ["a", "b"], time=T([0.25, 0.5])))
    command = ["estimate", str(tmp_path / "r.toml"), str(tmp_path / "s.npz"), "--load-prior", "point", "--noise", "1e-4"]
    for suffix in ("json", "npz", "csv"):
        assert main([*command, "--out", str(tmp_path / f"o.{suffix}")]) == 0
    records = json.loads((tmp_path / "o.json").read_text())["results"]
    arrays = np.load(tmp_path / "o.npz")
    rows = list(csv.DictReader((tmp_path / "o.csv").open()))
    assert list(rows[0])[:2] == ["time_s", "sample"]
    for b, (record, row) in enumerate(zip(records, rows, strict=True)):
        (load,) = record["loads"]
        at = int((s - AT[b]).abs().argmin())
        q = Rotation.from_quat(shape.q[b, at].numpy())
        pushed, place = q.apply([*FORCE[b], 0.0]), shape.p[b, at].numpy()
        assert np.allclose(load["force_base_N"], pushed, atol=5e-3)
        assert np.allclose(load["position_m"], place, atol=1e-3)
        assert np.allclose(load["force_lab_N"], turn.apply(load["force_base_N"]), atol=1e-12)
        assert np.allclose(load["position_lab_m"], turn.apply(load["position_m"]) + origin, atol=1e-12)
        assert record["time_s"] == arrays["time_s"][b] == float(row["time_s"]) == [0.25, 0.5][b]
        for name, unit in (("magnitude", "N"), ("location", "m")):
            ends = [float(row[f"{name}_{end}_{unit}"]) for end in ("low", "high")]
            assert ends == pytest.approx(load["interval_95"][f"{name}_{unit}"])
        for name in ("force_base_N", "position_m", "force_lab_N", "position_lab_m", "force_local_N"):
            quantity, _, unit = name.rpartition("_")
            in_row = [float(row[f"{quantity}_{axis}_{unit}"]) for axis in "xyz"[: len(load[name])]]
            assert load[name] == arrays[name][b, 0].tolist() == in_row
        assert load["location_m"] == arrays["location_m"][b, 0] == float(row["location_m"])


def test_a_frame_that_was_found_moves_the_robot_in_the_lab(tmp_path):
    """Markers given in a frame that is off: the lab's place is where the rod is, the base's where it is on it."""
    robot, off = steel_rod(), Rotation.from_rotvec([0.02, -0.03, 0.0])
    s = T(np.linspace(0, 0.4, 21))
    force = T([[[0.6, 0.2, 0.0]]], dtype=torch.float64)
    shape = solve_shape(robot, (PointForces(force, T([[0.2]], dtype=torch.float64)),), None, s, 1, 200)
    seen = T(off.apply(shape.p[0].numpy()) + np.array([0.002, 0.001, -0.001]))[None]
    (tmp_path / "r.toml").write_text(f"{ROD}\n[base]\nposition = [0.0, 0.0, 1.0]\n")
    write_shapes(tmp_path / "s.csv", Shapes(s, seen, ["0"]))
    out = tmp_path / "o.json"
    command = ["estimate", str(tmp_path / "r.toml"), str(tmp_path / "s.csv"), "--load-prior", "point", "--noise", "1e-5"]
    assert main([*command, "--registration", "--location", "0.2", "--out", str(out)]) == 0
    (load,) = json.loads(out.read_text())["results"][0]["loads"]
    assert np.allclose(load["position_m"], shape.p[0, 10].numpy(), atol=2e-4)
    assert np.allclose(load["position_lab_m"], seen[0, 10].numpy() + np.array([0, 0, 1]), atol=2e-4)
    q = Rotation.from_quat(shape.q[0, 10].numpy())
    assert np.allclose(load["force_lab_N"], (off * q).apply([0.6, 0.2, 0.0]), atol=1e-2)


def test_profiles_of_a_large_batch_are_written_where_they_are_asked_for(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("torchrod.cli.estimate.MOST_PROFILES", 1)
    (tmp_path / "r.toml").write_text(ROD)
    shape = solve_shape(steel_rod(), (), None, T(np.linspace(0.05, 0.4, 8)), 2)
    write_shapes(tmp_path / "s.csv", Shapes(T(np.linspace(0.05, 0.4, 8)), shape.p, ["a", "b"]))
    for option, written in ((["--profile", "on"], True), (["--profile", "off"], False), ([], False)):
        out = tmp_path / "o.json"
        assert main(["estimate", str(tmp_path / "r.toml"), str(tmp_path / "s.csv"), "--out", str(out), *option]) == 0
        assert all(("profile" in record) == written for record in json.loads(out.read_text())["results"])
        assert ("--profile on writes them" in capsys.readouterr().err) == (not option)
