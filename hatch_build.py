"""pip's build of torchrod also compiles the kernel for this machine, where it has a compiler, so that the first estimate finds it.

The library goes where the first estimate would put it (torchrod/kernel/build.py), under a name made of the sources, the compiler
and the processor, and not into the wheel, which stays the same for all machines: elsewhere the name differs, and the kernel is
compiled there. Whatever goes wrong here is said by the first estimate that needs the kernel; the installation goes on.
"""

import importlib.util
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class KernelHook(BuildHookInterface):
    """Called by hatchling before it puts the wheel together."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile."""
        spec = importlib.util.spec_from_file_location("kernel_build", Path(self.root, "torchrod", "kernel", "build.py"))
        assert spec is not None and spec.loader is not None
        build = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(build)
        if not build.off():
            build.find(lambda library: None)
