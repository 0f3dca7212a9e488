"""JSON as all files of torchrod have it."""

import json
import math
from pathlib import Path
from typing import Any

from ..util.files import put_text


def plain(value: float) -> float | None:
    """JSON has no NaN and no infinity: an unknown number is null."""
    return value if math.isfinite(value) else None


def put_json(path: str | Path, content: dict[str, Any]) -> None:
    """Write a table as JSON, as a whole or not at all. Errors: InputError where the file cannot be written."""
    put_text(path, json.dumps(content, indent=1) + "\n")
