"""What a command says and where: no output replaces an input, and no screen loses a result."""

import io
import json
import os
import resource
import signal
import subprocess
import sys
import time
from concurrent.futures import CancelledError
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests import fresh
from tests.problems import posed
from tests.study import study1
from torchrod import Result, estimate, write_result
from torchrod.analysis.diagnosis import diagnose
from torchrod.cli import main, table
from torchrod.cli.parser import COMMANDS
from torchrod.cli.screen import one_line
from torchrod.data import workers
from torchrod.data.shards import prepare_folder
from torchrod.data.spec_file import read_dataset_spec
from torchrod.learned.features import features, kriging, smoothed
from torchrod.util.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "docs" / "example"
ROD, SHAPES = (str(EXAMPLE / name) for name in ("rod.toml", "rod.csv"))
COMMAND = [sys.executable, "-m", "torchrod"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("rod.toml", "rod.csv"):
        (tmp_path / name).write_bytes((EXAMPLE / name).read_bytes())
    return tmp_path


@pytest.mark.parametrize("number", ["-5e-4", "-5E-4", "-1.e-3", "-2.5e+0", "-1", "-0.001"])
@pytest.mark.parametrize("command", list(COMMANDS))
def test_a_negative_number_with_an_exponent_is_a_number(command, number):
    """By every option of every command that takes numbers."""
    parser = COMMANDS[command][0]()
    for action in parser._actions:
        if action.nargs in ("+", 2, 3) and action.option_strings:
            count = action.nargs if isinstance(action.nargs, int) else 2
            required = ["x"] * sum(not a.option_strings and a.required for a in parser._actions)
            others = ["--out", "y"] if any("--out" in a.option_strings and a.required for a in parser._actions) else []
            given = parser.parse_args([*required, *others, action.option_strings[0], *[number] * count])[action.dest]
            given = given[0] if action.dest == "point" else given
            assert [float(v) for v in given] == [float(number)] * count


def test_simulate_takes_it(folder):
    assert main(["simulate", "rod.toml", "--point", "0.2", "1e-3", "-5e-4", "--out", "s.csv"]) == 0


@pytest.mark.parametrize("steps", ["1e20", "0", "-3", "9" * 30, "x"])
def test_steps_are_a_number_of_them(folder, capsys, steps):
    assert main(["estimate", "rod.toml", "rod.csv", "--steps", steps]) == 2
    assert "from 1 to 100,000" in (said := capsys.readouterr().err)
    assert said.count("\n") == 1
    assert main(["estimate", "rod.toml", "rod.csv", "--steps", "10"]) == 0


def test_no_output_replaces_an_input(folder, capsys):
    """By its name, by another name, through links of both kinds; nor another output, nor the card of a checkpoint."""
    np.savez("s.npz", s=np.array([0.2, 0.4]), positions=np.array([[[0, 0, 0.2], [0, 0, 0.4]]]))
    (folder / "in.json").write_text("{}")
    (folder / "w.json").write_text("{}")
    (folder / "soft.npz").symlink_to("s.npz")
    os.link("s.npz", "hard.npz")
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    for command in (
        *(["estimate", "rod.toml", "s.npz", "--out", out] for out in ("s.npz", "./s.npz", "soft.npz", "hard.npz")),
        ["estimate", "rod.toml", "soft.npz", "--out", "s.npz"],
        ["estimate", "rod.toml", "s.npz", "--out", "a.json", "--plot", "./a.json"],
        ["estimate", "rod.toml", "s.npz", "--warm-start", "w.safetensors", "--out", "w.json"],
        ["plot", "rod.toml", "rod.csv", "in.json", "--out", "in.json"],
        ["calibrate", "rod.toml", "rod.csv", "--out", "rod.toml"],
        ["simulate", "rod.toml", "--out", "rod.toml"],
        ["observability", "rod.toml", "--out", "a.png", "--json", "b.json", "--csv", "rod.toml"],
        ["simulate-dataset", "rod.toml", "--out", "rod.toml"],
    ):
        assert main(command) == 2, command
        said = capsys.readouterr().err
        assert "would be lost; give another name" in said
        assert said.count("\n") == 1
        assert {p.name: p.read_bytes() for p in folder.iterdir()} == before


# A command for each screen, in a process of its own.
SCREENS = """
import io, json, os, sys
from torchrod.cli import main
command = ["estimate", "rod.toml", "s.csv", "--steps", "10", "--out"]

def see(screen):
    os.dup2(os.open(f"{screen}.err", os.O_WRONLY | os.O_CREAT), 2)
    reader, writer = os.pipe()
    os.close(reader)
    full, ascii = os.open("/dev/full", os.O_WRONLY), os.open("ascii.out", os.O_WRONLY | os.O_CREAT)
    files = {"closed pipe": writer, "full": full, "ascii": ascii}
    sys.stdout = None  # as Python has it where there is no file 1
    os.close(1)
    if screen in files:
        os.dup2(files[screen], 1)
        sys.stdout = io.TextIOWrapper(open(1, "wb", closefd=False), "ascii" if screen == "ascii" else "utf-8")

status = {}
for screen in ("closed pipe", "full", "ascii", "none"):
    child = os.fork()
    if child == 0:
        see(screen)
        sys.exit(main([*command, f"{screen}.json"]))
    status[screen] = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
json.dump(status, sys.stdout)
"""


def test_no_screen_loses_a_result(folder):
    """The files are written before the first word."""
    name = "Prüfling-β"
    text = (folder / "rod.csv").read_text().splitlines()
    (folder / "s.csv").write_text("\n".join([text[0], *(f"{name}," + row.split(",", 1)[1] for row in text[1:21])]))
    done = fresh.run(SCREENS, folder, **os.environ)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"closed pipe": 0, "full": 2, "ascii": 0, "none": 0}
    for screen in json.loads(done.stdout):
        said = (folder / f"{screen}.err").read_text()
        full = "torchrod: standard output: cannot be written (No space left on device); free some space on its disk\n"
        assert said == (full if screen == "full" else ""), screen
        (record,) = json.loads((folder / f"{screen}.json").read_text())["results"]
        assert record["sample"] == name
    assert "Pr\\xfcfling-\\u03b2" in (folder / "ascii.out").read_text()


@pytest.mark.study
def test_an_interrupted_command_says_so_in_one_line(folder):
    """While the processes that it has begun still import torch, or work."""
    text = (EXAMPLE / "dataset.toml").read_text()
    (folder / "dataset.toml").write_text(text.replace("shard_size = 5_000", "shard_size = 50"))
    going = subprocess.Popen(
        [*COMMAND, "simulate-dataset", "dataset.toml", "--out", "d", "--workers", "2"],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    patience = time.time() + 60
    while not (folder / "d" / "spec.json").exists() and time.time() < patience:
        time.sleep(0.05)
    time.sleep(0.5)
    os.killpg(going.pid, signal.SIGINT)
    _, said = going.communicate(timeout=120)
    assert going.returncode == 130
    assert said == "torchrod: interrupted\n"


def test_line_ends_in_names_stay_in_one_line(folder, capsys):
    assert main(["estimate", "no\nsuch\x1b[1m.toml", "rod.csv"]) == 2
    assert capsys.readouterr().err.startswith("torchrod: no\\nsuch\\x1b[1m.toml: cannot be read")
    (folder / "r.toml").write_text('[rod]\n"len\\ngth" = 1\n')
    assert main(["estimate", "r.toml", "rod.csv"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert main(["estimate", "no\0.toml", "rod.csv"]) == 2
    assert "no file has a NUL in its name" in capsys.readouterr().err
    assert one_line("a\ud800\u2028é") == "a\\ud800\\u2028é"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture(scope="module")
def fitted():
    torch.set_default_dtype(torch.float64)
    study = study1(120)
    torch.manual_seed(0)
    positions = study.positions + 2e-3 * torch.randn(120, 20, 3)
    problem = posed(study.s, positions, 2e-4)  # less noise than there is: none is accepted
    fit = estimate(problem)
    return problem, fit, diagnose(problem, replace(fit, accepted=fit.accepted | True))


def test_a_long_table_is_cut_on_a_terminal_only(fitted, monkeypatch):
    _, fit, quiet = fitted
    names = [str(b) for b in range(120)]
    whole = table.table(fit, names, quiet, None).splitlines()
    assert len(whole) == 242
    assert whole[-1].startswith(f"120 samples: {int((fit.status == 0).sum())} converged")
    assert whole[-1].endswith("; 0 accepted")
    monkeypatch.setattr(sys, "stdout", Terminal())
    cut = table.table(fit, names, quiet, None).splitlines()
    few = table.table(fit, names[:1] * 120, quiet, None).splitlines()
    monkeypatch.undo()
    assert len(cut) == len(few) == 53
    assert cut[:41] == whole[:41]
    assert (
        cut[41]
        == "... 80 more samples and 110 more sentences: with --out in RESULT, or here where the output goes to a file or a pipe"
    )
    assert cut[42:52] == whole[121:131]
    assert cut[-1] == whole[-1]


def test_a_result_needs_a_name_for_every_sample(fitted, tmp_path):
    for suffix in (".json", ".npz"):
        for names in (["a"], ["a"] * 121):
            with pytest.raises(InputError, match=f"{len(names)} names for 120 samples"):
                write_result(tmp_path / f"r{suffix}", Result(fitted[1], names, "rod"))
    assert not list(tmp_path.iterdir())


def test_table_and_records_are_linear_in_the_samples(fitted, tmp_path, monkeypatch):
    """What a result works out for its whole batch is asked for once, whatever the number of samples."""
    asked: list[str] = []
    cls = type(fitted[1])
    for name in ("magnitude", "magnitude_location_covariance", "rms_residual", "location_interval"):
        inner = getattr(cls, name).fget
        monkeypatch.setattr(cls, name, property(lambda self, inner=inner, name=name: (asked.append(name), inner(self))[1]))
    counts = []
    for write in (
        lambda: table.table(fitted[1], ["a"] * 120, fitted[2], None),
        lambda: write_result(tmp_path / "r.json", Result(fitted[1], ["a"] * 120, "rod", diagnosis=fitted[2])),
        lambda: write_result(tmp_path / "r.npz", Result(fitted[1], ["a"] * 120, "rod", diagnosis=fitted[2])),
    ):
        asked.clear()
        write()
        counts.append(len(asked))
    assert max(counts) <= 12


def test_two_specifications_in_one_folder(tmp_path):
    """At one time, when neither has written a shard yet; and a claim that cannot be read is written anew."""
    (tmp_path / "rod.toml").write_bytes((EXAMPLE / "rod.toml").read_bytes())
    text = '[dataset]\nsamples = 3\n[robot]\nfile = "rod.toml"\n[loads]\nforce = [0.1, 0.2]\nlocation = [0.2, 1.0]\n'
    (tmp_path / "a.toml").write_text(text)
    one, other = read_dataset_spec(tmp_path / "a.toml"), read_dataset_spec(tmp_path / "a.toml", seed=7)
    folder = tmp_path / "d"
    prepare_folder(folder, one)
    prepare_folder(folder, one)
    with pytest.raises(InputError, match=r"another specification \(spec.json\); choose another folder"):
        prepare_folder(folder, other)
    (folder / "spec.json").write_text("")
    prepare_folder(folder, other)
    with pytest.raises(InputError, match="another specification"):
        prepare_folder(folder, one)
    assert [p.name for p in folder.iterdir()] == ["spec.json"]


def encrypted(archive: bytes) -> bytes:
    """An archive whose first member is said to be: bit 0 of the flags, at byte 8 of its entry in the directory."""
    flags = archive.index(b"PK\x01\x02") + 8
    return archive[:flags] + b"\x01" + archive[flags + 1 :]


def test_a_sidecar_or_a_shard_that_is_not_what_it_says_is_made_anew(tmp_path, capsys):
    (tmp_path / "rod.toml").write_bytes((EXAMPLE / "rod.toml").read_bytes())
    (tmp_path / "a.toml").write_text(
        '[dataset]\nsamples = 3\nshard_size = 2\n[robot]\nfile = "rod.toml"\n[loads]\nforce = [0.1, 0.2]\nlocation = [0.2, 1.0]\n'
    )
    command = ["simulate-dataset", str(tmp_path / "a.toml"), "--out", str(tmp_path / "d")]
    assert main(command) == 0
    before = {p.name: p.read_bytes() for p in (tmp_path / "d").iterdir()}
    side, shard = tmp_path / "d" / "shard-00001.json", tmp_path / "d" / "shard-00000.npz"
    for path, content in (
        (side, before[side.name].replace(b'"robot"', b'"robbt"')),
        (side, before[side.name].replace(b'"samples": 1', b'"samples": 2')),
        (side, b"[" * 100_000),
        (shard, encrypted(before[shard.name])),
        (shard, before[shard.name].replace(b"'descr'", b"'''escr")),
    ):
        assert content != before[path.name]
        path.write_bytes(content)
        assert main(command) == 0
        assert "shards made 1, kept 1" in capsys.readouterr().out
        assert {p.name: p.read_bytes() for p in (tmp_path / "d").iterdir()} == before


def test_arc_lengths_of_their_own_are_smoothed_each_by_itself():
    """Samples that share no marker, in one batch, as each alone: and by no matrix of all markers together."""
    B, n = 60, 12
    torch.manual_seed(0)
    rows = torch.sort(0.05 + 0.95 * torch.rand(B, n), -1).values
    s = rows.flatten().sort().values
    y = torch.full((B, len(s), 3), torch.nan)
    alone = []
    for b in range(B):
        own = torch.stack([rows[b] ** 2 * torch.rand(()), rows[b] ** 3, 0 * rows[b]], -1)
        y[b, torch.searchsorted(s, rows[b])] = own
        alone.append(smoothed(rows[b], own[None], torch.ones(1, n, dtype=torch.bool), 1.0, 1e-3))
    seen = torch.isfinite(y).all(-1)
    assert (seen.sum(-1) == n).all()
    together = smoothed(s, y, seen, 1.0, 1e-3)
    for part in (0, 1):
        assert torch.allclose(together[part], torch.cat([one[part] for one in alone]), atol=1e-9)
    assert kriging(rows[:2], 1e-3).shape == (2, 40, n)
    blind = torch.zeros(2, n, dtype=torch.bool)
    assert not any(part.any() for part in smoothed(rows[0], torch.zeros(2, n, 3), blind, 1.0, 1e-3))


@pytest.mark.skipif(not Path("/proc/self/statm").is_file(), reason="no /proc here, which tells how much memory a process has")
def test_400_samples_with_arc_lengths_of_their_own_take_little_memory():
    """No more than 500 MB is to be had here; with one matrix of all 8,000 markers for each sample it took 200 GB."""
    B, n = 400, 20
    s = torch.linspace(0.01, 1, B * n)
    seen = torch.zeros(B, B * n, dtype=torch.bool)
    seen.scatter_(1, torch.arange(B * n).reshape(n, B).T, True)
    y = torch.where(seen.unsqueeze(-1), s[:, None] ** 2, torch.nan).expand(B, B * n, 3)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 500 * 10**6, before[1]))
    try:
        smooth, k = smoothed(s, y, seen, 1.0, 1e-3)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
    assert torch.isfinite(smooth).all() and torch.isfinite(k).all()


def test_features_of_gaps_are_nearly_those_without(fitted):
    """One marker of twenty left out changes little, and the batch decides nothing."""
    markers = fitted[0].markers
    positions = markers.positions.clone()
    positions[::2, 7] = torch.nan
    gaps, alone, whole = (features(posed(markers.s, p)) for p in (positions, positions[:1], markers.positions))
    assert (gaps.amp / whole.amp - 1).abs().max() < 0.2
    assert torch.allclose(gaps.x[:1], alone.x, atol=1e-9)


def test_a_scheduler_that_dies_is_told_in_one_sentence(monkeypatch):
    """The client cancels every task then."""
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed: pip install torchrod[scale]")

    class Client:
        def __init__(self, *_, **__): ...

        __enter__ = __exit__ = lambda *_: None

        def get_executor(self, pure):
            assert not pure

    monkeypatch.setattr(distributed, "Client", Client)
    with (
        pytest.raises(InputError, match="--scheduler tcp://a:1: has died; start it and run the command again"),
        workers._cluster("tcp://a:1"),
    ):
        raise CancelledError
