"""Processes in which torch is imported and nothing has been done yet: forks of one that waits, which save the import each time."""

import atexit
import json
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

# Reads {code, environment, folder, files} line by line, runs each in a fork whose output goes into the files, and tells its status.
SERVER = """
import importlib, json, os, pkgutil, sys, traceback
import torch, torchrod
for name in ("cli", "kernel", "estimation", "analysis"):
    package = importlib.import_module("torchrod." + name)
    for found in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"torchrod.{name}.{found.name}")

def child(asked):
    for number, path in zip((1, 2), asked["files"]):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    os.environ.clear()
    os.environ.update(asked["environment"])
    os.chdir(asked["folder"])
    try:
        exec(compile(asked["code"], "<fresh>", "exec"), {"__name__": "__main__"})
    except SystemExit as end:
        return end.code or 0
    except BaseException:
        traceback.print_exc()
        return 1
    return 0

print("{}", flush=True)
for line in sys.stdin:
    pid = os.fork()
    if pid == 0:
        status = child(json.loads(line))
        for stream in filter(None, (sys.stdout, sys.stderr)):
            stream.flush()
        os._exit(status)
    print(json.dumps({"pid": pid}), flush=True)
    print(json.dumps({"status": os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])}), flush=True)
"""


@dataclass(frozen=True)
class Ended:
    """What subprocess.run returns of a process."""

    returncode: int
    stdout: str
    stderr: str


class Fresh:
    """A process that has begun: its id, and how it ends."""

    def __init__(self, code: str, folder: Path, environment: dict[str, str]):
        self._files = [folder / "fresh.out", folder / "fresh.err"]
        asked = {"code": code, "environment": environment, "folder": str(folder), "files": list(map(str, self._files))}
        server = _server()
        assert server.stdin is not None
        server.stdin.write(json.dumps(asked) + "\n")
        server.stdin.flush()
        self.pid = _answer()["pid"]

    def ended(self) -> Ended:
        """Once it has."""
        return Ended(_answer()["status"], *(path.read_text() for path in self._files))


def run(code: str, folder: Path, **environment: str) -> Ended:
    """Code in a process of its own, with nothing but this in its environment."""
    return Fresh(code, folder, environment).ended()


@cache
def _server() -> "subprocess.Popen[str]":
    server = subprocess.Popen([sys.executable, "-c", SERVER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    atexit.register(server.kill)
    assert server.stdout is not None
    assert server.stdout.readline() == "{}\n"
    return server


def _answer() -> dict[str, int]:
    out = _server().stdout
    assert out is not None
    return json.loads(out.readline())
