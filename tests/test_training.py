"""Training: its cases are what they say, and a small run goes through, resumes and repeats itself."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

pytest.importorskip("lightning", reason="lightning is not installed: pip install torchrod[train]")

from safetensors.torch import load_file

from torchrod import WarmStart
from torchrod.learned.features import ACTIVE_SIZE, PASSIVE_SIZE
from torchrod.mechanics.tendons import NEWTON_STEPS
from training.cases import LEAST_SEEN, Recipe, block, generator_of, random_robot
from training.data import make_block
from training.train import main

ROOT = Path(__file__).resolve().parents[1]
SMALL = Recipe(1, "contacts", ("contact", "point"), (0.1, 2.0), blocks=4, block_size=96)


@pytest.mark.parametrize(
    ("recipe", "inputs"),
    [
        (SMALL, PASSIVE_SIZE),
        (replace(SMALL, contacts=2, block_size=48), PASSIVE_SIZE),
        (replace(SMALL, tendons=(1, 3), weight=1.0, block_size=32), ACTIVE_SIZE),
        (replace(SMALL, contacts=3, load="smooth", priors=("distributed",), target_iterations=5, block_size=24), PASSIVE_SIZE),
    ],
    ids=["one", "two", "tendons", "smooth"],
)
@pytest.mark.many_fits
def test_a_block_is_a_pure_function_of_its_recipe(recipe, inputs):
    first, again, other = block(recipe, 1), block(recipe, 1), block(replace(recipe, seed=1), 1)
    n = 4 * recipe.contacts
    assert first["x"].shape[1] == inputs
    assert len(first["x"]) > 0.9 * recipe.block_size
    assert first["target"].shape[1:] == (n,) and first["M"].shape[1:] == (n, n)
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["x"][:5], other["x"][:5])
    assert (torch.linalg.eigvalsh(first["M"].double()).amin(-1) > -1e-3 * first["M"].abs().amax((-1, -2))).all()
    assert first["seen"].min() >= LEAST_SEEN
    eta = first["target"].unflatten(-1, (-1, 4))[..., 2]
    assert (eta.diff(dim=-1) >= 0).all(), "loads from the base to the tip"


def test_a_block_may_be_larger_than_a_chunk_of_the_estimator(monkeypatch):
    """Where there is no kernel, chunks are smaller than the blocks of the shipped recipes."""
    whole = block(SMALL, 0)
    monkeypatch.setattr("torchrod.estimation.solve.CHUNK", 40)
    monkeypatch.setattr("torchrod.estimation.solve.CHUNK_TORCH", 40)
    parts = block(SMALL, 0)
    assert all(torch.allclose(whole[name], parts[name], rtol=1e-4, atol=1e-5) for name in whole)


def test_the_tendons_stay_soft():
    """So that the strain balance needs few steps: otherwise the cases take minutes instead of seconds."""
    recipe = replace(SMALL, tendons=(1, 3), weight=1.0)
    for index in range(30):
        robot, top = random_robot(recipe, generator_of(recipe, index))
        tension = torch.full((1, len(robot.tendons)), top)
        assert robot.tendons.newton_steps(robot.rod.K_se, robot.rod.K_bt, tension) == NEWTON_STEPS


def test_random_numbers_are_used_once():
    """Radii and angles of six tendons are independent: over 200 robots no two of these twelve numbers correlate."""
    recipe, rows = replace(SMALL, tendons=(6, 6)), []
    for index in range(200):
        routing = [t.routing[0] for t in random_robot(recipe, generator_of(recipe, index))[0].tendons.tendons]
        rows.append([v for _, x, y in routing for v in (math.log(math.hypot(x, y)), math.atan2(y, x) % (2 * math.pi))])
    assert torch.corrcoef(torch.tensor(rows).T).fill_diagonal_(0).abs().max() < 0.35


def test_a_block_does_not_depend_on_the_default_precision_or_threads(tmp_path):
    """It is written as it is made by itself, and leaves torch's own settings as they were."""
    recipe, threads = replace(SMALL, tendons=(0, 3), weight=1.0, block_size=16), torch.get_num_threads()
    expected = block(recipe, 1)
    torch.set_default_dtype(torch.float32)
    torch.set_num_threads(2)
    try:
        make_block(recipe, tmp_path, 1)
        assert (torch.get_num_threads(), torch.get_default_dtype()) == (2, torch.float32)
    finally:
        torch.set_num_threads(threads)
    written = load_file(tmp_path / "0001.safetensors")
    assert all(torch.equal(written[name], value) for name, value in expected.items())


def train(folder: Path, name: str, *options: str) -> Path:
    """Two epochs on four small blocks."""
    recipe = {f"--data.recipe.{key}": value for key, value in (("blocks", 4), ("block_size", 96), ("force", [0.1, 2.0]))}
    arguments = ["--config", str(ROOT / "training" / "configs" / "rod_1.yaml")]
    for key, value in recipe.items():
        arguments += [key, json.dumps(value)]
    arguments += ["--data.cache", str(folder / "cache"), "--data.workers", "1", "--data.batch_size", "64", "--model.width", "16"]
    arguments += ["--trainer.logger.init_args.save_dir", str(folder / "runs"), "--trainer.callbacks.name", name]
    torch.set_default_dtype(torch.float32)
    arguments += ["--trainer.callbacks.folder", str(folder / "out")]
    arguments += ["--trainer.callbacks+=lightning.pytorch.callbacks.ModelCheckpoint", "--trainer.callbacks.save_top_k", "-1"]
    main([*arguments, "--trainer.callbacks.monitor", "train/cost", *options])
    torch.set_default_dtype(torch.float64)
    return folder / "out" / f"{name}.safetensors"


@pytest.mark.many_fits
@pytest.mark.study
def test_a_small_run_repeats_itself_and_resumes(tmp_path):
    threads = torch.get_num_threads()
    try:
        epochs = ("--trainer.max_epochs", "2")
        once, twice = train(tmp_path, "a", *epochs), train(tmp_path, "b", *epochs)
        weights = load_file(once)
        assert all(torch.equal(weights[name], value) for name, value in load_file(twice).items())
        half = next(tmp_path.glob("runs/rod_1/version_0/checkpoints/epoch=0*.ckpt"))
        resumed = train(tmp_path, "c", *epochs, "--ckpt_path", str(half))
        assert all(torch.equal(weights[name], value) for name, value in load_file(resumed).items())
    finally:
        torch.set_num_threads(threads)
        torch.use_deterministic_algorithms(False)
    assert (tmp_path / "runs/rod_1/version_0/curves.png").stat().st_size > 1000
    start = WarmStart.read(once)
    assert start.card["contacts"] == 1 and start.network.width == 16
    assert start.card["cases"] == 2 * 96
