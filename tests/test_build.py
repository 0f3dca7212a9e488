"""The build of the kernel with compilers that are scripts: whatever they do, the library or one warning."""

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.test_dataset import spec
from tests.test_fast import needs_compiler
from torchrod import kernel
from torchrod.data import workers as production

SAID = """
import warnings
from torchrod import fast
with warnings.catch_warnings(record=True) as seen:
    warnings.simplefilter("always")
    assert [kernel.library(wait=True) for _ in range(3)] == [None] * 3
said = [str(w.message) for w in seen if "no compiled kernel" in str(w.message)]
assert len(said) == 1, said
print(said[0])
"""
LOADED = "from torchrod import fast; assert kernel.library(wait=True) is not None"


def compiler(folder: Path, *lines: str) -> Path:
    """A script that is run as a compiler; $last: the file to be written, the last argument."""
    script = folder / "c++"
    script.write_text("\n".join(("#!/bin/sh", "for last; do :; done", *lines, "")))
    script.chmod(0o755)
    return script


def copying(folder: Path, *lines: str) -> Path:
    """One that hands out the library that is there."""
    built = kernel.library()
    assert built is not None
    return compiler(folder, *lines, f'cp "{built._name}" "$last"')


def run(code: str, cxx: Path | str, cache: Path, **more: str) -> str:
    environment = {"PATH": "/usr/bin:/bin", "CXX": str(cxx), "TORCHROD_CACHE": str(cache)} | more
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout


def left(cache: Path) -> list[str]:
    return sorted(path.suffix for path in cache.iterdir())


def test_a_library_that_cannot_be_loaded_is_said_once(tmp_path):
    junk, cache = compiler(tmp_path, 'echo junk > "$last"'), tmp_path / "cache"
    for _ in range(2):  # just built, and found
        assert "file too short" in run(SAID, junk, cache) or "invalid ELF" in run(SAID, junk, cache)


def test_what_the_compiler_complained_of_is_said(tmp_path):
    cxx = compiler(tmp_path, "echo a word >&2", "echo kernel.cpp:1: error: no such thing >&2", "exit 1")
    assert "kernel.cpp:1: error: no such thing" in run(SAID, cxx, tmp_path / "cache")
    assert left(tmp_path / "cache") == [".log"]


def test_unbalanced_quotes_in_cxx_are_said(tmp_path):
    assert "No closing quotation" in run(SAID, "g++ '-m64", tmp_path / "cache")


@needs_compiler
def test_without_a_home_there_is_the_folder_for_temporary_files(tmp_path):
    """But not one that others can write to."""
    cxx, own = copying(tmp_path), tmp_path / f"torchrod-{os.getuid()}"
    homeless = "from pathlib import Path\nPath.home = lambda: (_ for _ in ()).throw(RuntimeError('no home'))\n"
    run(homeless + LOADED, cxx, Path(), TORCHROD_CACHE="", TMPDIR=str(tmp_path))
    assert left(own) == [".so"]
    assert own.stat().st_mode & 0o777 == 0o700
    own.chmod(0o777)
    assert "TORCHROD_CACHE" in run(homeless + SAID, cxx, Path(), TORCHROD_CACHE="", TMPDIR=str(tmp_path))


@needs_compiler
def test_cxx_may_be_several_words(tmp_path):
    cxx = copying(tmp_path, 'test "$1" = -m64 || exit 1')
    run(LOADED, f"env {cxx} -m64", tmp_path / "cache")


@needs_compiler
def test_a_compiler_may_print_as_much_as_it_likes(tmp_path):
    cxx = copying(tmp_path, "head -c 300000 /dev/zero | tr '\\0' x >&2")
    run(LOADED, cxx, tmp_path / "cache")
    assert left(tmp_path / "cache") == [".so"]


@needs_compiler
def test_a_compiler_may_print_after_the_command_has_ended(tmp_path):
    cxx = copying(tmp_path, "sleep 1", "echo a warning >&2 || exit 1")
    run("from torchrod.fast import build; build.PATIENCE = 0.0; assert build.library() is None", cxx, tmp_path / "cache")
    end = time.monotonic() + 20
    while left(tmp_path / "cache") != [".so"]:
        assert time.monotonic() < end, left(tmp_path / "cache")
        time.sleep(0.05)


FORKED = """
import os, time, warnings
from torchrod.fast import build
warnings.simplefilter("error")
build.PATIENCE = 0.0
assert build.library() is None
for _ in range(2):  # while the build is under way, and after it
    child = os.fork()
    if child == 0:
        try:
            code = 0 if build.library(wait=True) is not None else 1
        except Warning:
            code = 2
        os._exit(code)
    assert os.waitpid(child, 0)[1] == 0
assert build.library(wait=True) is not None
"""


@needs_compiler
def test_a_forked_child_takes_its_parents_build(tmp_path):
    cxx = copying(tmp_path, "sleep 1", f"echo once >> {tmp_path}/builds")
    run(FORKED, cxx, tmp_path / "cache")
    assert (tmp_path / "builds").read_text() == "once\n"


THREADS = """
import threading
from torchrod.fast import build
start, found = threading.Barrier(8), []
def ask():
    start.wait()
    found.append(build.library(wait=True))
threads = [threading.Thread(target=ask) for _ in range(8)]
for thread in threads: thread.start()
for thread in threads: thread.join()
assert len(found) == 8 and None not in found
"""


@needs_compiler
def test_threads_that_ask_at_once_begin_one_build_under_a_name_of_its_own(tmp_path):
    cxx = copying(tmp_path, "sleep 0.3", f'echo "$last" >> {tmp_path}/builds')
    for cache in ("a", "b"):
        run(THREADS, cxx, tmp_path / cache)
    names = [Path(line).name for line in (tmp_path / "builds").read_text().splitlines()]
    assert len(names) == 2
    assert all(len(name.split(".")[1]) == 32 for name in names), names


@needs_compiler
def test_libraries_that_nobody_has_loaded_for_long_go(tmp_path):
    cxx, cache, long_ago = copying(tmp_path), tmp_path / "cache", time.time() - 100 * 24 * 3600
    run(LOADED, cxx, cache)
    (first,) = cache.iterdir()
    for path in (first, cache / "kernel-old.so", cache / "notes"):
        path.touch()
        os.utime(path, (long_ago, long_ago))
    run(LOADED, cxx, cache)
    (cache / "kernel-new.so").touch()
    run(LOADED, f"env {cxx}", cache)
    names = {path.name for path in cache.iterdir()}
    assert len(names) == 4
    assert {first.name, "kernel-new.so", "notes"} < names


SHARD = """
import torch
from torchrod.fast import build
build.PATIENCE = 0.0
torch.set_default_dtype(torch.float64)
from tests.test_dataset import spec
from torchrod.dataset import digest, simulate_shard
print(digest(simulate_shard(spec(samples=20), 0)))
"""


@needs_compiler
def test_a_first_run_makes_the_same_shards_as_the_next(tmp_path):
    cxx = copying(tmp_path, "sleep 2")
    assert run(SHARD, cxx, tmp_path / "cache") == run(SHARD, cxx, tmp_path / "cache")


def test_a_pool_of_processes_finds_the_kernel_built(tmp_path, monkeypatch):
    """Otherwise every one of them would begin a build."""
    events = []
    monkeypatch.setattr(kernel, "library", lambda wait=False: events.append(wait))
    monkeypatch.setattr(production, "ProcessPoolExecutor", lambda *_: ThreadPoolExecutor(1))
    monkeypatch.setattr(production, "simulate_shard", lambda _, index: events.append("shard"))
    monkeypatch.setattr(production, "write_shard", lambda *_: None)
    production.produce(spec(), tmp_path, [0, 1], 2, None, lambda _: None)
    assert events == [True, "shard", "shard"]
