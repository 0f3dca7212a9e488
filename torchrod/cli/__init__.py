"""The command line: arguments in `parser`, a module for each command. `torchrod --help` imports neither torch nor lightning."""

from .parser import main

__all__ = ["main"]
