"""The learned start: what it must not depend on, what it saves, and that it never costs accuracy."""

import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.problems import unknowns_of
from tests.robots import T, csv_of, steel_rod, toml_of
from tests.study import study1
from tests.test_fast import needs_compiler
from torchrod import (
    InputError,
    Markers,
    Origin,
    PointCoordinates,
    PointForces,
    Problem,
    Registration,
    Robot,
    Rod,
    Settings,
    Start,
    Tendon,
    Tendons,
    Unknowns,
    WarmStart,
    cold_start,
    estimate,
    find_warm_start,
    kernel,
    solve_shape,
)
from torchrod.cli import main
from torchrod.estimation.evaluator import evaluator
from torchrod.estimation.starts import Fate, challenged_by_cold
from torchrod.learned.features import GRID, _facing, features, smoothed
from torchrod.learned.network import digest, load_checkpoint, save_checkpoint
from torchrod.learned.warm_start import bounded, shipped
from torchrod.mechanics.lie import rotate

ROOT = Path(__file__).resolve().parents[1]
ROD_1 = ROOT / "checkpoints" / "rod_1.safetensors"
NOISE = 1e-3


def seen(markers: Markers, robot: Robot | None = None) -> Problem:
    """Markers of one contact on a rod."""
    robot = robot or steel_rod()
    return Problem(robot, unknowns_of(robot), [markers])


def noisy(count: int, seed: int = 3) -> tuple[Markers, torch.Tensor]:
    study = study1(count, seed)
    draw = torch.randn(study.positions.shape, generator=torch.Generator().manual_seed(seed))
    return Markers(study.s, study.positions + NOISE * draw, NOISE), study.force


def turned(markers: Markers, angle: float) -> Markers:
    c, s = math.cos(angle), math.sin(angle)
    return replace(markers, positions=markers.positions @ T([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T)


def test_smoothing_reads_a_beam_from_any_layout():
    """A clamped beam under a linear load, seen at uneven places with two markers missing: deflection and curvature on the grid."""
    s, grid = torch.linspace(0.03, 1.0, 17) ** 1.2, torch.linspace(1 / GRID, 1, GRID)
    y = torch.stack([s**2 * (20 - 10 * s + s**3) / 120, 0 * s, 0 * s], -1).unsqueeze(0)
    seen = torch.ones(1, 17, dtype=torch.bool)
    seen[0, [2, 16]] = False
    deflection, bend = smoothed(s, torch.where(seen.unsqueeze(-1), y, torch.nan), seen, 1.0, 1e-5)
    start = grid - 1 / GRID
    assert torch.allclose(deflection[0, :, 0], grid**2 * (20 - 10 * grid + grid**3) / 120, atol=2e-5)
    assert torch.allclose(bend[0, :, 0], (40 - 60 * start + 20 * start**3) / 120, atol=5e-3)
    assert deflection[0, :, 1:].abs().max() == 0


@pytest.mark.parametrize("angle", [0.7, -2.1, math.pi])
def test_the_prediction_turns_with_the_shape(angle):
    start = WarmStart.read(ROD_1)
    markers, _ = noisy(20)
    gamma, other = start(seen(markers)).x[:, :4], start(seen(turned(markers, angle))).x[:, :4]
    c, s = math.cos(angle), math.sin(angle)
    assert torch.allclose(other[:, :2], gamma[:, :2] @ T([[c, -s], [s, c]]).T, atol=1e-9)
    assert torch.allclose(other[:, 2:], gamma[:, 2:], atol=1e-9)


def test_the_prediction_turns_with_the_mirror_too():
    start = WarmStart.read(ROD_1)
    markers, _ = noisy(20)
    gamma = start(seen(markers)).x[:, :4]
    mirrored = start(seen(replace(markers, positions=markers.positions * T([1.0, -1.0, 1.0])))).x[:, :4]
    assert torch.allclose(mirrored, gamma * T([1.0, -1.0, 1.0, 1.0]), atol=1e-9)


def test_the_prediction_does_not_depend_on_the_scale():
    """Three times as long, a hundred times as stiff, the same slenderness: the same dimensionless answer."""
    markers, _ = noisy(20)
    big = Robot(Rod.circular(1.2, 0.0042, 207e11, 79e11))
    other = Markers(3 * markers.s, 3 * markers.positions, 3 * NOISE)
    start = WarmStart.read(ROD_1)
    small = start(seen(markers))
    assert torch.allclose(start(seen(other, big)).x, small.x, rtol=0, atol=1e-6)
    assert small.challenged.all()
    assert (small.origin == int(Origin.LEARNED)).all()


def test_missing_markers_are_filled_in():
    """A missing marker reads as if it had never been there, and half of them may be missing."""
    start = WarmStart.read(ROD_1)
    markers, force = noisy(20)
    gone, kept = [1, 8, 19], [i for i in range(20) if i not in (1, 8, 19)]
    holes = markers.positions.clone()
    holes[:, gone] = torch.nan
    fewer = Markers(markers.s[kept], markers.positions[:, kept], NOISE)
    a, b = start(seen(replace(markers, positions=holes))), start(seen(fewer))
    assert torch.allclose(a.x, b.x, atol=1e-6)
    holes[:, ::2] = torch.nan
    assert (start(seen(replace(markers, positions=holes))).x[:, :2] - force).norm(dim=-1).median() < 0.15
    holes[0, :14] = torch.nan
    last = start(seen(replace(markers, positions=holes)))
    assert last.challenged.tolist()[:2] == [False, True], "too few for what it knows: cold"
    assert last.origin.tolist()[:2] == [Origin.COLD, Origin.LEARNED]


@pytest.mark.many_fits
def test_a_samples_answer_does_not_depend_on_its_batch():
    """With a NaN neighbour, one that is nonsense, and one out of the learned range."""
    markers, _ = noisy(6)
    positions = markers.positions.clone()
    positions[1] = torch.nan
    positions[2] = 5 * torch.randn(positions[2].shape, generator=torch.Generator().manual_seed(0))
    positions[3, 6:] = torch.nan
    start, limit = WarmStart.read(ROD_1), Settings(max_iterations=15)
    together = estimate(seen(replace(markers, positions=positions)), limit, start)
    assert together.warm_started.tolist()[0] and not together.warm_started[3]
    for i in (0, 2, 3, 4, 5):
        alone = estimate(seen(replace(markers, positions=positions[i : i + 1])), limit, start)
        assert torch.allclose(together.x[i], alone.x[0], rtol=0, atol=1e-9)
        assert together.iterations[i] == alone.iterations[0]
        assert (together.guess[i], together.fate[i]) == (alone.guess[0], alone.fate[0])


def test_it_saves_iterations_in_study_1():
    """200 cases with 1 mm noise: the same answers, in less than 0.6 of the iterations."""
    markers, _ = noisy(200)
    problem = seen(markers)
    start = find_warm_start(problem)
    assert start is not None and start.card["name"] == "rod_1"
    cold, warm = estimate(problem), estimate(problem, start=start)
    assert warm.warm_started.double().mean() > 0.98
    assert warm.iterations.double().mean() < 0.6 * cold.iterations.double().mean()
    assert warm.accepted.sum() >= cold.accepted.sum()
    assert torch.allclose(warm.chi2, cold.chi2, atol=0.01)
    assert (warm.location - cold.location).abs().max() < 2e-3


class Wild(torch.nn.Module):
    """A network gone mad: finite nonsense of the size it is told."""

    def __init__(self, honest, size):
        super().__init__()
        self.honest, self.size = honest, size

    def forward(self, x, amp, log_c):
        prediction = self.honest(x, amp, log_c)
        return replace(prediction, gamma=prediction.gamma + self.size)

    def guess(self, x, amp, log_c):
        return self(x, amp, log_c).gamma


@pytest.mark.parametrize("kind", ["random weights", "1e3 forces", "not a number"])
@pytest.mark.many_fits
def test_a_bad_network_never_costs_accuracy(kind):
    markers, _ = noisy(50)
    start = WarmStart.read(ROD_1)
    if kind == "random weights":
        torch.manual_seed(0)
        network = start.network
        for value in network.parameters():
            value.copy_(3 * torch.randn_like(value) / value.shape[-1] ** 0.5)
    else:
        network = Wild(start.network, 1e3 if kind == "1e3 forces" else math.nan)
    bad = replace(start, network=network)
    cold, warm = estimate(seen(markers)), estimate(seen(markers), start=bad)
    assert warm.accepted.sum() >= cold.accepted.sum()
    assert (warm.chi2 < cold.chi2 + 0.01).all()
    assert torch.allclose(warm.force, cold.force, atol=0.02)
    dropped = (warm.guess == int(Origin.LEARNED)) & (warm.fate == int(Fate.DROPPED))
    assert dropped.any()
    assert not warm.warm_started[dropped].any()
    assert "learned start" in warm.message(int(dropped.nonzero()[0, 0]))
    if kind != "random weights":
        assert torch.allclose(warm.x, cold.x, atol=1e-9)
        assert torch.equal(warm.iterations, cold.iterations), "a dropped start costs nothing but its comparison"


def test_a_start_that_leads_nowhere_is_followed_by_a_cold_one():
    """Nearer to the markers than a cold start, so it is tried, but stuck: the cold start's answer is the one reported."""
    markers, _ = noisy(3)
    limit = Settings(max_iterations=12, restarts=())
    cold = estimate(seen(markers), limit)

    def stuck(problem):
        tight = torch.eye(problem.size).repeat(problem.batch, 1, 1)
        x = cold_start(problem).x
        x = x + 0.5 * (cold.x - x)
        x[:, 3] = -30.0  # so wide that nothing moves any more
        return replace(Start.at(x, Origin.LEARNED, challenged=True), Sigma0=tight)

    fit = estimate(seen(markers), limit, stuck)
    assert fit.accepted.all()
    retried = (fit.guess == int(Origin.LEARNED)) & (fit.fate == int(Fate.RETRIED))
    assert retried.any()
    assert (fit.restarts[retried] == 1).all()
    assert (fit.iterations[retried] > cold.iterations[retried]).all()
    assert torch.allclose(fit.force, cold.force, atol=0.02)
    assert "cold start" in fit.message(int(retried.nonzero()[0, 0]))


def test_of_two_starts_without_a_cost_the_cold_one_is_taken():
    markers, _ = noisy(2)
    problem = seen(markers)
    cold = cold_start(problem).x
    guess = Start.at(cold + 0.1, Origin.LEARNED, challenged=True)
    costs = T([[math.inf, math.nan], [1.0, 2.0]])
    chosen, dropped = challenged_by_cold(problem, replace(guess, costs=costs), torch.eye(problem.size))
    assert dropped.tolist() == [True, False]
    assert torch.equal(chosen.x, torch.stack([cold[0], guess.x[1]]))
    assert chosen.origin.tolist() == [int(Origin.COLD), int(Origin.LEARNED)]


def test_the_tip_is_begun_facing_the_way_the_markers_go():
    way = torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    turned = rotate(_facing(way), T([0.0, 0.0, 1.0]).expand(20, 3))
    assert torch.allclose(turned, torch.nn.functional.normalize(way, dim=-1), atol=1e-12)


def test_a_predicted_spread_is_what_the_filter_begins_with():
    """Of three contacts, whose network predicts it: wider than the network thinks, and bounded."""
    markers, _ = noisy(3)
    problem = Problem(steel_rod(), unknowns_of(steel_rod(), 3, "distributed"), [markers])
    start = WarmStart.read(ROOT / "checkpoints" / "rod_3.safetensors")(problem)
    assert start.Sigma0 is not None
    loads = start.Sigma0[:, problem.state.loads.at, problem.state.loads.at]
    assert (torch.linalg.eigvalsh(loads) > 0).all()
    assert not torch.allclose(loads[0], loads[1])
    told = torch.diag(T([100.0, 200.0, 300.0])).unsqueeze(0)
    assert (torch.linalg.eigvalsh(bounded(told) - 5 * told) > 0).all()
    assert float(bounded(1e9 * told).diagonal(dim1=1, dim2=2).sum()) < 2e4


@pytest.mark.many_fits
def test_a_failed_guess_is_followed_by_all_of_a_cold_start():
    """A push whose cold fit needs a restart, and a guess that leads nowhere: the restart must follow it, too."""
    rod = steel_rod()
    s, force = torch.linspace(0.02, 0.4, 20), T([[[4.91, 0.0, 0.0]]])
    p = solve_shape(rod, (PointForces(force, T([[0.379]])),), None, s, 1, 160).p
    problem = seen(Markers(s, p, NOISE), rod)
    plain = Settings(basins=0)
    cold = estimate(problem, plain)
    assert cold.restarts[0] > 0
    assert cold.accepted[0], "of the case: it needs a restart, which helps"

    def stuck(problem):
        return Start.at(estimate(problem, replace(plain, restarts=())).x, Origin.LEARNED, challenged=True)

    fit = estimate(problem, plain, start=stuck)
    assert (fit.guess[0], fit.fate[0]) == (int(Origin.LEARNED), int(Fate.RETRIED))
    assert fit.accepted[0]
    assert torch.allclose(fit.force, cold.force, atol=1e-3)
    assert fit.restarts[0] == 1 + cold.restarts[0], "the cold start and its restarts, and nothing twice"


@needs_compiler
def test_the_compiled_layers_are_the_networks(monkeypatch):
    """Also for inputs beyond what is known, and after the weights have been changed."""
    network = WarmStart.read(ROD_1).network
    x = 5 * torch.randn(11, network.inputs, generator=torch.Generator().manual_seed(0))
    for scale in (1.0, 0.5):
        for weight in network.parameters():
            weight.mul_(scale)
        compiled = network.hidden(x)
        with monkeypatch.context() as without:
            without.setattr(kernel, "available", lambda: False)
            assert torch.allclose(compiled, network.hidden(x), rtol=1e-5, atol=1e-6 * scale), "single precision"


def test_what_does_not_fit_is_said_in_one_sentence():
    start, steel = WarmStart.read(ROD_1), steel_rod()
    tendon = Robot(steel.rod, Tendons((Tendon.straight(0.007, 0.0, 0.4),)))
    stubby = Robot(Rod.circular(0.4, 0.1, 207e9, 79e9))
    curved = Robot(Rod.circular(0.4, 0.0014, 207e9, 79e9, reference_curvature=T([[0.0, 1.0, 0.0, 0.0]])))
    markers = noisy(2)[0]
    problem = seen(markers)
    points = Unknowns(PointCoordinates(1, 0.4, steel.rod.force_scale))

    def of(robot: Robot, unknowns: Unknowns) -> str | None:
        return start.misfit(replace(problem, robot=robot, unknowns=unknowns), measured=False)

    reasons = [
        of(steel, points),
        of(steel, unknowns_of(steel, locations=(0.2,))),
        of(steel, unknowns_of(steel, registration=Registration())),
        of(steel, unknowns_of(steel, count=2)),
        of(steel, unknowns_of(steel, prior="distributed")),
        of(tendon, unknowns_of(tendon)),
        of(stubby, unknowns_of(stubby)),
        of(curved, unknowns_of(curved)),
        start.misfit(seen(replace(markers, noise=1e-5))),
        start.misfit(seen(Markers(markers.s[:4], markers.positions[:, :4], NOISE))),
        start.misfit(seen(replace(markers, offsets=torch.zeros(20, 3)))),
    ]
    words = [
        "Gaussian",
        "known",
        "registration",
        "1 loads",
        "distributed",
        "tendons",
        "shear",
        "straight",
        "noise",
        "markers",
        "centre",
    ]
    for reason, word in zip(reasons, words, strict=True):
        assert reason is not None and word in reason and "\n" not in reason
    assert start.misfit(problem) is None
    exact = seen(replace(markers, noise=1e-5))
    assert start.misfit(exact, measured=False) is None
    with pytest.raises(InputError, match="noise"):
        start(exact)
    lenient = replace(start, strict=False)(exact)
    assert not lenient.challenged.any()
    assert (lenient.origin == int(Origin.COLD)).all()


def test_every_card_agrees_with_its_file():
    names = {start.card["name"] for start in shipped()}
    assert {"rod_1", "rod_2", "rod_3", "tendon_1"} <= names
    for start in shipped():
        path = ROOT / "checkpoints" / f"{start.card['name']}.safetensors"
        assert digest(path) == start.card["sha256"]
        assert start.card["contacts"] == start.network.count == start.card["recipe"]["contacts"]
        assert start.card["command"].endswith(f"training/configs/{start.card['name']}.yaml")
        for key in ("seed", "torchrod", "cases", "held_out"):
            assert key in start.card


@pytest.mark.parametrize("harm", ["cut", "foreign", "other", "card", "no card", "schema"])
def test_a_damaged_checkpoint_is_one_sentence(tmp_path, harm, capsys):
    path = tmp_path / "rod_1.safetensors"
    shutil.copy(ROD_1, path)
    shutil.copy(ROD_1.with_suffix(".json"), path.with_suffix(".json"))
    card = json.loads(path.with_suffix(".json").read_text())
    if harm == "cut":
        path.write_bytes(path.read_bytes()[:1000])
        card["sha256"] = digest(path)
    elif harm == "foreign":
        path.write_text("hello")
        card["sha256"] = digest(path)
    elif harm == "other":
        path.write_bytes(path.read_bytes() + b" ")
    elif harm == "card":
        del card["range"]
    elif harm == "schema":
        card["schema"] = 99
    path.with_suffix(".json").write_text(json.dumps(card))
    if harm == "no card":
        path.with_suffix(".json").unlink()
    robot, shapes = files(tmp_path)
    assert main(["estimate", str(robot), str(shapes), "--warm-start", str(path)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "rod_1" in said


def files(folder: Path) -> tuple[Path, Path]:
    robot, shapes = folder / "robot.toml", folder / "shapes.csv"
    steel = dict(length=0.4, diameter=0.0014, youngs_modulus=207e9, shear_modulus=79e9, weight=None, tendons=[])
    robot.write_text(toml_of(steel))
    markers, _ = noisy(1)
    shapes.write_text(csv_of({"tensions": [], "s": markers.s.tolist(), "positions": markers.positions[0].tolist()}))
    return robot, shapes


@pytest.mark.many_fits
def test_the_command_line_starts_where_it_is_told(tmp_path, capsys):
    robot, shapes = files(tmp_path)

    def run(*options: str) -> dict:
        out = tmp_path / "result.json"
        assert main(["estimate", str(robot), str(shapes), "--out", str(out), *options]) == 0
        return json.loads(out.read_text())["results"][0]

    auto, off, named = run(), run("--warm-start", "off"), run("--warm-start", str(ROD_1))
    assert (auto["warm_started"], off["warm_started"], named["warm_started"]) == (True, False, True)
    assert auto["iterations"] < off["iterations"]
    assert abs(auto["loads"][0]["magnitude_N"] - off["loads"][0]["magnitude_N"]) < 2e-3
    assert not run("--load-prior", "none")["warm_started"]
    assert run("--contacts", "auto", "--warm-start", str(ROD_1))["warm_started"]
    capsys.readouterr()
    for options, word in ((["--contacts", "2"], "1 loads"), (["--location", "0.2"], "known"), (["--noise", "1e-6"], "noise")):
        assert main(["estimate", str(robot), str(shapes), "--warm-start", str(ROD_1), *options]) == 2
        said = capsys.readouterr().err
        assert word in said and said.count("\n") == 1
    lines = shapes.read_text().splitlines()
    far = [lines[0], *(f"{s},0,0,{s}" for s in (line.split(",")[0] for line in lines[1:]))]
    shapes.write_text("\n".join(far) + "\n")
    assert not run("--warm-start", str(ROD_1))["warm_started"]
    assert "1 samples lie outside" in capsys.readouterr().err


def test_what_is_saved_is_what_is_read(tmp_path):
    """To the bit."""
    network, card = load_checkpoint(ROD_1)
    save_checkpoint(tmp_path / "a.safetensors", network, card)
    again, _ = load_checkpoint(tmp_path / "a.safetensors")
    read = features(seen(noisy(3)[0]))
    log_c = torch.full((3,), 6.0)
    assert torch.equal(network(read.x, read.amp, log_c).gamma, again(read.x, read.amp, log_c).gamma)


def test_the_library_does_not_need_lightning():
    """Nor the folder `training`, which no wheel has."""
    for path in (ROOT / "torchrod").rglob("*.py"):
        for name in re.findall(r"^\s*(?:from|import) ([\w.]+)", path.read_text(), re.MULTILINE):
            assert "lightning" not in name and name.partition(".")[0] != "training", path


@pytest.mark.parametrize("missing", [False, True])
def test_the_costs_of_a_guess_are_the_models(missing):
    """They come from the forward solves; challenged_by_cold would else evaluate the model. Also with noise of each sample's."""
    markers, _ = noisy(20)
    markers = replace(markers, noise=torch.linspace(0.5e-3, 2e-3, 20))
    if missing:
        markers.positions[3, 5:9] = torch.nan
    problem = seen(markers)
    start = WarmStart.read(ROD_1)(problem)
    evaluate = evaluator(problem.coarse)
    assert start.costs is not None
    assert start.cold is not None
    expected = torch.stack([evaluate.cost(start.x), evaluate.cost(start.cold)], -1)
    assert torch.allclose(start.costs, expected, rtol=1e-4)
