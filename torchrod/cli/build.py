"""torchrod build: the compiled kernel, before the first estimate needs it."""

from pathlib import Path

from jsonargparse import Namespace

from .. import kernel
from ..kernel.build import target
from ..util.errors import InputError


def build(options: Namespace) -> None:
    """Build the kernel where it is not there yet, and say where it lies.

    Errors: InputError where it cannot be built or loaded. Everything works without it, more slowly.
    """
    found = kernel.found()
    if isinstance(found, str):
        raise InputError(f"no compiled kernel ({found}); the torch path, hundreds of times slower, will be used")
    print(f"compiled kernel: {Path(target())}")  # noqa: T201
