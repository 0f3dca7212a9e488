"""The build of the kernel with compilers that are scripts: whatever they do, the library or one warning."""

import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.fresh import Fresh
from tests.test_fast import needs_compiler
from torchrod.cli import main
from torchrod.kernel import bindings, build

# build.py alone, which needs no torch and starts at once.
ALONE = f"import sys; sys.path.insert(0, {str(build.FOLDER)!r}); import build\n"
LOADED = ALONE + "found = build.find(lambda library: None); assert not isinstance(found, str), found"
SAID = (
    ALONE
    + """
found = [build.find(lambda library: None) for _ in range(3)]
assert isinstance(found[0], str) and found == found[:1] * 3, found
print(found[0])
"""
)


def compiler(folder: Path, *lines: str) -> Path:
    """A script that is run as a compiler; $last: the file to be written, the last argument."""
    script = folder / "c++"
    script.write_text("\n".join(("#!/bin/sh", "for last; do :; done", *lines, "")))
    script.chmod(0o755)
    return script


def copying(folder: Path, *lines: str) -> Path:
    """One that hands out the library that is there."""
    return compiler(folder, *lines, f'cp "{build.target()}" "$last"')


def begin(code: str, cxx: Path | str, cache: Path, **more: str) -> subprocess.Popen[str]:
    environment = {"PATH": "/usr/bin:/bin", "CXX": str(cxx), "TORCHROD_CACHE": str(cache)} | more
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, "-c", code], env=environment, **pipes)


def ended(process: subprocess.Popen[str]) -> tuple[str, str]:
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    return out, err


def run(code: str, cxx: Path | str, cache: Path, **more: str) -> str:
    return ended(begin(code, cxx, cache, **more))[0]


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
    assert left(own) == [".sha256", ".so"]
    assert own.stat().st_mode & 0o777 == 0o700
    own.chmod(0o777)
    assert "chmod go-w" in run(homeless + SAID, cxx, Path(), TORCHROD_CACHE="", TMPDIR=str(tmp_path))


@needs_compiler
def test_cxx_may_be_several_words(tmp_path):
    cxx = copying(tmp_path, 'test "$1" = -m64 || exit 1')
    run(LOADED, f"env {cxx} -m64", tmp_path / "cache")


@needs_compiler
def test_a_compiler_may_print_as_much_as_it_likes(tmp_path):
    cxx = copying(tmp_path, "head -c 300000 /dev/zero | tr '\\0' x >&2")
    run(LOADED, cxx, tmp_path / "cache")
    assert left(tmp_path / "cache") == [".sha256", ".so"]


def waiting(folder: Path, what: str) -> None:
    """Until a compiler has left a mark in the folder."""
    end = time.monotonic() + 60
    while not (folder / what).exists():
        assert time.monotonic() < end
        time.sleep(0.02)


FORKED = (
    ALONE
    + """
import os, pathlib, threading, time
def there():
    return not isinstance(build.find(lambda library: None), str)
def child():
    pid = os.fork()
    if pid == 0:
        try:
            os._exit(0 if there() else 1)
        except BaseException:
            os._exit(2)
    return pid
thread = threading.Thread(target=there)
thread.start()
while not pathlib.Path({builds!r}).exists():
    time.sleep(0.02)
early = child()  # while the build is under way, with the thread's locks held
thread.join()
for pid in (early, child()):
    assert os.waitpid(pid, 0)[1] == 0
assert there()
"""
)


@needs_compiler
def test_a_forked_child_waits_for_its_parents_build(tmp_path):
    builds = tmp_path / "builds"
    cxx = copying(tmp_path, f"echo once >> {builds}", "sleep 1")
    run(FORKED.replace("{builds!r}", repr(str(builds))), cxx, tmp_path / "cache")
    assert builds.read_text() == "once\n"


THREADS = (
    ALONE
    + """
import threading
start, found = threading.Barrier(8), []
def ask():
    start.wait()
    found.append(build.find(lambda library: None))
threads = [threading.Thread(target=ask) for _ in range(8)]
for thread in threads: thread.start()
for thread in threads: thread.join()
assert len(found) == 8 and found == found[:1] * 8 and not isinstance(found[0], str)
"""
)


@needs_compiler
def test_threads_that_ask_at_once_begin_one_build_under_a_name_of_its_own(tmp_path):
    cxx = copying(tmp_path, "sleep 0.3", f'echo "$last" >> {tmp_path}/builds')
    for cache in ("a", "b"):
        run(THREADS, cxx, tmp_path / cache)
    names = [Path(line).name for line in (tmp_path / "builds").read_text().splitlines()]
    assert len(names) == 2
    assert all(len(name.split(".")[1]) == 32 for name in names), names


@needs_compiler
def test_processes_that_begin_at_once_build_once(tmp_path):
    """And both wait for it, with one line each."""
    cxx = copying(tmp_path, f"echo once >> {tmp_path}/builds", "sleep 1")
    both = [begin(LOADED, cxx, tmp_path / "cache") for _ in range(2)]
    assert [ended(process)[1] for process in both] == [build.LINE + "\n"] * 2
    assert (tmp_path / "builds").read_text() == "once\n"
    assert left(tmp_path / "cache") == [".sha256", ".so"]


@needs_compiler
def test_where_folders_cannot_be_locked_two_builds_do_no_harm(tmp_path):
    cxx = copying(tmp_path, "sleep 1")
    unlocked = "import fcntl\ndef flock(*_): raise OSError(95, 'not supported')\nfcntl.flock = flock\n"
    for process in [begin(unlocked + LOADED, cxx, tmp_path / "cache") for _ in range(2)]:
        ended(process)
    assert left(tmp_path / "cache") == [".sha256", ".so"]
    assert ended(begin(LOADED, cxx, tmp_path / "cache"))[1] == ""


BUILD = """
import sys
from torchrod.cli import main
sys.exit(main(["build"]))
"""


def test_ctrl_c_leaves_no_compiler_and_no_file_behind(tmp_path):
    """With one line, and the next command begins anew."""
    cxx, cache = compiler(tmp_path, f"echo $$ > {tmp_path}/pid", 'echo half > "$last"', "sleep 300"), tmp_path / "cache"
    process = Fresh(BUILD, tmp_path, {"PATH": "/usr/bin:/bin", "CXX": str(cxx), "TORCHROD_CACHE": str(cache)})
    waiting(tmp_path, "pid")
    time.sleep(0.2)
    os.kill(process.pid, signal.SIGINT)
    done = process.ended()
    assert (done.returncode, done.stderr) == (130, f"{build.LINE}\ntorchrod: interrupted\n")
    assert left(cache) == []
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


def test_a_compiler_that_hangs_is_given_up(tmp_path):
    cxx = compiler(tmp_path, "sleep 300")
    hasty = "build.GIVE_UP = 0.5\n"
    assert "has not finished in" in run(SAID.replace(ALONE, ALONE + hasty), cxx, tmp_path / "cache")
    assert left(tmp_path / "cache") == []


@needs_compiler
def test_libraries_that_nobody_has_loaded_for_long_go(tmp_path):
    cxx, cache, long_ago = copying(tmp_path), tmp_path / "cache", time.time() - 100 * 24 * 3600
    run(LOADED, cxx, cache)
    first = sorted(cache.iterdir())
    for path in (*first, cache / "kernel-old.so", cache / "notes"):
        path.touch()
        os.utime(path, (long_ago, long_ago))
    run(LOADED, cxx, cache)  # which is a use of both of its files
    (cache / "kernel-new.so").touch()
    run(LOADED, f"env {cxx}", cache)
    names = {path.name for path in cache.iterdir()}
    assert len(names) == 6
    assert {*(path.name for path in first), "kernel-new.so", "notes"} < names


def spoiled(how: str, library: Path) -> None:
    """A library as a full disk, a killed copy or another machine may leave it."""
    data, checksum = library.read_bytes(), library.with_suffix(".sha256")
    if how in ("empty", "truncated"):
        library.write_bytes(b"" if how == "empty" else data[: len(data) // 2])
    elif how == "one bit":
        library.write_bytes(data[:-1000] + bytes([data[-1000] ^ 1]) + data[-999:])
    elif how == "another checksum":
        checksum.write_bytes(b"\xff\xfe")
    else:
        checksum.unlink()


@needs_compiler
@pytest.mark.parametrize("how", ["empty", "truncated", "one bit", "another checksum", "no checksum"])
def test_a_library_that_is_not_whole_is_made_anew(tmp_path, how):
    cxx, cache = copying(tmp_path), tmp_path / "cache"
    run(LOADED, cxx, cache)
    (library,) = cache.glob("*.so")
    whole = library.read_bytes()
    spoiled(how, library)
    _, err = ended(begin(LOADED, cxx, cache))
    assert err == build.LINE + "\n"
    assert library.read_bytes() == whole
    assert ended(begin(LOADED, cxx, cache))[1] == ""


OTHER = """
// As torchrod_layout of a library of other sources.
extern "C" {
%s
long torchrod_lanes() { return 4; }
const char* torchrod_layout() { return R"(%s)"; }
}
"""


def other_library(folder: Path, layout: str, functions: tuple[str, ...]) -> Path:
    """A library whose account of itself is this text, and that has these functions."""
    code, library = folder / "other.cpp", folder / "other.so"
    code.write_text(OTHER % ("\n".join(f"void {name}() {{}}" for name in functions), layout))
    words = (os.environ.get("CXX", "").strip() or "g++").split()
    subprocess.run([*words, "-shared", "-fPIC", str(code), "-o", str(library)], check=True)
    return library


def looking_in(cache: Path, cxx: Path, monkeypatch: pytest.MonkeyPatch):
    """What a new process would find there, with the whole check."""
    library = build.target()
    monkeypatch.setattr(build, "target", lambda: cache / library.name)
    monkeypatch.setattr(build, "_compiler", lambda: str(cxx))

    def found():
        monkeypatch.setattr(build, "_found", [])
        return bindings.found()

    return found


SWAPPED = bindings.layout().replace("step:40:8d decrement:48:8d", "decrement:40:8d step:48:8d")


@needs_compiler
@pytest.mark.parametrize(
    ("layout", "functions", "said"),
    [
        (SWAPPED, (*bindings.FUNCTIONS,), "disagree on Filter"),
        (bindings.layout().replace("paper 2", "paper 3"), (*bindings.FUNCTIONS,), "disagree on paper"),
        (bindings.layout(), (*bindings.FUNCTIONS,)[1:], "lacks a function"),
    ],
    ids=["fields in another order", "another constant", "a function is not there"],
)
def test_a_library_of_other_sources_is_made_anew_once(tmp_path, monkeypatch, layout, functions, said):
    """By the compiler; and where that makes no better one there is a sentence instead of a traceback."""
    assert layout != bindings.layout() or len(functions) < len(bindings.FUNCTIONS)
    other, cache = other_library(tmp_path, layout, functions), tmp_path / "cache"
    builds, whole = tmp_path / "builds", build.target().read_bytes()
    fresh = looking_in(cache, copying(tmp_path, f"echo once >> {builds}"), monkeypatch)
    assert not isinstance(fresh(), str)
    library = build.target()
    library.unlink()  # this process has it in its memory: to write over it would kill the process
    library.write_bytes(other.read_bytes())
    library.chmod(0o700)
    library.with_suffix(".sha256").write_text(hashlib.sha256(other.read_bytes()).hexdigest())
    assert not isinstance(fresh(), str)
    assert builds.read_text() == "once\n" * 2
    assert library.read_bytes() == whole
    library.unlink()
    compiler(tmp_path, f'cp {other} "$last"', f"echo once >> {builds}")
    assert said in str(fresh())
    assert builds.read_text() == "once\n" * 3
    assert left(cache) == [".sha256"]


@needs_compiler
def test_the_library_gives_the_account_that_python_expects():
    """Every structure, field, constant and function: the C++ is asked, so that neither side can change alone."""
    library = bindings.library()
    assert library is not None
    assert library.torchrod_layout().decode() == bindings.layout()
    for structure in bindings.STRUCTURES:  # layout.h leaves no field out: they follow one another without a gap
        ends = [0, *(getattr(structure, name).offset + getattr(structure, name).size for name, *_ in structure._fields_)]
        assert [getattr(structure, name).offset for name, *_ in structure._fields_] == ends[:-1]


def planted(where: str, folder: Path, library: Path) -> Path:
    """What the warning has to name, after another user has had access to it."""
    if where in ("the folder is open", "the folder is open to a group"):
        library.parent.chmod(0o777 if where == "the folder is open" else 0o770)
        return library.parent
    if where == "the file is open":
        library.chmod(0o722)
    elif where == "a link":
        library.rename(folder / "elsewhere.so")
        library.symlink_to(folder / "elsewhere.so")
    elif where == "a parent is open":
        folder.chmod(0o777)
        return folder
    elif where == "another's file":
        os.chown(library, 12345, 12345)
    elif where == "another's folder":
        os.chown(library.parent, 12345, 12345)
        return library.parent
    return library


PLACES = ["the folder is open", "the folder is open to a group", "the file is open", "a link", "a parent is open"]
root = pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root can give a file to another user")


@needs_compiler
@pytest.mark.parametrize("where", [*PLACES, *(pytest.param(w, marks=root) for w in ("another's file", "another's folder"))])
def test_no_library_is_loaded_that_another_user_may_have_put_there(tmp_path, where):
    """One warning with the remedy, and the torch path."""
    cxx, folder = copying(tmp_path), tmp_path / "own"
    run(LOADED, cxx, folder / "cache")
    (library,) = (folder / "cache").glob("*.so")
    named = planted(where, folder, library)
    said = run(SAID, cxx, folder / "cache")
    assert str(named) in said
    assert any(remedy in said for remedy in ("chmod go-w", "delete it", "set TORCHROD_CACHE"))
    if where in ("the folder is open", "the folder is open to a group", "the file is open"):
        named.chmod(0o700)
        run(LOADED, cxx, folder / "cache")


@needs_compiler
def test_folders_are_made_for_this_user_alone(tmp_path):
    """Whatever the umask; a folder for everybody that is sticky, as /tmp is, may be above."""
    tmp_path.chmod(0o1777)
    cxx, cache = copying(tmp_path), tmp_path / "a" / "b"
    run("import os; os.umask(0)\n" + LOADED, cxx, cache)
    assert [path.stat().st_mode & 0o777 for path in (cache.parent, cache)] == [0o700, 0o700]
    assert {path.stat().st_mode & 0o022 for path in cache.iterdir()} == {0}
    run(LOADED, cxx, cache)


def test_torchrod_build(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(build, "_found", [])
    monkeypatch.setenv("TORCHROD_FAST", "0")
    assert main(["build"]) == 2
    assert "TORCHROD_FAST=0" in capsys.readouterr().err
    monkeypatch.delenv("TORCHROD_FAST")
    monkeypatch.setattr(build, "target", lambda: tmp_path / "kernel-x.so")
    monkeypatch.setattr(build, "_compiler", lambda: None)
    assert main(["build"]) == 2
    assert "no C++ compiler was found" in capsys.readouterr().err


@needs_compiler
def test_torchrod_build_says_where_the_library_is(capsys):
    assert main(["build"]) == 0
    assert str(build.target()) in capsys.readouterr().out
