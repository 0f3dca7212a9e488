"""What markers see: bounds against estimates and beam theory, the additive information, proposed markers, and the command."""

import csv
import json
import math
from pathlib import Path

import pytest
import torch

from tests.conftest import reference
from tests.problems import unknowns_of
from tests.robots import T, busy_robot, steel_rod, toml_of
from torchrod import Markers, PointForces, Problem, Registration, Robot, Rod, bounds, estimate, load_bound, place, solve_shape
from torchrod.analysis.marker_placement import KNOWN, _information, even_layout
from torchrod.analysis.observability import covariance, held, noncentrality, push_problem, pushed, seen_by, sensitivity
from torchrod.cli import main
from torchrod.estimation import filter as ekf

AT = torch.linspace(0.04, 0.36, 5, dtype=torch.float64)
S = torch.linspace(0.04, 0.4, 10, dtype=torch.float64)
CASES = {case["name"]: case for case in reference("shape")}
ROD = toml_of(CASES["passive-point-0"]["robot"], "rod")
TENDON = toml_of(CASES["onetendon-point-0"]["robot"], "tendon robot")


def rod_seen(s=S, noise=1e-3, force=1.0, robot=None, **options):
    return bounds(robot or steel_rod(), s, noise, force, AT, directions=4, **options)


@pytest.mark.many_fits
def test_the_bound_is_the_scatter_of_estimates():
    """200 noisy estimates of one push."""
    robot, noise, force, at = steel_rod(), 3e-4, T([[0.6, -0.35]]), T([0.25])
    s = even_layout(robot, 20)
    push = PointForces(torch.nn.functional.pad(force, (0, 1)).unsqueeze(1), at.unsqueeze(1))
    shape = solve_shape(robot, (push,), None, s, 1)
    noisy = shape.p + noise * torch.randn(200, 20, 3, generator=torch.Generator().manual_seed(5))
    fit = estimate(Problem(robot, unknowns_of(robot, prior="point"), [Markers(s, noisy, noise)]))
    assert bool((fit.status == 0).all())
    location, magnitude = load_bound(robot, Markers(s, shape.p, noise), force, at, shape.base_wrench)
    assert abs(float(fit.location[:, 0].std() / location) - 1) < 0.15
    assert abs(float(fit.magnitude[:, 0].std() / magnitude) - 1) < 0.15


def test_the_bound_is_that_of_the_whole_state():
    """Alpha eliminated before the march against alpha in the state and (17) as a condition, as in the covariance of a result."""
    robot, s = busy_robot(), T([0.1, 0.2, 0.3, 0.4])
    force, at, tension = T([[0.6, -0.35], [0.2, 0.5]]), T([0.25, 0.35]), T([[3.0, 2.0]]).expand(2, -1)
    problem = push_problem(robot, Markers(s, torch.zeros(2, 4, 3), 1e-3), tension, Registration())
    x = pushed(problem, force, at)
    J = sensitivity(problem, x, KNOWN).flatten(1, 2) / 1e-3
    C, singular = covariance(J.mT @ J + held(problem, KNOWN))
    assert not singular.any()
    _, H = problem.linearized(x)
    H = torch.cat([H[..., :3], H[..., 4:]], -1)
    normal = ekf.normal_equations(H, torch.zeros_like(H[..., 0]), problem.weights, problem.groups)
    A = normal.A[:, 0] + torch.diag(torch.cat([torch.zeros(3), problem.precision[4:]]))
    assert normal.tip is not None
    whole = normal.tip.solve(A, torch.zeros_like(A[..., 0]))[1].diagonal(dim1=-2, dim2=-1)[:, :3]
    t = at / 0.4
    ours = C.diagonal(dim1=-2, dim2=-1)[:, :3] * torch.stack([torch.ones(2), torch.ones(2), (t * (1 - t)) ** -2], -1)
    assert torch.allclose(ours, whole, rtol=1e-6)


def test_a_straight_rod_is_beam_theory():
    """w is the deflection of a cantilever by 1 N at a: J = sum w^2 / noise^2, and F, a from the columns w and F dw/da."""
    robot, F = steel_rod(), 0.01
    EI = robot.rod.bending_stiffness
    a, x = AT.unsqueeze(-1), S
    w = torch.where(x > a, a**2 * (3 * x - a), x**2 * (3 * a - x)) / (6 * EI)
    dw = torch.where(x > a, a * (2 * x - a), x**2) / (2 * EI)
    seen = rod_seen(force=F)
    expected = 1e-3 * math.sqrt(noncentrality()) / w.square().sum(-1).sqrt()
    assert torch.allclose(seen.detectable, expected.unsqueeze(-1).expand_as(seen.detectable), rtol=2e-3)
    assert bool((seen.detectable.diff(dim=0) < 0).all())
    assert torch.allclose(rod_seen(noise=3e-3).detectable, 3 * seen.detectable, rtol=1e-9)
    assert abs(noncentrality() - 15.443) < 1e-3
    columns = torch.stack([w, F * dw], -1) / 1e-3
    std = torch.linalg.inv(columns.mT @ columns).diagonal(dim1=-2, dim2=-1).sqrt()
    assert torch.allclose(seen.magnitude_std, std[:, :1].expand(-1, 4), rtol=0.02)
    assert torch.allclose(seen.location_std, std[:, 1:].expand(-1, 4), rtol=0.02)


@pytest.mark.many_fits
def test_localizable_force_reaches_the_stated_share():
    """At the force that is reported, the location's standard deviation is 5 % of L; without a force nothing is located."""
    robot = steel_rod()
    for noise in (1e-5, 2e-3):
        size = rod_seen(noise=noise).localizable.amax(-1)
        for k in (0, 2, 4):
            again = bounds(robot, S, noise, float(size[k]), AT[k : k + 1], directions=4)
            assert abs(float(again.location_std.amax()) / 0.02 - 1) < 0.02
    assert bool(torch.isinf(rod_seen(noise=0.3).localizable[0]).all())


def test_scale_invariance():
    """Twice the stiffness and twice the forces: the same locations, forces doubled."""
    robot = steel_rod()
    stiff = Robot(Rod.from_stiffness(0.4, 2 * robot.rod.K_se, 2 * robot.rod.K_bt))
    one, two = rod_seen(), rod_seen(force=2.0, robot=stiff)
    assert torch.allclose(two.location_std, one.location_std, rtol=1e-6)
    for name in ("magnitude_std", "detectable", "localizable"):
        assert torch.allclose(getattr(two, name), 2 * getattr(one, name), rtol=1e-6), name


@pytest.mark.parametrize("registration", [None, Registration()], ids=["", "registration"])
def test_more_markers_and_more_knowledge_only_help(registration):
    robot, tension = busy_robot(), T([3.0, 2.0])
    few = bounds(robot, S[1::2], 1e-3, 1.0, AT[1:3], tension, registration, directions=4)
    many = bounds(robot, S, 1e-3, 1.0, AT[1:3], tension, registration, directions=4)
    wide = bounds(robot, S, 1e-3, 1.0, AT[1:3], tension, registration, width_known=False, directions=4)
    for name in ("location_std", "magnitude_std", "detectable"):
        assert bool((getattr(many, name) < getattr(few, name)).all()), name
    assert bool((wide.location_std > many.location_std).all())
    if registration:
        known = bounds(robot, S, 1e-3, 1.0, AT[1:3], tension, directions=4)
        assert bool((known.location_std < many.location_std).all())


@pytest.mark.parametrize("registration", [None, Registration()], ids=["", "registration"])
def test_information_adds_up(registration):
    """The sum over markers is the information of all of them at once."""
    robot, tension, s = busy_robot(), T([3.0, 2.0]), T([0.1, 0.17, 0.3, 0.4])
    candidates = even_layout(robot, 50).index_put((T([11, 20]),), T([0.1, 0.17]))
    A, known = _information(robot, candidates, 1e-3, 1.0, 0.1, tension, registration, 4, 40)
    at = [int((candidates - x).abs().argmin()) for x in s]
    C, _ = covariance(known + A[at].sum(0))
    where = torch.linspace(0.1, 0.397, 24).repeat_interleave(4)
    F = T([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]]).repeat(24, 1)
    everyone = seen_by(candidates, where, 1e-3)
    chosen = torch.zeros(len(everyone.s), dtype=torch.bool).index_fill(0, T(at), True)
    markers = Markers(everyone.s, torch.where(chosen[:, None], 0.0, torch.nan).expand(96, -1, 3), 1e-3)
    problem = push_problem(robot, markers, tension, registration)
    wrench = problem.state.base.of(pushed(problem, F, where))
    location, _ = load_bound(robot, markers, F, where, wrench, tension, registration)
    told = location < 0.4  # what is not on the rod is not located, and round-off is all there is to compare
    assert int(told.sum()) > 60
    assert float((0.4 * C[:, 2, 2].sqrt() / location - 1)[told].abs().max()) < 1e-7  # round-off, times the condition of A


def test_proposed_markers():
    """Never worse than even ones, at every exchange; as far apart as asked; and what is said of them holds."""
    robot = steel_rod()
    for count, gap in ((2, None), (5, 0.05), (10, 0.02)):
        found = place(robot, count, 1e-3, 1.0, gap=gap, directions=4)
        assert bool((found.history.diff() < 0).all())
        assert found.worst <= found.worst_even
        assert len(found.s) == count
        assert float(found.s.diff().min()) >= (gap or 0.008) - 1e-9
        assert float(found.s[0]) > 0
        assert float(found.s[-1]) <= 0.4
        worst = bounds(robot, found.s, 1e-3, 1.0, torch.linspace(0.04, 0.397, 24)[::6], directions=4).location_std.max()
        assert float(worst) < 1.03 * found.worst
        assert found.worst < 0.9 * found.worst_even


def test_command(tmp_path, capsys, monkeypatch):
    """Table, figure, CSV and JSON of a passive rod; proposed markers of a tendon robot."""
    monkeypatch.setattr("torchrod.analysis.observability.PLACES", 6)
    monkeypatch.setattr("torchrod.analysis.marker_placement.PLACES", 6)
    robot, figure, table, result = (str(tmp_path / n) for n in ("robot.toml", "figure.png", "table.csv", "result.json"))
    Path(robot).write_text(ROD)
    assert main(["observability", robot, "--markers", "10", "--force", "1", "--csv", table, "--json", result]) == 0
    out = capsys.readouterr().out
    assert "10 markers, noise 0.001 m" in out
    assert "> 400" in out
    rows = list(csv.DictReader(Path(table).read_text().splitlines()))
    content = json.loads(Path(result).read_text())
    assert len(rows) == len(content["places"]) == 6
    assert content["placement"] is None
    for row, entry in zip(rows, content["places"], strict=True):
        assert {k: float(v) for k, v in row.items()} == entry
    Path(robot).write_text(TENDON)
    options = ["--place", "4", "--from", "0.1", "--gap", "0.03", "--tension", "2", "--force", "1.5", "--out", figure]
    assert main(["observability", robot, *options, "--json", result]) == 0
    placed = json.loads(Path(result).read_text())["placement"]
    assert placed["worst_location_std_m"] < placed["worst_location_std_even_m"]
    assert placed["from_m"] == 0.1
    assert "proposed markers (m): " in capsys.readouterr().out
    assert Path(figure).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


BAD = {
    "no force": (ROD, ["--force", "0"], "--force is 0.0; it must be a positive number"),
    "noise": (ROD, ["--noise", "-1"], "--noise is -1.0"),
    "one marker": (ROD, ["--markers", "1"], "--markers is 1; it must be from 2"),
    "few for registration": (ROD, ["--markers", "2", "--registration"], "from 3 to 200 with --registration"),
    "one place": (ROD, ["--at", "0.2"], "--at has 1 places"),
    "off the rod": (ROD, ["--at", "0.2", "0.5"], "above 0 and up to 0.4 m"),
    "not rising": (ROD, ["--at", "0.3", "0.2"], "must increase"),
    "one proposed": (ROD, ["--place", "1"], "--place is 1; it must be from 2"),
    "two layouts": (ROD, ["--place", "4", "--at", "0.2", "0.4"], "give one of them"),
    "no tension": (TENDON, [], "--tension has 0 values but the robot has 1 tendons"),
    "pushing tendon": (TENDON, ["--tension", "-1"], "at least 0 N"),
    "tension of a rod": (ROD, ["--tension", "1"], "--tension has 1 values but the robot has 0 tendons"),
    "from without place": (ROD, ["--from", "0.1"], "--from is for --place"),
    "from off the rod": (ROD, ["--place", "4", "--from", "0.5"], "--from is 0.5"),
    "wide gap": (ROD, ["--place", "4", "--gap", "0.2"], "it must be from 0 to 0.1 m"),
    "figure": (ROD, ["--out", "figure.xyz"], "end in .png"),
    "table": (ROD, ["--csv", "table.txt"], "end in .csv"),
    "result": (ROD, ["--json", "/no/such/folder/r.json"], "create it first"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_line_and_exit_2(tmp_path, capsys, monkeypatch, name):
    robot, options, words = BAD[name]
    monkeypatch.chdir(tmp_path)
    Path("robot.toml").write_text(robot)
    assert main(["observability", "robot.toml", *options]) == 2
    captured = capsys.readouterr()
    assert words in captured.err
    assert captured.err.count("\n") == 1, captured.err
    assert captured.out == ""


def test_what_does_not_fit_is_refused():
    robot = steel_rod()
    for bad in (
        lambda: bounds(robot, S, 0.0, 1.0),
        lambda: bounds(robot, S, 1e-3, -1.0),
        lambda: bounds(robot, S[:1], 1e-3, 1.0),
        lambda: bounds(robot, S + 0.1, 1e-3, 1.0),
        lambda: bounds(robot, S, 1e-3, 1.0, tension=T([1.0])),
        lambda: place(robot, 4, 1e-3, 1.0, nearest=0.5),
        lambda: place(robot, 4, 1e-3, 1.0, gap=0.2),
    ):
        with pytest.raises(ValueError, match=r"must|give"):
            bad()


def test_an_uncertainty_of_nothing_but_zeros_is_said_to_be_none(tmp_path, capsys):
    """Once the sentence ended on a colon."""
    (tmp_path / "robot.toml").write_text(ROD + "\n[uncertainty]\nstiffness = 0.0\nset = 0.0\n")
    assert main(["observability", str(tmp_path / "robot.toml"), "--markers", "10", "--force", "1"]) == 0
    assert "[uncertainty] states nothing but zeros" in capsys.readouterr().out
