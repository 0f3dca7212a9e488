"""Files are written as a whole or not at all, and what cannot be read or written is said in one sentence."""

import errno
import os
import re
import stat
from pathlib import Path

import pytest
import torch

from tests.robots import T
from torchrod import Shapes, WarmStart, read_robot, read_shapes, write_shapes
from torchrod.cli import main
from torchrod.cli.arguments import writable
from torchrod.io import read_fit
from torchrod.util import files
from torchrod.util.errors import InputError
from torchrod.util.files import put, put_text

ROOT = Path(__file__).resolve().parents[1]
SHAPES = Shapes(T([0.1, 0.2]), torch.zeros(1, 2, 3), ["0"])


def full(_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_file_is_what_it_was_when_writing_fails(tmp_path, monkeypatch):
    """Half of it is written when the disk is full."""
    path = tmp_path / "result.json"
    path.write_text("old")

    def write(file):
        file.write(b"half")
        full(file)

    with pytest.raises(InputError, match=r"result.json: cannot be written \(No space left on device\); free some space"):
        put(path, write)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("command", ["estimate json", "estimate npz", "plot", "observability png", "observability csv"])
def test_no_command_destroys_what_is_there(tmp_path, monkeypatch, command):
    name, _, suffix = command.partition(" ")
    path = tmp_path / f"out.{suffix or 'png'}"
    robot, shapes = (str(ROOT / "docs" / "example" / file) for file in ("rod.toml", "rod.csv"))
    option = "--csv" if suffix == "csv" else "--out"
    arguments = {"estimate": [robot, shapes], "plot": [robot, shapes, str(tmp_path / "r.json")], "observability": [robot]}[name]
    if name == "plot":
        assert main(["estimate", robot, shapes, "--out", arguments[-1]]) == 0
    path.write_text("old")
    monkeypatch.setattr(Path, "replace", lambda *_: full(None))
    assert main([name, *arguments, option, str(path)]) == 2
    assert path.read_text() == "old"
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        {path.name, Path(arguments[-1]).name} if name == "plot" else {path.name}
    )


def test_modes_and_links(tmp_path):
    path, link = tmp_path / "a.csv", tmp_path / "b.csv"
    before = os.umask(0o027)
    try:
        write_shapes(path, SHAPES)
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    path.chmod(0o604)
    link.symlink_to(path.name)
    put_text(link, "new")
    assert link.is_symlink()
    assert path.read_text() == "new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o604


def test_what_is_no_file_is_written_to_as_it_is(tmp_path, capfd):
    for target, words in (("/dev/null", None), ("/dev/stdout", None), ("/dev/full", "free some space")):
        link = tmp_path / f"{Path(target).name}.csv"
        link.symlink_to(target)
        if words is None:
            write_shapes(link, SHAPES)
        else:
            with pytest.raises(InputError, match=words):
                write_shapes(link, SHAPES)
        assert link.is_symlink()
        assert link.stat()
    assert capfd.readouterr().out.startswith("sample,s,x,y,z")


def test_refusals_name_path_and_remedy(tmp_path, monkeypatch):
    (tmp_path / "loop.csv").symlink_to("loop.csv")
    kept = tmp_path / "kept.csv"
    kept.write_text("old")
    monkeypatch.setattr(files.os, "access", lambda path, mode: Path(path) != kept)  # root may do anything
    for path, words in (
        ("/proc/x.csv", "No such file or directory"),
        (tmp_path / ("n" * 300 + ".csv"), "give a shorter name"),
        (tmp_path / "loop.csv", "mend the links"),
        (tmp_path, "give a file, not a folder"),
        (tmp_path / "no" / "x.csv", "check the folder"),
        (kept, "that you may write to"),
    ):
        with pytest.raises(InputError, match=rf"^{re.escape(str(path))}: cannot be written .*{words}"):
            put_text(path, "")
    put_text(tmp_path / ("n" * 251 + ".csv"), "")
    assert kept.read_text() == "old"
    for name in ("n" * 300 + ".csv", "loop/x.csv"):
        (tmp_path / "loop").unlink(missing_ok=True)
        (tmp_path / "loop").symlink_to("loop")
        with pytest.raises(InputError):
            writable(str(tmp_path / name), (".csv",))


def test_what_cannot_be_read_is_one_sentence(tmp_path, monkeypatch):
    (tmp_path / "ok.csv").write_bytes((ROOT / "docs" / "example" / "rod.csv").read_bytes())
    for name in ("a.csv", "a.npz", "a.json", "a.safetensors", "a.toml"):
        (tmp_path / name).write_text("{}")
    opened, robot = Path.open, read_robot(ROOT / "docs" / "example" / "rod.toml")

    def denied(path, *arguments, **options):  # root is denied nothing
        if path.stem == "a":
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        return opened(path, *arguments, **options)

    monkeypatch.setattr(Path, "open", denied)
    for read, suffixes in (
        (lambda path: read_shapes(path, robot), (".csv", ".npz")),
        (lambda path: read_fit(path, "0"), (".npz", ".json")),
        (WarmStart.read, (".safetensors",)),
        (read_robot, (".toml",)),
    ):
        for suffix in suffixes:
            with pytest.raises(InputError, match=r"cannot be read \(Permission denied\); ask for the permission to read it$"):
                read(str(tmp_path / f"a{suffix}"))
            with pytest.raises(InputError, match="give a shorter name"):
                read(str(tmp_path / ("n" * 300 + suffix)))
