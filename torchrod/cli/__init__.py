"""The command line: arguments in `parser`, a module for each command. `torchrod --help` does not import torch."""

from .parser import main

__all__ = ["main"]
