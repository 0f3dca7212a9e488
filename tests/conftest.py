"""The reference data's two homes, float64 everywhere, and what is left out where there is no compiled kernel."""

import json
import os
from pathlib import Path

import pytest
import torch

from torchrod import kernel

if "PYTEST_XDIST_WORKER" in os.environ:  # one thread per worker, and per process that it starts: the workers share the cores
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))

# A process that a test starts finds the tests and the studies where the test does.
ROOT = Path(__file__).resolve().parents[1]
os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), str(ROOT / "scripts"), *filter(None, [os.environ.get("PYTHONPATH")])])

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data" / "third_party"


def pytest_collection_modifyitems(items):
    """Without the kernel a fit takes hundreds of times longer: tests of many of them would take hours."""
    if os.environ.get("TORCHROD_EVERY") or kernel.available():
        return
    reason = "no kernel here, and this takes minutes by the torch path; TORCHROD_EVERY=1 runs it all the same"
    for item in items:
        if item.get_closest_marker("many_fits"):
            item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(autouse=True)
def _float64():
    torch.set_default_dtype(torch.float64)


@pytest.fixture
def shared():
    """The third-party data that may be read but not copied; tests skip where it is not at hand."""
    if not SHARED.is_dir():
        pytest.skip(f"{SHARED} is not on this machine; it holds third-party data that the project may not copy")
    return SHARED


def reference(name: str):
    return json.loads((Path(__file__).parent / "data" / f"{name}_reference.json").read_text())
