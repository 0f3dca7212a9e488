"""What one row of SHAPES may hold beside a position: its own noise, an orientation, the base's wrench, a time, another unit."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.robots import T, steel_rod
from torchrod import (
    BaseWrench,
    GaussianCoordinates,
    Markers,
    PointForces,
    PointWrenches,
    Poses,
    Problem,
    Robot,
    Rod,
    Shapes,
    Unknowns,
    estimate,
    read_shapes,
    solve_shape,
    write_shapes,
)
from torchrod.cli import main
from torchrod.io import KINDS
from torchrod.mechanics.lie import conjugate, exponential, product
from torchrod.util.errors import InputError

ROD = (Path(__file__).resolve().parents[1] / "docs" / "example" / "rod.toml").read_text()
S = T([0.1, 0.2, 0.3, 0.4], dtype=torch.float64)


def random_shapes(seed: int, gaps: bool = True) -> Shapes:
    """Everything that a file may hold, of three samples; some of it missing."""
    g = torch.Generator().manual_seed(seed)
    q = torch.nn.functional.normalize(torch.randn(3, 4, 4, generator=g), dim=-1)
    readings = {
        "position_std": 1e-3 + torch.rand(3, 4, 1, generator=g),
        "orientations": q,
        "curvature": torch.randn(3, 4, 2, generator=g),
        "base_wrench": torch.randn(3, 6, generator=g),
    }
    positions = 0.1 * torch.randn(3, 4, 3, generator=g)
    if gaps:
        for value in (positions, *(readings[k] for k in ("position_std", "orientations", "curvature"))):
            value[torch.rand(3, 4, generator=g) < 0.3] = torch.nan
    offsets, time = 0.01 * torch.randn(4, 3, generator=g), 0.01 * torch.arange(3)
    return Shapes(S, positions, ["a", "b", "c"], offsets, None, time, readings)


def assert_alike(one: Shapes, other: Shapes, tolerance: float = 0.0) -> None:
    assert one.samples == other.samples
    assert one.readings.keys() == other.readings.keys()
    assert one.offsets is not None and other.offsets is not None and one.time is not None and other.time is not None
    pairs = [(one.readings[k], other.readings[k]) for k in one.readings]
    pairs += [(one.s, other.s), (one.positions, other.positions), (one.offsets, other.offsets), (one.time, other.time)]
    for a, b in pairs:
        assert torch.allclose(a, b, rtol=tolerance, atol=0, equal_nan=True)


@given(seed=st.integers(0, 10**6), suffix=st.sampled_from([".csv", ".npz"]))
@settings(max_examples=30, deadline=None)
def test_what_is_written_is_read(tmp_path_factory, seed, suffix):
    path, shapes = tmp_path_factory.mktemp("round") / f"s{suffix}", random_shapes(seed)
    write_shapes(path, shapes)
    assert_alike(read_shapes(path, steel_rod()), shapes)


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1e3), ("cm", 1e2), ("in", 1 / 0.0254)])
@pytest.mark.parametrize("said", ["remark", "option"])
def test_units(tmp_path, unit, factor, said):
    """Lengths scale; curvatures, forces and rotations do not."""
    shapes = random_shapes(1)
    names = ("sample", "time", "s", "x", "y", "z", "rx", "ry", "rz", "sx", "kx", "ky", "qw", "qx", "qy", "qz")
    lines = [",".join([*names, *KINDS[-1].columns])]
    assert shapes.offsets is not None and shapes.time is not None
    of = shapes.readings
    for b, name in enumerate(shapes.samples):
        for i in range(4):
            lengths = [S[i], *shapes.positions[b, i], *shapes.offsets[i], *of["position_std"][b, i]]
            q = of["orientations"][b, i].tolist()
            row = [factor * float(v) for v in lengths] + of["curvature"][b, i].tolist() + [q[3], *q[:3]]
            base = of["base_wrench"][b].tolist() if i == 2 else [np.nan] * 6  # once for a sample will do
            lines.append(",".join([name, repr(float(shapes.time[b])), *("" if v != v else repr(v) for v in row + base)]))
    path = tmp_path / "s.csv"
    path.write_text("\n".join([f'# units = "{unit}"'] * (said == "remark") + lines))
    found = read_shapes(path, steel_rod(), unit if said == "option" else None)
    assert_alike(found, shapes, 1e-12)
    if said == "remark":
        assert_alike(read_shapes(path, steel_rod(), unit), shapes, 1e-12)
        with pytest.raises(InputError, match="but --units is m; give one of them"):
            read_shapes(path, steel_rod(), "m")


def test_unknown_columns_are_named_once(tmp_path):
    rows = [f"{b},{s},0,0,{s},q,w" for b in range(50) for s in (0.1, 0.2)]
    (tmp_path / "s.csv").write_text("\n".join(["time,s,x,y,z,quality,Operator", *rows]))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        shapes = read_shapes(tmp_path / "s.csv", steel_rod())
    assert [str(w.message).split("known:")[0] for w in said] == [
        f"{tmp_path / 's.csv'}: columns 'quality', 'operator' are not known and ignored; "
    ]
    assert shapes.samples == [str(b) for b in range(50)]  # a time is a sample where none is named
    assert shapes.time is not None and shapes.time.tolist() == list(range(50))


def seen_tip_pushes(count: int) -> tuple[torch.Tensor, Shapes, Poses, BaseWrench]:
    """The steel rod under forces at its tip: its poses at S and its base wrench, with noise."""
    g = torch.Generator().manual_seed(5)
    force = 0.2 * torch.randn(count, 1, 3, generator=g)
    shape = solve_shape(steel_rod(), (PointWrenches(force, torch.zeros_like(force), T([0.4])),), None, S, count, 80)
    p = shape.p + 5e-4 * torch.randn(shape.p.shape, generator=g)
    q = product(shape.q, exponential(0.02 * torch.randn(shape.p.shape, generator=g)))
    wrench = shape.base_wrench + torch.tensor([0.02] * 3 + [0.004] * 3) * torch.randn(count, 6, generator=g)
    p[:, 1], q[:, 0] = torch.nan, torch.nan  # of one sensor only the orientation, of one only the position
    readings = {"orientations": q, "base_wrench": wrench}
    shapes = Shapes(S, p, [str(b) for b in range(count)], readings=readings)
    return force[:, 0], shapes, Poses(S[1:], p[:, 1:], q[:, 1:], 5e-4, 0.02), BaseWrench(wrench, 0.02, 0.004)


def test_the_command_fits_all_that_was_read(tmp_path, capsys):
    """Positions, poses and base wrench from one file: the answer of the library with these sensors and this noise."""
    force, shapes, poses, base = seen_tip_pushes(12)
    (tmp_path / "rod.toml").write_text(ROD)
    write_shapes(tmp_path / "s.csv", shapes)
    options = ["--contacts", "0", "--unknown-tip", "force", "--noise", "5e-4", "--angle-noise", "0.02"]
    command = ["estimate", str(tmp_path / "rod.toml"), str(tmp_path / "s.csv"), *options]
    assert main(command) == 2
    assert "give --base-noise FORCE MOMENT" in capsys.readouterr().err
    assert main([*command, "--base-noise", "0.02", "0.004", "--out", str(tmp_path / "r.json")]) == 0
    records = json.loads((tmp_path / "r.json").read_text())["results"]
    markers = Markers(S[:1], shapes.positions[:, :1], 5e-4)
    unknowns = Unknowns(GaussianCoordinates(0, 0.4, steel_rod().rod.force_scale), tip="force")
    fit = estimate(Problem(steel_rod(), unknowns, [markers, poses, base]))
    assert fit.tip is not None and fit.tip_covariance is not None
    found = T([r["tip"]["force_N"] for r in records], dtype=torch.float64)
    assert torch.allclose(found, fit.tip[:, :3], atol=1e-9)
    spread = fit.tip_covariance.diagonal(dim1=-2, dim2=-1)[:, :3].sqrt()
    assert ((found - force) / spread).abs().max() < 4
    assert all(r["accepted"] for r in records)


def test_a_stated_noise_weighs_its_row(tmp_path):
    """A marker that is off by 5 cm, and says so, counts nothing: the fit is that without it. An empty cell means --noise."""
    (tmp_path / "rod.toml").write_text(ROD)
    robot, shape = str(tmp_path / "rod.toml"), tmp_path / "s.csv"
    assert main(["simulate", robot, "--point", "0.27", "0.5", "0.3", "--noise", "5e-4", "--out", str(shape)]) == 0
    header, *rows = shape.read_text().split()
    cells = [row.split(",") for row in rows]
    gone = [row if i != 9 else ",".join([*row.split(",")[:2], "", "", ""]) for i, row in enumerate(rows)]
    off = [",".join([*c, "5e-4" if i % 2 else ""]) for i, c in enumerate(cells)]
    off[9] = ",".join([*cells[9][:2], repr(float(cells[9][2]) + 0.05), *cells[9][3:], "1e3"])
    found = []
    for lines in ([header, *gone], [header + ",sx", *off]):
        shape.write_text("\n".join(lines))
        assert (
            main(["estimate", robot, str(shape), "--noise", "5e-4", "--warm-start", "off", "--out", str(tmp_path / "r.json")]) == 0
        )
        (record,) = json.loads((tmp_path / "r.json").read_text())["results"]
        assert record["accepted"]
        found.append([record["loads"][0]["location_m"], *record["loads"][0]["force_local_N"], record["chi2"]])
    assert found[0] == pytest.approx(found[1], rel=1e-4)


def test_curvatures_alone_from_the_file_to_the_figure(tmp_path, capsys):
    """Gratings every 20 mm of a rod under one push: the load is found, and drawn again from the result."""
    rod = Rod.circular(0.4, 0.0014, 207e9, 79e9)
    s = torch.linspace(0.02, 0.38, 19, dtype=torch.float64)
    push = PointForces(torch.tensor([[[0.5, 0.2, 0.0]]], dtype=torch.float64), torch.tensor([[0.3]], dtype=torch.float64))
    q = solve_shape(Robot(rod), (push,), None, torch.cat([s - 1e-3, s + 1e-3]).sort().values, 1).q[0]
    turn = 2 * product(conjugate(q[::2]), q[1::2])[:, :2] / 2e-3
    rows = [f"{a},{x},{y}" for a, (x, y) in zip(s.tolist(), turn.tolist(), strict=True)]
    (tmp_path / "s.csv").write_text("s,kx,ky\n" + "\n".join(rows) + "\n")
    (tmp_path / "r.toml").write_text("[rod]\nlength = 0.4\ndiameter = 0.0014\nyoungs_modulus = 207e9\nshear_modulus = 79e9\n")
    paths = [str(tmp_path / name) for name in ("r.toml", "s.csv", "r.json")]
    assert main(["estimate", *paths[:2], "--curvature-noise", "0.02", "--out", paths[2]]) == 0
    (load,) = json.loads((tmp_path / "r.json").read_text())["results"][0]["loads"]
    assert abs(load["magnitude_N"] - 0.29**0.5) < 3 * load["std"]["magnitude_N"]
    assert abs(load["location_m"] - 0.3) < 3 * load["std"]["location_m"]
    assert main(["plot", *paths, "--out", str(tmp_path / "f.png")]) == 0
    assert (tmp_path / "f.png").stat().st_size > 1000
    assert main(["estimate", *paths[:2]]) == 2
    assert "--curvature-noise" in capsys.readouterr().err
