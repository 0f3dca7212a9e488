"""The reference data's two homes, and float64 everywhere."""

import json
from pathlib import Path

import pytest
import torch

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data" / "third_party"


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
