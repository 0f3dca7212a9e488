"""Worker processes: which paths there are, how each is started, and how it is asked."""

import hashlib
import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from studies import peers

STUDIES = Path(__file__).resolve().parents[1]
ONLY = "import os, sys; os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:{cores}]); os.execv(sys.argv[1], sys.argv[1:])"
PATIENCE = 900  # seconds that a worker may take for a job
TORCHROD = {
    "torchrod": {},
    "torchrod, eager": {"TORCHROD_FAST": "0"},
}


def available(name: str) -> bool:
    """Whether a path can be measured here."""
    return name in TORCHROD or peers.installed(name)


def environment(name: str, caches: Path) -> dict[str, str]:
    """What a worker is started with. numba forgets to look whether functions that a cached one calls have changed."""
    sources = b"".join(path.read_bytes() for path in sorted((STUDIES / "peers").glob("*.py")))
    numba = caches / f"numba-{hashlib.sha256(sources).hexdigest()[:12]}"
    return os.environ | {"NUMBA_CACHE_DIR": str(numba)} | TORCHROD.get(name, {})


class Process:
    """One worker; a context manager."""

    def __init__(self, name: str, caches: Path, cores: int | None = None, more: dict[str, str] | None = None):
        self.name = name
        command = [sys.executable, str(STUDIES / "benchmark" / "worker.py"), name]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        own = environment(name, caches) | (more or {})
        if cores is not None:
            own |= {"OMP_NUM_THREADS": str(cores), "OPENBLAS_NUM_THREADS": str(cores)}
            command = [sys.executable, "-c", ONLY.format(cores=cores), *command]
        self.process = subprocess.Popen(command, env=own, **pipes)

    def ask(self, job: str, **arguments: Any) -> dict[str, Any]:
        """A job's answer. Errors: RuntimeError where the worker failed or took too long; it has said why on standard error."""
        assert self.process.stdin is not None and self.process.stdout is not None
        watch = threading.Timer(PATIENCE, self.process.kill)
        watch.start()
        try:
            self.process.stdin.write(json.dumps({"job": job} | arguments) + "\n")
            self.process.stdin.flush()
            line = self.process.stdout.readline()
        finally:
            watch.cancel()
        if not line:
            raise RuntimeError(f"the worker of {self.name} ended, or was stopped after {PATIENCE} s, on the job {job} {arguments}")
        return json.loads(line)

    def __enter__(self) -> "Process":
        return self

    def __exit__(self, *_: object) -> None:
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()
