"""Calibration: the truth is found from noisy unloaded shapes, the intervals are honest, and the robot file carries it on."""

import json
import math
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.problems import unknowns_of
from torchrod import (
    Markers,
    PointForces,
    Problem,
    Robot,
    Rod,
    Settings,
    Shapes,
    Tendon,
    Tendons,
    calibrate,
    estimate,
    read_robot,
    shape_from_base,
    solve_shape,
    write_shapes,
)
from torchrod.cli import main
from torchrod.estimation.joint import Shared, fit_jointly
from torchrod.io import read_fit, read_uncertainty
from torchrod.mechanics.lie import rotate
from torchrod.util.status import Status

T = torch.tensor
NOISE = 2.5e-4
STEPS = 12
SIDEWAYS = T([9.81, 0.0, 0.0], dtype=torch.float64)
OFFSETS = (0.3, -0.2)


def one_tendon(mass: float = 0.144, E: float = 207e9, offsets: tuple[float, ...] = (0.0,)) -> Robot:
    rod = Rod.circular(0.4, 0.0014, E, E * 79 / 207, mass)
    return Robot(rod, Tendons((Tendon.straight(0.007, 0.0, 0.4, offsets[0]),)), SIDEWAYS)


def two_tendons(mass: float = 0.252, E: float = 207e9, offsets: tuple[float, ...] = (0.0, 0.0)) -> Robot:
    rod = Rod.circular(0.56, 0.002, E, E * 79 / 207, mass)
    tendons = (Tendon.straight(0.025, 0.0, 0.56, offsets[0]), Tendon.straight(0.0, 0.025, 0.28, offsets[1]))
    return Robot(rod, Tendons(tendons), SIDEWAYS)


ROBOTS = {
    "one tendon": (one_tendon, 0.144, [[0.0], [2.0], [4.0], [6.0], [8.0]]),
    "two tendons": (two_tendons, 0.252, [[0.0, 0.0], [3.0, 0.0], [0.0, 3.0], [2.0, 4.0], [5.0, 1.0]]),
}


def shapes_of(robot: Robot, tension: list[list[float]], seed: int = 0, count: int = 8, noise: float = NOISE) -> Shapes:
    L, generator = robot.rod.length, torch.Generator().manual_seed(seed)
    s, tau = torch.linspace(L / count, L, count), T(tension)
    p = solve_shape(robot, (), tau, s, len(tau), STEPS).p
    return Shapes(s, p + noise * torch.randn(p.shape, generator=generator), [f"shape-{b}" for b in range(len(tau))], None, tau)


def run(robot: Robot, shapes: Shapes, stiffness: bool = False, offsets: bool = False, noise: float = NOISE, **rest):
    return calibrate(robot, shapes.markers(noise), shapes.tension, stiffness, offsets, steps=STEPS, **rest)


@pytest.mark.parametrize("name", ROBOTS)
def test_the_mass_is_found(name):
    make, mass, tension = ROBOTS[name]
    found = run(make(0.7 * mass), shapes_of(make(), tension))
    assert found.status is Status.CONVERGED
    assert found.accepted
    assert found.names == ("mass_per_length",)
    assert abs(float(found.values[0]) - mass) < min(3 * float(found.std[0]), 0.02 * mass)
    assert float(found.std[0]) < 0.002 * mass
    assert found.rms_residual == pytest.approx(NOISE * math.sqrt(3), rel=0.2)


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize(("stiffness", "offsets"), [(True, False), (False, True), (True, True)])
def test_stiffness_and_offsets_are_found_where_asked(name, stiffness, offsets):
    make, mass, tension = ROBOTS[name]
    truth = make(offsets=OFFSETS) if offsets else make()
    wrong = make(0.8 * mass, E=180e9 if stiffness else 207e9)
    found = run(wrong, shapes_of(truth, tension, 3), stiffness, offsets)
    assert found.accepted
    expected = [mass, *([207 / 180] if stiffness else []), *(OFFSETS[: len(tension[0])] if offsets else [])]
    assert bool(((found.values - T(expected)).abs() < 3 * found.std).all()), (found.values, found.std)
    assert bool(((found.values / T(expected) - 1).abs()[: 1 + stiffness] < 0.02).all())
    assert not found.undetermined
    robot = found.applied(wrong)
    assert torch.allclose(robot.rod.K_bt, truth.rod.K_bt, rtol=0.02)
    assert torch.allclose(robot.rod.K_se, truth.rod.K_se, rtol=0.02)


@pytest.mark.parametrize("factor", [0.05, 20.0])
@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.many_fits
def test_far_starts_end_at_the_same_place(name, factor):
    make, mass, tension = ROBOTS[name]
    shapes = shapes_of(make(), tension)
    near, far = run(make(), shapes), run(make(factor * mass), shapes)
    everything = run(make(factor * mass, E=150e9), shapes, True, True) if factor < 1 else far
    assert everything.accepted
    assert float((far.values - near.values).abs()) < 0.1 * float(near.std)


def test_without_a_mass_to_start_from():
    make, mass, tension = ROBOTS["two tendons"]
    found = run(make(0.0), shapes_of(make(), tension))
    assert float(found.before[0]) == 0
    assert abs(float(found.values[0]) / mass - 1) < 0.02


@pytest.mark.many_fits
def test_offsets_at_the_kink_of_a_slack_tendon():
    """Readings of zero and offsets near zero: the cost has a kink where the search starts, and often its minimum there."""
    make, mass, tension = ROBOTS["two tendons"]
    p = shapes_of(make(), tension, noise=0.0)
    for seed in range(2):
        noise = NOISE * torch.randn(p.positions.shape, generator=torch.Generator().manual_seed(seed))
        found = run(make(0.8 * mass), replace(p, positions=p.positions + noise), seed % 2 == 0, True)
        assert found.accepted
        assert found.iterations < 15
        assert bool((found.values[-2:].abs() < 3 * found.std[-2:]).all())


@pytest.mark.many_fits
@pytest.mark.study
def test_the_interval_of_log_mass_covers():
    """200 repeats of two shapes with three markers: 90 to 99 % of the 95 % intervals hold the truth."""
    rod = Robot(Rod.circular(0.4, 0.0014, 207e9, 79e9, 0.003), gravity=SIDEWAYS)
    s = torch.linspace(0.15, 0.4, 3)
    p = solve_shape(rod, (), None, s, 2, 4).p
    generator, held, repeats = torch.Generator().manual_seed(5), 0, 200
    for _ in range(repeats):
        markers = Markers(s, p + 2e-4 * torch.randn(p.shape, generator=generator), 2e-4)
        low, high = calibrate(rod, markers, steps=4).interval_95[0].tolist()
        held += low <= 0.003 <= high
    assert 0.90 <= held / repeats <= 0.99, held


def test_residuals_larger_than_the_noise_widen_the_standard_deviations():
    make, _, tension = ROBOTS["one tendon"]
    shapes = shapes_of(make(), tension)
    honest, small = run(make(), shapes), run(make(), shapes, noise=NOISE / 5)
    assert small.rescaled
    assert not small.accepted
    assert float(small.std_noise[0]) < 0.3 * float(honest.std[0])
    assert float(small.std[0]) == pytest.approx(float(honest.std_noise[0]) * math.sqrt(honest.chi2 / honest.dof), rel=1e-2)
    assert "state more noise" in small.message


@pytest.mark.many_fits
def test_missing_markers_weigh_nothing_and_lost_samples_are_named():
    make, mass, tension = ROBOTS["one tendon"]
    tension = [*tension, [1e7]]  # no equilibrium: it would crush the rod
    known = shapes_of(make(), tension[:5])
    p = torch.cat([known.positions, known.positions[-1:]])
    p[0] = torch.nan
    p[1, 2:4] = torch.nan
    found = run(make(), Shapes(known.s, p, list("abcdef"), None, T(tension)))
    assert found.used.tolist() == [False, True, True, True, True, False]
    assert found.dof == 3 * (8 * 4 - 2) - 1
    assert found.accepted
    assert abs(float(found.values[0]) - mass) < 3 * float(found.std[0])
    tension[2] = [math.nan]
    assert run(make(), Shapes(known.s, p, list("abcdef"), None, T(tension))).used.tolist() == [
        False,
        True,
        False,
        True,
        True,
        False,
    ]


def test_markers_beside_the_centre_line_and_gravity_of_each_sample():
    make, mass, tension = ROBOTS["two tendons"]
    truth = replace(make(), gravity=T([[9.81, 0, 0], [0, 9.81, 0], [0, 0, 9.81], [0, 6.9, -6.9], [-9.81, 0, 0]]))
    s, tau, offsets = torch.linspace(0.07, 0.56, 8), T(tension), 0.02 * torch.eye(3).repeat(3, 1)[:8]
    shape = solve_shape(truth, (), tau, s, 5, STEPS)
    noise = NOISE * torch.randn(shape.p.shape, generator=torch.Generator().manual_seed(1))
    shapes = Shapes(s, shape.p + rotate(shape.q, offsets) + noise, list("abcde"), offsets, tau)
    found = run(replace(truth, rod=make(0.1).rod), shapes, True)
    assert found.accepted
    assert abs(float(found.values[0]) - mass) < 3 * float(found.std[0])


def test_a_parameter_that_does_not_show_is_named():
    make, _, _ = ROBOTS["two tendons"]
    up = replace(make(), gravity=T([0.0, 0.0, -9.81]))
    straight = Rod.circular(0.56, 0.02, 207e9, 79e9, 0.252)  # stiff, and gravity along it
    robot = replace(up, rod=straight, tendons=Tendons(()))
    s = torch.linspace(0.1, 0.56, 5)
    found = calibrate(robot, Markers(s, solve_shape(robot, (), None, s, 1, STEPS).p, 1e-3), steps=STEPS)
    assert found.undetermined == ("mass_per_length",)
    assert "hardly determine mass_per_length" in found.message and "--hold-mass" in found.message


@pytest.mark.many_fits
def test_too_few_iterations_are_reported():
    make, mass, tension = ROBOTS["one tendon"]
    found = run(make(3 * mass), shapes_of(make(), tension), settings=Settings(max_iterations=2))
    assert found.status is Status.NOT_CONVERGED
    assert not found.accepted
    assert bool(found.std.isnan().all())
    assert "Did not converge in 2 iterations" in found.message


@pytest.mark.parametrize("fast", ["1", "0"])
def test_an_offset_shifts_the_readings(fast, monkeypatch):
    """tension_offset = d is the same as readings larger by d, and a tendon never pushes: forward solve, march and Jacobian."""
    if fast == "0":
        monkeypatch.setattr("torchrod.kernel.available", lambda: False)
    readings, d = T([[1.0, 2.0], [0.1, 3.0]]), T([0.3, -0.4])
    offset, plain = two_tendons(offsets=(0.3, -0.4)), two_tendons()
    s = T([0.56])
    a, b = solve_shape(offset, (), readings, s, 2, 2), solve_shape(plain, (), readings + d, s, 2, 2)
    assert float((a.p - b.p).abs().max()) < 1e-12
    alpha = 0.1 * torch.ones(2, 6)
    marched = [shape_from_base(r, (), alpha, t, s, 2).p for r, t in ((offset, readings), (plain, readings + d))]
    assert float((marched[0] - marched[1]).abs().max()) < 1e-12
    unknowns = unknowns_of(plain)
    x = 0.1 * torch.ones(2, unknowns.loads.size + 6)
    seen = [
        Problem(r, unknowns, [Markers(s, a.p, NOISE)], t, steps=2).linearized(x)
        for r, t in ((offset, readings), (plain, readings + d))
    ]
    assert all(float((u - v).abs().max()) < 1e-12 * float(u.abs().max()) for u, v in zip(*seen, strict=True))
    slack, none = ((two_tendons(offsets=(-5.0, -5.0)), readings), (plain, 0 * readings))
    assert torch.equal(*(shape_from_base(r, (), alpha, t, s, 2).p for r, t in (slack, none)))
    if fast == "1":
        assert torch.equal(*(solve_shape(r, (), t, s, 2, 2).p for r, t in (slack, none)))


TOML = """# our robot
name = "bench"  # [rod]
[rod]
mass_per_length = 0.05   # a guess
length = 0.56
{section}
gravity = [9.81, 0.0, 0.0]

[[tendons]]
  offset = [0.025, 0.0]  # the long one
  ends_at = 0.56

# the short one
[[tendons]]
offset = [0.0, 0.025]
tension_offset = 0.0 # was zeroed
ends_at = 0.28"""
CIRCLE = "diameter = 0.002\nyoungs_modulus = 180e9  # a guess too\nshear_modulus = 68_695_652_173.9"
MATRIX = """K_se = [216e3, 216e3, # both 1
  565e3]
K_bt = [
  [0.1413716694, 0, 0], # E I, 2
  [0, 0.1413716694, 0],
  [0, 0, 0.1079],
]"""


def files(folder: Path, robot: str, shapes: Shapes) -> tuple[str, str]:
    path, written = folder / "robot.toml", folder / "shapes.csv"
    path.write_bytes(robot.encode())
    write_shapes(written, shapes)
    return str(path), str(written)


@pytest.mark.parametrize("section", [CIRCLE, MATRIX], ids=["circle", "matrix"])
@pytest.mark.parametrize("end", ["\n", "\r\n"], ids=["lf", "crlf"])
@pytest.mark.many_fits
def test_the_text_of_the_robot_file_is_kept(tmp_path, capsys, section, end):
    text = TOML.format(section=section).replace("\n", end)
    truth = two_tendons(offsets=OFFSETS)
    robot, shapes = files(tmp_path, text, shapes_of(truth, ROBOTS["two tendons"][2], 3))
    out, record = tmp_path / "out.toml", tmp_path / "out.json"
    options = ["--noise", "2.5e-4", "--youngs-modulus", "--tension-offset", "--out", str(out), "--json", str(record)]
    assert main(["calibrate", robot, shapes, *options]) == 0
    screen = capsys.readouterr().out
    assert "mass_per_length (kg/m)" in screen
    assert ("youngs_modulus (Pa)" in screen) == (section == CIRCLE)
    result = json.loads(record.read_text())
    assert result["status"] == "converged"
    after = {p["name"]: p["after"] for p in result["parameters"]}
    assert after["mass_per_length"] == pytest.approx(0.252, rel=0.02)
    written, read = out.read_bytes().decode(), read_robot(out)
    assert float(read.rod.mass_per_length) == pytest.approx(after["mass_per_length"], rel=1e-8)
    assert torch.allclose(read.rod.K_bt, after["stiffness_factor"] * read_robot(robot).rod.K_bt, rtol=1e-8)
    assert [t.tension_offset for t in read.tendons.tendons] == pytest.approx(
        [after[f"tension_offset_{j}"] for j in (1, 2)], rel=1e-8
    )
    body, table, found = written.partition(f"{end}[calibration]")
    assert table
    assert tomllib.loads(table + found)["calibration"]["parameters"] == [
        "mass",
        "stiffness",
        "tension_offset_1",
        "tension_offset_2",
    ]
    old, new = text.split(end), body.rstrip().split(end)
    assert len(new) == len(old) + 1  # one tension_offset was added, indented like its table
    assert sum(line.startswith("  tension_offset = ") for line in new) == 1
    assert [line.partition("#")[2] for line in new if "#" in line] == [line.partition("#")[2] for line in old if "#" in line]
    assert {line for line in old if "=" in line} - set(new) <= {
        line for line in old if any(w in line for w in ("guess", "modulus", "zeroed", "K_"))
    }
    assert tomllib.loads(written)["name"] == "bench"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.json", "out.toml", "robot.toml", "shapes.csv"]


def test_text_that_cannot_be_edited_leaves_no_file(tmp_path, capsys):
    inline = "rod = {length = 0.4, diameter = 0.0014, youngs_modulus = 207e9, shear_modulus = 79e9, gravity = [9.81, 0, 0]}\n"
    rod = Robot(Rod.circular(0.4, 0.0014, 207e9, 79e9, 0.144), gravity=SIDEWAYS)
    s = torch.linspace(0.1, 0.4, 4)
    robot, shapes = files(tmp_path, inline, Shapes(s, solve_shape(rod, (), None, s, 1, STEPS).p, ["0"]))
    out = tmp_path / "out.toml"
    assert main(["calibrate", robot, shapes, "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert "must be plain tables" in error
    assert error.count("\n") == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["robot.toml", "shapes.csv"]


@pytest.mark.many_fits
def test_a_calibrated_robot_estimates_better(tmp_path):
    """By the command line: mass and offsets from unloaded shapes, then the load on a loaded one."""
    truth, load = two_tendons(offsets=OFFSETS), PointForces(T([[[0.6, -0.3, 0.0]]]), T([[0.4]]))
    text = TOML.format(section="diameter = 0.002\nyoungs_modulus = 207e9\nshear_modulus = 79e9")
    robot, shapes = files(tmp_path, text, shapes_of(truth, ROBOTS["two tendons"][2]))
    out = str(tmp_path / "out.toml")
    assert main(["calibrate", robot, shapes, "--noise", "2.5e-4", "--tension-offset", "--out", out]) == 0
    s, tension = torch.linspace(0.07, 0.56, 8), T([[3.0, 2.0]])
    p = solve_shape(truth, (load,), tension, s, 1, 40).p
    loaded = Markers(s, p + NOISE * torch.randn(p.shape, generator=torch.Generator().manual_seed(9)), NOISE)
    error = {}
    for name in (robot, out):
        known = read_robot(name)
        fit = estimate(Problem(known, unknowns_of(known, prior="point"), [loaded], tension))
        error[name] = float((fit.force[0, 0] - T([0.6, -0.3])).norm()), float((fit.location[0, 0] - 0.4).abs())
        assert bool(fit.accepted[0]) == (name == out)
    assert error[out][0] < 0.05
    assert error[out][1] < 0.02
    assert error[robot][0] > 3 * error[out][0]


STANDING = """[rod]
length = 0.3
diameter = 0.0018
inner_diameter = 0.0014
youngs_modulus = 60e9
shear_modulus = 23e9
mass_per_length = 0.0065
gravity = [0, 0, -9.81]
"""


@pytest.mark.parametrize(
    ("push", "gravity"),
    [
        ((0.18, 0.4, 0.2), "0, 0, -9.81"),
        ((0.1, 1.0, 0.0), "0, 0, -9.81"),
        ((0.27, -0.3, 0.1), "0, 0, -9.81"),
        ((0.18, 0.4, 0.2), "9.81, 0, 0"),
    ],
)
@pytest.mark.many_fits
def test_a_shape_that_something_pushes_calibrates_nothing(tmp_path, capsys, push, gravity):
    """It once came to hundreds of kg/m, known to a millionth, with a chi^2 of -1e137, and was written."""
    (tmp_path / "upright.toml").write_text(STANDING)
    robot, s = read_robot(tmp_path / "upright.toml"), torch.linspace(0.025, 0.3, 12)
    p = solve_shape(robot, (PointForces(T([[[*push[1:], 0.0]]]), T([[push[0]]])),), None, s, 1).p
    positions = p + 5e-4 * torch.randn(p.shape, generator=torch.Generator().manual_seed(1))
    path, shapes = files(tmp_path, STANDING.replace("0, 0, -9.81", gravity), Shapes(s, positions, ["0"]))
    out = tmp_path / "out.toml"
    assert main(["calibrate", path, shapes, "--noise", "5e-4", "--out", str(out)]) == 0
    captured = capsys.readouterr()
    assert "out.toml: not written" in captured.err and not out.exists()
    assert ("% of its length" in captured.err) == (gravity == "9.81, 0, 0")
    assert "Converged." not in captured.out and "chi2/dof -" not in captured.out


PASSIVE = "[rod]\nlength = 0.4\ndiameter = 0.0014\nyoungs_modulus = 207e9\nshear_modulus = 79e9\ngravity = [9.81, 0, 0]\n"
PULLED = PASSIVE + "[[tendons]]\noffset = [0.007, 0.0]\n"
STRAIGHT = "s,x,y,z\n" + "".join(f"{0.1 * i:g},{0.01 * i * i:g},0,{0.1 * i:g}\n" for i in range(1, 5))
SLACK = "s,x,y,z,tension_1\n0.2,0.01,0,0.2,0\n0.4,0.04,0,0.39,0\n"
REFUSED = {
    "no gravity": (PASSIVE.replace("gravity = [9.81, 0, 0]\n", ""), STRAIGHT, [], "add gravity = [x, y, z]"),
    "ratio only": (PASSIVE, STRAIGHT, ["--youngs-modulus"], "drop --youngs-modulus"),
    "slack only": (PULLED, SLACK, ["--youngs-modulus"], "add shapes with tension"),
    "no tendons": (PASSIVE, STRAIGHT, ["--tension-offset"], "drop --tension-offset"),
    "few markers": (
        PULLED,
        "s,x,y,z,tension_1\n0.4,0.1,0,0.3,1\n",
        ["--youngs-modulus", "--tension-offset"],
        "add markers or shapes",
    ),
    "no markers": (PASSIVE, "s,x,y,z\n0.2,,,\n0.4,,,\n", [], "add markers or shapes"),
    "all crushed": (PULLED, SLACK.replace(",0\n", ",1e8\n"), [], "no sample has markers, finite tensions and an equilibrium"),
    "noise": (PASSIVE, STRAIGHT, ["--noise", "0"], "from 1e-9 to 1"),
    "iterations": (PASSIVE, STRAIGHT, ["--max-iterations", "0"], "must be a positive number"),
    "out": (PASSIVE, STRAIGHT, ["--out", "robot.json"], "end in .toml"),
    "json": (PASSIVE, STRAIGHT, ["--json", "no/such/r.json"], "create it first"),
    "offset in the file": (PULLED + 'tension_offset = "1"\n', SLACK, [], "must be a number in SI units"),
    "no shapes": (PASSIVE, None, [], "no such file"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refusals_are_one_line_and_exit_2(tmp_path, capsys, monkeypatch, name):
    robot, shapes, options, words = REFUSED[name]
    monkeypatch.chdir(tmp_path)
    Path("robot.toml").write_text(robot)
    if shapes is not None:
        Path("shapes.csv").write_text(shapes)
    assert main(["calibrate", "robot.toml", "shapes.csv", *options]) == 2
    captured = capsys.readouterr()
    assert words in captured.err
    assert captured.err.count("\n") == 1, captured.err
    assert captured.out == ""


def test_what_is_not_known_is_not_written(tmp_path, capsys):
    """Not converged: exit status 0, a message, no robot file; and a sample that is left out is named."""
    known = shapes_of(one_tendon(), ROBOTS["one tendon"][2])
    known.positions[3] = torch.nan
    robot, shapes = files(tmp_path, PULLED, known)
    out, record = tmp_path / "out.toml", tmp_path / "out.json"
    options = ["--max-iterations", "1", "--out", str(out), "--json", str(record)]
    assert main(["calibrate", robot, shapes, *options]) == 0
    captured = capsys.readouterr()
    assert "Did not converge in 1 iterations" in captured.out
    assert "sample shape-3 is left out" in captured.err
    assert "out.toml: not written" in captured.err
    assert not out.exists()
    result = json.loads(record.read_text())
    assert result["status"] == "not_converged"
    assert result["left_out"] == ["shape-3"]
    assert result["parameters"][0]["std"] is None


def rubbing(mu: float, place: float) -> Robot:
    tendon = replace(Tendon.straight(0.007 + place, 0.0, 0.4), friction=mu)
    return Robot(Rod.circular(0.4, 0.0014, 207e9, 79e9, 0.05), Tendons((tendon,)), SIDEWAYS)


STATED = """name = "bench"
[rod]
length = 0.4
diameter = 0.0014
youngs_modulus = 207e9
shear_modulus = 79e9
mass_per_length = 0.05
gravity = [9.81, 0.0, 0.0]

[[tendons]]
offset = [0.007, 0.0]

[uncertainty]
tension = 0.1

[uncertainty.shared]
friction = 0.2
tendon_place_mm = 1.0
frame = [2e-3, 0.02]
"""


@pytest.mark.many_fits
def test_what_all_samples_share_is_found_beside_what_each_has_of_its_own(tmp_path, capsys):
    """Friction, a tendon's place and the base frame, with tensions that are another from shape to shape; and the file goes on."""
    generator, B = torch.Generator().manual_seed(3), 16
    tension = 8 * torch.rand(B, 1, generator=generator)
    s, truth, t = torch.linspace(0.05, 0.4, 8), rubbing(0.15, 5e-4), T([1e-3, -5e-4, 5e-4])
    pulled = tension * (1 + 0.1 * torch.randn(B, 1, generator=generator))
    turn = torch.linalg.matrix_exp(T([[0.0, 0.0, 0.01], [0.0, 0.0, 0.0], [-0.01, 0.0, 0.0]]))
    p = solve_shape(truth, (), pulled, s, B, 40).p @ turn.T + t
    p = p + NOISE * torch.randn(p.shape, generator=generator)
    robot, shapes = files(tmp_path, STATED, Shapes(s, p, [str(b) for b in range(B)], None, tension))
    out, record = tmp_path / "out.toml", tmp_path / "out.json"
    options = ["--noise", "2.5e-4", "--hold-mass", "--out", str(out), "--json", str(record)]
    assert main(["calibrate", robot, shapes, *options]) == 0
    found = json.loads(record.read_text())
    expected = {"friction_1": 0.15, "tendon_x_1": 7.5e-3, "frame_x": 1e-3, "frame_y": -5e-4, "frame_z": 5e-4, "frame_turn_y": 0.01}
    for row in found["parameters"]:
        if row["name"] in expected:
            assert abs(row["after"] - expected[row["name"]]) < 3 * row["std"], row
    assert found["accepted"], found["chi2"] / found["dof"]
    read = read_uncertainty(out)
    assert read.calibrated is not None
    assert float((read.calibrated.zeta[:3] - t).abs().max()) < 3e-4
    assert read_robot(out).tendons.tendons[0].friction == pytest.approx(found["parameters"][0]["after"], rel=1e-6)
    capsys.readouterr()
    assert main(["calibrate", str(out), shapes, "--noise", "2.5e-4", "--hold-mass", "--free", "friction"]) == 2
    assert "has been calibrated" in capsys.readouterr().err


def test_what_is_simulated_with_a_calibrated_file_is_estimated_with_it(tmp_path, capsys):
    """The base frame and the markers' offsets that were calibrated are put in, and taken out again."""
    table = """[calibration]
parameters = ["frame_x", "frame_turn_y"]
values = [5e-3, 0.05]
covariance = [[1e-8, 0], [0, 1e-6]]
noise = 2e-4
markers = [[0.1, 1e-3, 0, 0, 1e-5], [0.2, 0, 2e-3, 0, 1e-5], [0.3, -1e-3, 0, 0, 1e-5], [0.4, 0, 0, 1e-3, 1e-5]]
"""
    robot, shapes, result = tmp_path / "r.toml", str(tmp_path / "s.csv"), tmp_path / "r.json"
    robot.write_text(STATED[: STATED.index("[uncertainty]")] + table)
    load = ["--tension", "3", "--point", "0.3", "0.5", "0.2", "--at", "0.1", "0.2", "0.3", "0.4"]
    assert main(["simulate", str(robot), *load, "--out", shapes]) == 0
    assert main(["estimate", str(robot), shapes, "--load-prior", "point", "--out", str(result)]) == 0
    assert "exact" not in capsys.readouterr().out
    found = json.loads(result.read_text())["results"][0]
    assert found["accepted"]
    assert found["loads"][0]["location_m"] == pytest.approx(0.3, abs=3e-3)
    assert found["loads"][0]["force_local_N"] == pytest.approx([0.5, 0.2], abs=0.02)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (["0.3,-0.01", "0,0"], "sample a: hung_kg"),
        (["0,0", "0.5,0.01"], "sample b: hung_s"),
        (["0,0", ",0.01"], "sample b: hung_s"),
    ],
)
def test_a_weight_that_hangs_nowhere_is_refused(tmp_path, capsys, rows, words):
    (tmp_path / "r.toml").write_text(PASSIVE + "mass_per_length = 0.1\n")
    lines = [f"{name},{s},0.01,0,{s},{row}" for name, row in zip("ab", rows, strict=True) for s in (0.2, 0.4)]
    (tmp_path / "s.csv").write_text("\n".join(["sample,s,x,y,z,hung_s,hung_kg", *lines]) + "\n")
    assert main(["calibrate", str(tmp_path / "r.toml"), str(tmp_path / "s.csv")]) == 2
    assert words in capsys.readouterr().err


def test_offsets_of_markers_leave_the_noise(tmp_path, capsys):
    """Markers 1 mm off and 0.2 mm of noise: the file says so, and not that the noise is 1 mm."""
    generator = torch.Generator().manual_seed(2)
    make, _, tension = ROBOTS["one tendon"]
    known = shapes_of(make(), tension * 4, noise=0.0)
    off = 1e-3 * torch.randn(8, 3, generator=generator)
    p = known.positions + off + 2e-4 * torch.randn(known.positions.shape, generator=generator)
    text = STATED[: STATED.index("[uncertainty]")].replace("0.05\n", "0.144\n")
    robot, shapes = files(tmp_path, text, replace(known, positions=p))
    out = tmp_path / "out.toml"
    assert main(["calibrate", robot, shapes, "--noise", "2e-4", "--marker-offsets", "--out", str(out)]) == 0
    found = read_uncertainty(out).calibrated
    assert found is not None
    assert found.noise == pytest.approx(2e-4, rel=0.15)
    assert float((found.markers[:, 1:4] - off).norm(dim=-1).median()) < 4e-4


@pytest.mark.many_fits
def test_a_known_weight_tells_the_stiffness(tmp_path, capsys):
    """Without tension only the ratio of weight to stiffness shows; two shapes with a weight on the rod tell both."""
    robot = Robot(Rod.circular(0.4, 0.0014, 207e9, 79e9, 0.05), gravity=SIDEWAYS)
    s, shapes, hung = torch.linspace(0.05, 0.4, 8), [], [(0.0, 0.0), (0.4, 0.02), (0.25, 0.05)]
    for place, kg in hung:
        rod = replace(robot.rod, masses=T([[place, kg]])[: int(kg > 0)].reshape(-1, 2))
        shapes.append(solve_shape(replace(robot, rod=rod), (), None, s, 1, 40).p)
    p = torch.cat(shapes)
    p = p + NOISE * torch.randn(p.shape, generator=torch.Generator().manual_seed(5))
    text = STATED[: STATED.index("[[tendons]]")].replace("207e9", "180e9").replace("0.05\n", "0.04\n")
    readings = {"hung_at": T(hung)[:, :1], "hung": T(hung)[:, 1:]}
    path, written = files(tmp_path, text, Shapes(s, p, list("abc"), readings=readings))
    record = tmp_path / "out.json"
    assert main(["calibrate", path, written, "--noise", "2.5e-4", "--youngs-modulus", "--json", str(record)]) == 0
    found = json.loads(record.read_text())
    for row, truth in zip(found["parameters"], (0.05, 207 / 180), strict=True):
        assert abs(row["after"] - truth) < 3 * row["std"] < 0.05 * truth, row
    assert found["accepted"]
    assert "without tension only the ratio" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        (STATED.replace("friction = 0.2", "fricton = 0.2"), [], "uncertainty.shared: unknown key 'fricton'"),
        (STATED.replace("friction = 0.2", "friction = -0.2"), [], "uncertainty.shared: friction is -0.2"),
        (STATED.replace("friction = 0.2", "curvature = 0.2"), [], "uncertainty.shared: unknown key 'curvature'"),
        (
            STATED.replace("tension = 0.1", "stiffness = 0.4").replace("friction = 0.2", "stiffness = 0.4"),
            [],
            "uncertainty: together with shared, stiffness is 0.56",
        ),
        (STATED, ["--free", "frition"], "frition is nothing that is calibrated; it must be one of"),
        (STATED, ["--contacts", "-1"], "--contacts is -1"),
        (STATED + '[calibration]\nparameters = ["friction_1"]\nvalues = []\ncovariance = [[1]]\n', [], "calibration.values"),
        (STATED + '[calibration]\nparameters = ["friction_1"]\nvalues = [0]\ncovariance = [[-1]]\n', [], "calibration"),
        (STATED + '[calibration]\nparameters = ["friction_9"]\nvalues = [0.1]\ncovariance = [[1]]\n', [], "no friction_9"),
        (STATED + '[calibration]\nparameters = "friction_1"\n', [], "calibration.parameters"),
        (STATED + "[calibration]\nmarkers = [[0.3, 0, 0, 0, -1e-3]]\n", [], "calibration.markers"),
        (STATED + "[calibration]\nnoise = 1e3\n", [], "calibration.noise"),
        (STATED + '[calibration]\nparameters = ["frame_turn_x"]\nvalues = [300]\ncovariance = [[1]]\n', [], "from -pi to pi"),
        (STATED + '[calibration]\nparameters = ["stiffness"]\nvalues = [0]\ncovariance = [[25]]\n', [], "calibration.covariance"),
    ],
)
def test_bad_keys_are_one_line(tmp_path, capsys, monkeypatch, text, options, words):
    monkeypatch.chdir(tmp_path)
    Path("robot.toml").write_text(text)
    Path("shapes.csv").write_text(SLACK)
    assert main(["calibrate", "robot.toml", "shapes.csv", *options]) == 2
    captured = capsys.readouterr()
    assert words in captured.err, captured.err
    assert captured.err.count("\n") == 1, captured.err


def test_results_of_a_calibrated_robot_in_space_and_in_a_figure(tmp_path, capsys):
    """[base] and the calibrated frame make one pose; the line that is drawn has the parameters that were found."""
    text = STATED[: STATED.index("[uncertainty]")] + "[base]\nposition = [1.0, 0.0, 0.0]\n\n[uncertainty]\nset = 0.5\n"
    table = '[calibration]\nparameters = ["frame_x"]\nvalues = [0.02]\ncovariance = [[1e-10]]\nnoise = 2e-4\n'
    robot, shapes = tmp_path / "r.toml", tmp_path / "s.csv"
    robot.write_text(text + table)
    plain = read_robot(robot)
    rows = plain.rod.reference_curvature + T([[0.0, 0.4, -0.3, 0.0]])
    bent = replace(plain, rod=replace(plain.rod, reference_curvature=rows))
    s, push = torch.linspace(0.05, 0.4, 8), PointForces(T([[[0.5, 0.0, 0.0]]]), T([[0.3]]))
    solved = solve_shape(bent, (push,), T([[2.0]]), T([*s.tolist(), 0.3]).sort().values, 1, 40).p[0]
    at = torch.isin(T([*s.tolist(), 0.3]).sort().values, s)
    write_shapes(shapes, Shapes(s, (solved[at] + T([0.02, 0.0, 0.0]))[None], ["a"], None, T([[2.0]])))
    for suffix in ("json", "npz"):
        result = tmp_path / f"r.{suffix}"
        assert main(["estimate", str(robot), str(shapes), "--load-prior", "point", "--out", str(result)]) == 0
        fit = read_fit(result, "a")
        nearly = read_uncertainty(robot).of_a_sample
        assert nearly is not None
        assert fit.errors["set_x"] == pytest.approx(0.4, abs=0.05)
        assert fit.errors["set_y"] == pytest.approx(-0.3, abs=0.05)
        found, warp = nearly.found_at(plain, fit.errors)
        line = shape_from_base(found, fit.loads(0.4), fit.base_wrench[None], T([[2.0]]), s, 40).p[0]
        assert float((line - warp.undone(solved[at])).norm(dim=-1).max()) < 1e-3
        assert (
            float((shape_from_base(plain, fit.loads(0.4), fit.base_wrench[None], T([[2.0]]), s, 40).p[0] - line).abs().max()) > 5e-3
        )
    assert main(["plot", str(robot), str(shapes), str(tmp_path / "r.json"), "--out", str(tmp_path / "r.png")]) == 0
    load = json.loads((tmp_path / "r.json").read_text())["results"][0]["loads"][0]
    assert load["position_lab_m"] == pytest.approx([a + b for a, b in zip(load["position_m"], (1.02, 0, 0), strict=True)], abs=1e-6)
    capsys.readouterr()


@pytest.mark.many_fits
@pytest.mark.parametrize("weight", [4.0, 12.0])
def test_a_rod_that_stands_is_not_taken_for_one_that_has_fallen(weight):
    """An upright rod, leaning a little, of w L^3 / EI = 4 (it stands) and 12 (it has fallen), from a fifth and four times that."""
    rod = Rod.circular(0.4, 0.0014, 207e9, 79e9)
    mass = weight * rod.bending_stiffness / 0.4**3 / 9.81
    up = T([0.05, 0.0, -1.0]) * 9.81
    s = torch.linspace(0.05, 0.4, 8)
    truth = Robot(replace(rod, mass_per_length=T(mass)), gravity=up)
    p = solve_shape(truth, (), None, s, 1).p
    markers = Markers(s, p + NOISE * torch.randn(p.shape, generator=torch.Generator().manual_seed(0)), NOISE)
    for factor in (0.2, 4.0):
        found = calibrate(Robot(replace(rod, mass_per_length=T(factor * mass)), gravity=up), markers)
        assert found.accepted, factor
        assert abs(float(found.values[0]) - mass) < 4 * float(found.std[0])


def test_a_step_too_far_is_halved():
    """A parameter z with log k = z / 10 + 8 z^3: the first step, as long as it may be, is 3,000 times too stiff."""
    rod, s = Rod.circular(0.4, 0.0014, 207e9, 79e9, 0.05), torch.linspace(0.05, 0.4, 8)

    def stiffer(robot: Robot, k: float) -> Robot:
        return replace(robot, rod=replace(robot.rod, K_se=k * robot.rod.K_se, K_bt=k * robot.rod.K_bt))

    def change(problem: Problem, z: torch.Tensor) -> Problem:
        return replace(problem, robot=stiffer(problem.robot, math.exp(float(0.1 * z + 8 * z**3))))

    robot = Robot(rod, gravity=SIDEWAYS)
    p = solve_shape(stiffer(robot, 1.5), (), None, s, 1, 40).p
    found = fit_jointly([Problem(robot, unknowns_of(robot, 0), [Markers(s, p, NOISE)])], [Shared((1.0,), (10.0,), change)])
    assert found.status is Status.CONVERGED
    assert float(0.1 * found.z + 8 * found.z**3) == pytest.approx(math.log(1.5), rel=1e-2)
