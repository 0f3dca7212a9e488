"""A base frame that all samples share: as good as a known one with many shapes, honest about it with few."""

import json
import math

import pytest
import roma
import torch

from tests.problems import unknowns_of
from tests.robots import T
from tests.study import Study, study1
from torchrod import Markers, Problem, Registration, Scope, Shapes, common_frame, estimate, write_shapes
from torchrod.cli import main
from torchrod.estimation.shared import widened

SHIFT = 5e-3 * T([0.6, 0.0, 0.8], dtype=torch.float64)
TURN = math.radians(3) * T([0.8, -0.6, 0.0], dtype=torch.float64)
ROD = "[rod]\nlength = 0.4\ndiameter = 0.0014\nyoungs_modulus = 207e9\nshear_modulus = 79e9\n"


def shapes(count: int):
    """Study 1 with 1 mm noise: as it is, and from a base frame that is off by 5 mm and 3 degrees."""
    study, generator = study1(count), torch.Generator().manual_seed(2)
    seen = study.positions + 1e-3 * torch.randn(study.positions.shape, generator=generator)
    return study, Markers(study.s, seen, 1e-3), Markers(study.s, seen @ roma.rotvec_to_rotmat(TURN).T + SHIFT, 1e-3)


def problem_of(study: Study, markers: Markers, registration: Registration | None = None) -> Problem:
    return Problem(study.robot, unknowns_of(study.robot, registration=registration), [markers])


@pytest.mark.many_fits
def test_many_shapes_tell_the_frame():
    """20 shapes: errors within 1.3 of those with a perfect frame, where every shape by itself has several times as much."""
    study, perfect, moved = shapes(20)
    apart, known, everyone = problem_of(study, moved, Registration()), unknowns_of(study.robot), torch.arange(20)
    each = estimate(apart)
    frame = common_frame(apart, [(apart.unknowns, everyone)], each)
    assert (frame.zeta[:3] - SHIFT).norm() < 1e-3
    assert (frame.zeta[3:] - TURN).norm() < math.radians(0.7)
    corrected = frame.corrected(apart).of(known)
    plain = estimate(corrected)
    fit = widened(apart, [(known, everyone)], Registration(), frame, plain)
    best = estimate(problem_of(study, perfect))
    for what in ("location", "magnitude"):
        truth = study.location if what == "location" else study.force.norm(dim=-1)
        mean = [float((getattr(f, what)[:, 0] - truth).abs().mean()) for f in (best, fit, each)]
        assert mean[1] < 1.3 * mean[0], what
        assert mean[2] > 2 * mean[0], what
    assert (fit.location_std > plain.location_std).all()
    assert fit.registration is not None
    assert torch.equal(fit.registration, frame.zeta.expand(20, 6))
    together = estimate(problem_of(study, moved, Registration(scope=Scope.SHARED)))
    for name in ("x", "registration", "location", "load_covariance"):
        assert torch.equal(getattr(together, name), getattr(fit, name)), f"{name}: in one call what the steps come to"
    assert torch.linalg.eigvalsh(frame.covariance).min() > 0


def test_the_share_of_the_frame_is_that_of_a_joint_covariance():
    """One shape by itself: common_frame and `widened` together are the registration of that shape, to first order."""
    study, _, moved = shapes(1)
    apart, known, first = problem_of(study, moved, Registration()), unknowns_of(study.robot), torch.arange(1)
    each = estimate(apart)
    frame = common_frame(apart, [(apart.unknowns, first)], each)
    corrected = frame.corrected(apart).of(known)
    fit = widened(apart, [(known, first)], Registration(), frame, estimate(corrected))
    assert each.registration is not None
    assert torch.allclose(frame.zeta, each.registration[0], atol=2e-3)
    assert torch.allclose(fit.location_std, each.location_std, rtol=0.15)
    assert torch.allclose(fit.magnitude_std, each.magnitude_std, rtol=0.15)


@pytest.mark.many_fits
def test_a_count_that_no_shape_asks_for(tmp_path, capsys):
    """`--contacts auto` of a few shapes: a model that was tried and not chosen has more unknowns than the fits that were kept."""
    moved = shapes(3)[2]
    (tmp_path / "robot.toml").write_text(ROD)
    write_shapes(tmp_path / "shapes.csv", Shapes(moved.s, moved.positions, ["a", "b", "c"]))
    command = ["estimate", str(tmp_path / "robot.toml"), str(tmp_path / "shapes.csv"), "--noise", "1e-3"]
    assert main([*command, "--registration", "--one-frame", "--contacts", "auto", "--out", str(tmp_path / "r.json")]) == 0
    assert [len(r["loads"]) for r in json.loads((tmp_path / "r.json").read_text())["results"]] == [1, 1, 1]


@pytest.mark.many_fits
def test_the_command_line(tmp_path, capsys):
    """One frame for 12 samples, one of them nonsense; with one contact and with auto."""
    study, _, moved = shapes(12)
    positions = moved.positions.clone()
    positions[5] = positions[5].flip(0)
    (tmp_path / "robot.toml").write_text(ROD)
    write_shapes(tmp_path / "shapes.csv", Shapes(study.s, positions, [str(b) for b in range(12)]))
    files = [str(tmp_path / "robot.toml"), str(tmp_path / "shapes.csv")]
    for count in ("1", "auto"):
        out = str(tmp_path / "result.json")
        assert main(["estimate", *files, "--contacts", count, "--registration", "--one-frame", "--out", out]) == 0
        records = json.loads((tmp_path / "result.json").read_text())["results"]
        shift = [record["registration"]["translation_m"] for record in records]
        assert all(s == shift[0] for s in shift)
        assert (T(shift[0]) - SHIFT).norm() < 1.5e-3
        assert [record["accepted"] for record in records] == [b != 5 for b in range(12)]
        error = [abs(record["loads"][0]["location_m"] - float(study.location[int(record["sample"])])) for record in records]
        assert sum(error[:5] + error[6:]) / 11 < 0.012
    figure = tmp_path / "figure.png"
    assert main(["plot", *files, str(tmp_path / "result.json"), "--out", str(figure)]) == 0
    capsys.readouterr()
    assert main(["estimate", *files, "--one-frame"]) == 2
    assert "give --registration as well" in capsys.readouterr().err


@pytest.mark.many_fits
def test_markers_on_the_base_plate_tell_the_frame_of_each_shape():
    """4 more markers at s = 0, 200 mm off the axis: within 1.7 of a perfect frame, a shape by itself."""
    study, perfect, moved = shapes(40)
    angle = torch.arange(4) * math.pi / 2
    plate = 0.2 * torch.stack([angle.cos(), angle.sin(), 0 * angle], -1)
    noise = 1e-3 * torch.randn(40, 4, 3, generator=torch.Generator().manual_seed(3))
    seen = plate @ roma.rotvec_to_rotmat(TURN).T + SHIFT + noise
    offsets = torch.cat([plate, plate.new_zeros(len(study.s), 3)])
    both = Markers(torch.cat([plate.new_zeros(4), study.s]), torch.cat([seen, moved.positions], 1), 1e-3, offsets)
    apart = [estimate(problem_of(study, markers, Registration())) for markers in (both, moved)]
    fits = [estimate(problem_of(study, perfect)), *apart]
    for what, truth in (("location", study.location), ("magnitude", study.force.norm(dim=-1))):
        best, with_plate, without = (float((getattr(fit, what)[:, 0] - truth).abs().mean()) for fit in fits)
        assert with_plate < 1.7 * best, what
        assert without > 1.5 * with_plate, what


@pytest.mark.many_fits
def test_a_frame_that_is_known_better(tmp_path, capsys):
    """--frame-std: the prior of a registration; a frame that is known to 0.01 mm stays where it is."""
    study, _, moved = shapes(1)
    prior = [problem_of(study, moved, known).precision[-12:-6] for known in (Registration(), Registration(2e-3, 0.01))]
    assert torch.allclose(prior[1] / prior[0], T([100.0] * 3 + [17.5**2] * 3))
    (tmp_path / "robot.toml").write_text(ROD)
    write_shapes(tmp_path / "shapes.csv", Shapes(moved.s, moved.positions, ["0"]))
    command = ["estimate", str(tmp_path / "robot.toml"), str(tmp_path / "shapes.csv"), "--out", str(tmp_path / "result.json")]
    shifts = []
    for options in ([], ["--frame-std", "1e-5", "1e-5"]):
        assert main([*command, "--registration", *options]) == 0
        (record,) = json.loads((tmp_path / "result.json").read_text())["results"]
        shifts.append(T(record["registration"]["translation_m"]).norm())
    assert shifts[0] > 3e-3
    assert shifts[1] < 1e-4
    capsys.readouterr()
    for options, words in (
        (["--frame-std", "1e-3", "0.05"], "give --registration as well"),
        (["--registration", "--frame-std", "1e-3", "3"], "in radians: 3 degrees are 0.052"),
        (["--registration", "--frame-std", "0", "0.05"], "must be a positive number"),
    ):
        assert main([*command, *options]) == 2
        assert words in capsys.readouterr().err
