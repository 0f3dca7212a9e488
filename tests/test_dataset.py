"""Data sets: the same bytes however they are made, what was asked for in every range, and shapes that belong to their loads."""

import json
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.robots import busy_robot, steel_rod
from torchrod import (
    DatasetSpec,
    InputError,
    Robot,
    Rod,
    Tendon,
    Tendons,
    read_dataset,
    read_dataset_spec,
    simulate_shard,
    solve_shape,
)
from torchrod.cli import main
from torchrod.data import workers
from torchrod.data.dataset import ARRAYS, digest, drawn_load
from torchrod.data.shards import write_manifest, write_shard

EXAMPLE = Path(__file__).resolve().parents[1] / "docs" / "example"
SPEC = (EXAMPLE / "dataset.toml").read_text().replace("20_000", "250").replace("5_000", "70")
SHARDS = 4
CRUSHING = 1500.0  # N: with more, few draws have an equilibrium


def spec(**changes) -> DatasetSpec:
    plain = dict(robots=(steel_rod(),), samples=150, shard_size=100, seed=1, noise=1e-3, contacts=2, family="point")
    plain |= dict(force=(0.5, 5.0), force_unit="EI/L^2", distribution="uniform", location=(0.1, 1.0), min_gap=0.1, width=None)
    plain |= dict(markers=(0.25, 0.5, 1.0), tension=None, gravity=None)
    return DatasetSpec(**{**plain, **changes})


def heavy_robot() -> Robot:
    return Robot(Rod.circular(0.2, 0.0014, 207e9, 79e9, 0.1), name="short")


@pytest.fixture
def made(tmp_path):
    """Run the command in a folder; returns what it did, and the digest of the manifest where there is one."""
    for name in ("rod.toml", "tendon.toml"):
        (tmp_path / name).write_text((EXAMPLE / name).read_text())
    (tmp_path / "d.toml").write_text(SPEC)

    def run(folder: str, *options: str) -> str | None:
        workers = () if "--scheduler" in options or "--workers" in options else ("--workers", "1")
        assert main(["simulate-dataset", str(tmp_path / "d.toml"), "--out", str(tmp_path / folder), *workers, *options]) == 0
        manifest = tmp_path / folder / "manifest.json"
        return json.loads(manifest.read_text())["digest"] if manifest.exists() else None

    return run


def test_a_shard_is_a_function_of_specification_and_index():
    """Neither threads nor what was made before it nor the default type matter; seed and index do."""
    busy = spec(robots=(busy_robot(),), tension=(0.0, 3.0), gravity=(0.0, 9.81))
    for s in (spec(), busy):
        threads, first = torch.get_num_threads(), digest(simulate_shard(s, 1))
        torch.set_default_dtype(torch.float32)
        torch.set_num_threads(3)
        simulate_shard(s, 0)
        assert digest(simulate_shard(s, 1)) == first
        assert torch.get_num_threads() == 3
        torch.set_num_threads(threads)
        torch.set_default_dtype(torch.float64)
        assert len({first, digest(simulate_shard(s, 0)), digest(simulate_shard(spec(seed=2), 1))}) == 3


def same_files(one: Path, other: Path) -> None:
    """Byte for byte."""
    names = sorted(p.name for p in one.iterdir())
    assert len(names) == 2 * SHARDS + 1
    assert sorted(p.name for p in other.iterdir()) == names
    for name in names:
        assert (other / name).read_bytes() == (one / name).read_bytes(), name


def test_jobs_make_the_same_files(tmp_path, made, capsys):
    """Three jobs of a cluster, in any order, and one."""
    first = made("one")
    assert first is not None
    assert [made("jobs", "--shard", f"{i}/3") for i in (2, 0, 1)] == [None, None, first]
    assert "follows when all 4 shards are there" in capsys.readouterr().out
    same_files(tmp_path / "one", tmp_path / "jobs")


@pytest.mark.study
def test_processes_make_the_same_files(tmp_path, made):
    """Two of them, and one."""
    assert made("two", "--workers", "2") == made("one")
    same_files(tmp_path / "one", tmp_path / "two")


def test_only_damaged_and_missing_shards_are_made_again(tmp_path, made, capsys):
    first, folder = made("d"), tmp_path / "d"
    whole = {p.name: p.read_bytes() for p in folder.iterdir()}
    (folder / "shard-00000.npz").unlink()
    damaged = bytearray(whole["shard-00001.npz"])
    damaged[len(damaged) // 2] ^= 1
    (folder / "shard-00001.npz").write_bytes(damaged)
    (folder / "shard-00002.json").write_text("{")
    (folder / "manifest.json").unlink()
    with pytest.raises(InputError, match=r"manifest\.json"):
        read_dataset(folder)
    capsys.readouterr()
    assert made("d") == first
    assert "made 3, kept 1" in capsys.readouterr().out
    assert made("d") == first
    assert "made 0, kept 4" in capsys.readouterr().out
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == whole


def test_a_cluster_makes_the_same_files(made):
    """Here its workers are threads of this process."""
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed: pip install torchrod[scale]")
    local = {"processes": False, "protocol": "tcp", "dashboard_address": None}
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, **local) as cluster:
        assert made("there", "--scheduler", cluster.scheduler_address) == made("here")


@pytest.mark.study
def test_a_killed_worker_of_a_cluster_changes_nothing(tmp_path, made):
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed: pip install torchrod[scale]")
    (tmp_path / "d.toml").write_text(SPEC.replace("samples = 250", "samples = 6000").replace("70", "500"))
    first = made("here")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        run = threading.Thread(target=made, args=("there", "--scheduler", cluster.scheduler_address))
        run.start()
        while not list((tmp_path / "there").glob("shard-*.json")):
            assert run.is_alive()
            time.sleep(0.01)
        os.kill(cluster.workers[0].pid, signal.SIGKILL)
        assert len(list((tmp_path / "there").glob("shard-*.json"))) < 10
        run.join()
    assert json.loads((tmp_path / "there" / "manifest.json").read_text())["digest"] == first


def test_a_cluster_that_is_not_there(tmp_path, made, capsys, monkeypatch):
    pytest.importorskip("distributed", reason="dask.distributed is not installed: pip install torchrod[scale]")
    monkeypatch.setattr(workers, "CONNECT_SECONDS", 1)
    assert (
        main(["simulate-dataset", str(tmp_path / "d.toml"), "--out", str(tmp_path / "d"), "--scheduler", "tcp://127.0.0.1:9"]) == 2
    )
    assert "cannot be reached" in capsys.readouterr().err
    assert main(["simulate-dataset", str(tmp_path / "d.toml"), "--out", str(tmp_path / "d"), "--scheduler", "foo://bar"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    assert (
        main(["simulate-dataset", str(tmp_path / "d.toml"), "--out", str(tmp_path / "d"), "--scheduler", "tcp://127.0.0.1:9"]) == 2
    )
    assert "pip install torchrod[scale]" in capsys.readouterr().err


@settings(max_examples=25, deadline=None)
@given(
    contacts=st.integers(1, 4),
    family=st.sampled_from(["point", "gaussian"]),
    distribution=st.sampled_from(["uniform", "log-uniform"]),
    unit=st.sampled_from(["N", "EI/L^2"]),
    low=st.floats(0.0, 0.3),
    span=st.floats(0.4, 0.7),
    gap=st.floats(0.0, 0.12),
    top=st.floats(0.1, 2.0),
)
def test_every_range_is_respected(contacts, family, distribution, unit, low, span, gap, top):
    width = (0.01, 0.1) if family == "gaussian" else None
    changes = dict(contacts=contacts, family=family, distribution=distribution, force_unit=unit, force=(0.1 * top, top))
    s = spec(**changes, location=(low, low + span), min_gap=gap, width=width, gravity=(1.0, 2.0), robots=(heavy_robot(),))
    arrays = simulate_shard(s, 0)
    rod, n = heavy_robot().rod, 100
    size = np.hypot(*np.moveaxis(arrays["force"], -1, 0)) / (1.0 if unit == "N" else rod.bending_stiffness / rod.length**2)
    place, sigma = arrays["location"] / rod.length, arrays["width"] / rod.length
    close = 1e-12
    assert size.shape == place.shape == sigma.shape == (n, contacts)
    assert size.min() >= 0.1 * top - close
    assert size.max() <= top + close
    assert place.min() >= low - close
    assert place.max() <= low + span + close
    assert (np.diff(place, axis=-1) >= gap - close).all()
    assert (sigma == 0).all() if width is None else ((sigma >= 0.01 - close) & (sigma <= 0.1 + close)).all()
    pull = np.linalg.norm(arrays["gravity"], axis=-1)
    assert pull.min() >= 1 - close
    assert pull.max() <= 2 + close
    assert arrays["tension"].shape == (n, 0)
    assert all(np.isfinite(value).all() for value in arrays.values())


def test_draws_fill_their_ranges():
    """Medians: half of the range, the geometric mean of a log-uniform one; every direction; noise of the size asked for."""
    many = simulate_shard(spec(samples=4000, shard_size=4000, contacts=1, force_unit="N", force=(0.01, 1.0), min_gap=0.0), 0)
    size = np.linalg.norm(many["force"], axis=-1)
    assert abs(np.median(size) - 0.505) < 0.03
    assert np.abs(many["force"].mean(0)).max() < 0.03
    assert abs(np.median(many["location"]) - 0.22) < 0.01
    logarithmic = spec(samples=4000, shard_size=4000, contacts=1, force_unit="N", force=(0.01, 1.0), distribution="log-uniform")
    assert abs(np.median(np.linalg.norm(simulate_shard(logarithmic, 0)["force"], axis=-1)) / 0.1 - 1) < 0.15
    assert abs((many["positions"] - many["positions_clean"]).std() / 1e-3 - 1) < 0.02
    quiet = simulate_shard(spec(noise=0.0), 0)
    assert np.array_equal(quiet["positions"], quiet["positions_clean"])
    assert np.array_equal(quiet["positions_clean"], simulate_shard(spec(), 0)["positions_clean"])


@pytest.mark.parametrize(
    ("changes", "robot"),
    [
        (dict(contacts=3, force=(0.1, 4.0)), steel_rod()),
        (dict(family="gaussian", width=(0.02, 0.3), force=(0.1, 4.0)), steel_rod()),
        (dict(tension=(0.0, 5.0), force=(0.1, 4.0)), busy_robot()),
        (dict(tension=(0.0, 5.0), gravity=(0.0, 9.81), force=(0.1, 4.0), family="gaussian", width=(0.02, 0.1)), busy_robot()),
    ],
)
def test_shapes_belong_to_their_loads(changes, robot):
    """Solved again from the arrays alone, with four times the steps; the force is what acts on the rod."""
    s = spec(robots=(robot,), **changes)
    arrays = {name: torch.from_numpy(value) for name, value in simulate_shard(s, 0).items()}
    load = drawn_load(s.family, arrays["force"], arrays["location"], arrays["width"], robot.rod.length)
    again = solve_shape(
        Robot(robot.rod, robot.tendons, arrays["gravity"]),
        (load,),
        arrays["tension"] if len(robot.tendons) else None,
        arrays["s"],
        100,
        160,
    )
    assert float((again.p - arrays["positions_clean"]).abs().max()) < 1e-6
    assert torch.allclose(again.base_wrench, arrays["base_wrench"], atol=1e-4)
    tip = torch.tensor([[robot.rod.length] * 3])
    total = load.integrals(tip, torch.full_like(tip, torch.inf)).G
    assert total is not None
    assert torch.allclose(total[:, 0, 0, :2], arrays["force"].sum(1))


def test_reading_a_family_of_robots(tmp_path):
    """Two robots take turns; every array comes back in its place, and so does the specification."""
    s = spec(robots=(steel_rod(), heavy_robot()), samples=250)
    (tmp_path / "d").mkdir()
    shards = [simulate_shard(s, i) for i in range(3)]
    for i, arrays in enumerate(shards):
        write_shard(tmp_path / "d", s, i, arrays)
    assert write_manifest(tmp_path / "d", s) is not None
    data = read_dataset(tmp_path / "d", verify=True)
    assert data.spec.sha256() == s.sha256()
    assert data.robot.tolist() == [0] * 100 + [1] * 100 + [0] * 50
    assert np.allclose(data.s, [[0.1, 0.2, 0.4], [0.05, 0.1, 0.2]])
    for name in set(ARRAYS) - {"s", "rejected"}:
        assert np.array_equal(getattr(data, name).numpy(), np.concatenate([a[name] for a in shards])), name
    other = simulate_shard(spec(seed=9, robots=s.robots, samples=250), 1)
    np.savez(tmp_path / "d" / "shard-00001.npz", allow_pickle=False, **other)
    read_dataset(tmp_path / "d")
    with pytest.raises(InputError, match="does not have the checksum"):
        read_dataset(tmp_path / "d", verify=True)
    np.savez(tmp_path / "d" / "shard-00001.npz", allow_pickle=False, **{**other, "width": other["width"][:-1]})
    with pytest.raises(InputError, match="array 'width' is not"):
        read_dataset(tmp_path / "d")
    (tmp_path / "d" / "shard-00001.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match="missing or damaged"):
        read_dataset(tmp_path / "d")


def test_rejected_draws_are_replaced_or_refused():
    """Tensions near what crushes the robot: the number of samples is exact; beyond it there is one clear sentence."""
    robot = Robot(steel_rod().rod, Tendons((Tendon.straight(0.007, 0.0, 0.4),)))
    some = simulate_shard(spec(robots=(robot,), tension=(0.0, CRUSHING)), 0)
    assert some["rejected"] > 0
    assert len(some["force"]) == 100
    with pytest.raises(InputError, match="draws have no equilibrium; lower the forces"):
        simulate_shard(spec(robots=(robot,), tension=(4 * CRUSHING, 5 * CRUSHING)), 0)


def test_the_folders_around_a_data_set_are_made(tmp_path, made):
    made("out/new/d")
    assert (tmp_path / "out" / "new" / "d" / "manifest.json").is_file()


def test_another_data_set_is_not_mixed_in(tmp_path, made, capsys):
    made("d")
    before = {p.name: p.read_bytes() for p in (tmp_path / "d").iterdir()}
    (tmp_path / "file").write_text("x")
    run = ["simulate-dataset", str(tmp_path / "d.toml"), "--workers", "1", "--out"]
    for options, words in (
        ([str(tmp_path / "d"), "--seed", "5"], "another specification"),
        ([str(tmp_path / "d"), "--samples", "70"], "another specification"),
        ([str(tmp_path / "file" / "d")], "Not a directory"),
        ([str(tmp_path / "file")], "give a folder"),
        ([str(tmp_path / "e"), "--shard", "2/2"], "from 0 to N - 1"),
        ([str(tmp_path / "e"), "--shard", "first"], "must be I/N"),
        ([str(tmp_path / "e"), "--workers", "0"], "at least 1"),
        ([str(tmp_path / "e"), "--scheduler", "tcp://x:1"], "give one of them"),
        ([str(tmp_path / "e"), "--samples", "0"], "--samples is 0"),
        ([str(tmp_path / "e"), "--seed", "-1"], "--seed is -1"),
    ):
        assert main([*run, *options]) == 2
        captured = capsys.readouterr()
        assert words in captured.err
        assert captured.err.count("\n") == 1, captured.err
    assert {p.name: p.read_bytes() for p in (tmp_path / "d").iterdir()} == before


BAD = {
    "not toml": ("[dataset]", "dataset]", "not valid TOML"),
    "unknown table": ("[markers]", "[marker]", "unknown key 'marker'"),
    "unknown key": ("noise =", "niose =", "unknown key 'niose'"),
    "no robot": ("[robot]\nfile", "#", "has no [robot] table"),
    "no samples": ("samples = 250", "", "dataset.samples is missing"),
    "half a sample": ("250", "250.5", "must be a whole number"),
    "no shard": ("shard_size = 70", "shard_size = 0", "must be a whole number from 1"),
    "negative noise": ("1e-3", "-1e-3", "at least 0"),
    "text for noise": ("1e-3", "'much'", "must be a number"),
    "seed": ("seed = 0", "seed = -1", "dataset.seed is -1"),
    "contacts": ("contacts = 1", "contacts = true", "must be a whole number from 1 to 100"),
    "family": ("'point'", "'fourier'", "must be 'point' or 'gaussian'"),
    "no force": ("force = [0.5, 1.0]", "", "needs either force or force_scale"),
    "force twice": ("contacts = 1", "force_scale = [1, 2]", "needs either force or force_scale"),
    "one number": ("[0.5, 1.0]", "0.5", "must be [lowest, highest]"),
    "backwards": ("[0.5, 1.0]", "[1.0, 0.5]", "the lowest comes first"),
    "negative force": ("[0.5, 1.0]", "[-0.5, 1.0]", "must be at least 0"),
    "infinite force": ("[0.5, 1.0]", "[0.5, inf]", "must be finite"),
    "distribution": ("contacts = 1", "distribution = 'normal'", "must be 'uniform' or 'log-uniform'"),
    "logarithm of zero": ("force = [0.5, 1.0]", "distribution = 'log-uniform'\nforce = [0, 1]", "must be positive"),
    "location in metres": ("0.975]", "390]", "at most 1, a fraction"),
    "no location": ("location", "#", "loads.location is missing"),
    "no room": ("contacts = 1", "contacts = 4\nmin_gap = 0.3", "do not fit"),
    "width of a point": ("contacts = 1", "width = [0.1, 0.2]", "stands beside family = 'point'"),
    "no width": ("'point'", "'gaussian'", "loads.width is missing"),
    "zero width": ("family = 'point'", "family = 'gaussian'\nwidth = [0, 1]", "must be positive"),
    "markers twice": ("count = 20", "count = 20\nat = [1]", "needs either count or at"),
    "markers back": ("count = 20", "at = [1, 0.5]", "must increase"),
    "markers beyond": ("count = 20", "at = [0.5, 1.5]", "between 0 (the base) and 1"),
    "no markers": ("count = 20", "at = []", "a list of fractions"),
    "robot twice": ("file = 'rod.toml'", "file = 'rod.toml'\nrobots = ['rod.toml']", "needs either file or robots"),
    "robot is a number": ("'rod.toml'", "3", "must be a file name"),
    "no robots": ("file = 'rod.toml'", "robots = []", "must be a list of file names"),
    "no such robot": ("rod.toml", "rot.toml", "rot.toml: cannot be read"),
    "unlike robots": ("file = 'rod.toml'", "robots = ['rod.toml', 'tendon.toml']", "another number of tendons"),
    "no tension": ("rod.toml", "tendon.toml", "vary.tension is missing"),
    "tension of a rod": ("[markers]", "[vary]\ntension = [0, 1]\n[markers]", "no tendons"),
    "gravity": ("[markers]", "[vary]\ngravity = 'down'\n[markers]", "must be 'any'"),
    "weightless": ("[markers]", "[vary]\ngravity = 'any'\n[markers]", "has no mass"),
    "magnitude alone": ("[markers]", "[vary]\ngravity_magnitude = [1, 2]\n[markers]", "given without gravity"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_specifications_are_one_line_and_exit_2(tmp_path, made, capsys, name):
    old, new, words = BAD[name]
    text = SPEC.replace('"', "'")
    assert old in text
    (tmp_path / "d.toml").write_text(text.replace(old, new, 1))
    assert main(["simulate-dataset", str(tmp_path / "d.toml"), "--out", str(tmp_path / "d")]) == 2
    captured = capsys.readouterr()
    assert words in captured.err
    assert captured.err.count("\n") == 1, captured.err
    assert not (tmp_path / "d").exists()


def test_every_key_of_the_file_arrives(tmp_path):
    (tmp_path / "t.toml").write_text((EXAMPLE / "tendon.toml").read_text())
    (tmp_path / "d.toml").write_text(
        "[dataset]\nsamples = 5\n[robot]\nrobots = ['t.toml', 't.toml']\n[markers]\nat = [0.5, 1]\n"
        "[loads]\ncontacts = 2\nfamily = 'gaussian'\nforce_scale = [1, 2]\ndistribution = 'log-uniform'\n"
        "location = [0.1, 0.9]\nmin_gap = 0.2\nwidth = [0.01, 0.1]\n[vary]\ntension = [1, 2]\ngravity = 'any'\n"
    )
    read = read_dataset_spec(tmp_path / "d.toml", seed=7)
    assert (read.samples, read.shard_size, read.seed, read.noise, len(read.robots)) == (5, 10_000, 7, 0.0, 2)
    assert (read.contacts, read.family, read.force, read.force_unit) == (2, "gaussian", (1.0, 2.0), "EI/L^2")
    assert (read.distribution, read.location, read.min_gap, read.width) == ("log-uniform", (0.1, 0.9), 0.2, (0.01, 0.1))
    assert (read.markers, read.tension, read.gravity) == ((0.5, 1.0), (1.0, 2.0), (9.81, 9.81))
