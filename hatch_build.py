"""What building a wheel, or an editable installation, does besides copying files: it compiles the EPO layer's kernel.

A machine without a C++ compiler gets a package without the kernel, which says so when the layer is first used.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class KernelHook(BuildHookInterface):
    """Compiles the kernel into the source tree, from where the wheel takes it."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        path = Path(self.root) / "epo_lightning" / "solvers" / "gauss_newton" / "kernel" / "build.py"
        spec = importlib.util.spec_from_file_location("kernel_build", path)
        assert spec is not None
        assert spec.loader is not None
        kernel = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(kernel)  # by path: importing the package would need PyTorch
        try:
            # An editable installation stays on this machine; a wheel goes to others.
            kernel.build(portable=version != "editable")
        except OSError as error:
            self.app.display_warning(f"the compiled EPO layer was not built, plain PyTorch will do its work: {error}")
            return
        build_data["artifacts"].append(str(kernel.LIBRARY.relative_to(self.root)))
        # A library, but not one of Python's: one wheel per platform serves all versions.
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{kernel.platform_tag()}"
