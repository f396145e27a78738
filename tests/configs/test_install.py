"""A plain installation is enough for `make run`: no module needs a package that only an extra brings."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import epo_lightning
from epo_lightning import registry

PACKAGE = Path(epo_lightning.__file__).parent
PROJECT = PACKAGE.parent / "pyproject.toml"
MODULES = {"hydra-core": "hydra", "pillow": "PIL", "protobuf": "google"}
"""Packages that are imported under another name."""
OF_DEPENDENCIES = {"yaml", "hatchling"}
"""PyYAML comes with OmegaConf."""
ON_DEMAND = {"epo_lightning.explore.server": "starlette", "epo_lightning.solvers.gauss_newton.fused_kernel": "warp"}
"""Modules and packages of an extra, which only functions import, and the package that they need."""


def imported_at_once(tree: ast.AST) -> Iterator[str]:
    """Names of the modules that a module imports when it is imported, outside functions and type checking."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            continue
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield str(node.module)
        else:
            yield from imported_at_once(node)


def test_modules_import_without_optional_dependencies() -> None:
    project = tomllib.loads(PROJECT.read_text())["project"]
    names = [re.split(r"[^\w.-]", text)[0] for text in project["dependencies"]]
    known = {MODULES.get(name, name) for name in names} | OF_DEPENDENCIES | sys.stdlib_module_names | {"epo_lightning"}
    foreign = set()
    for path in PACKAGE.rglob("*.py"):
        module = ".".join(("epo_lightning", *path.relative_to(PACKAGE).with_suffix("").parts))
        of_extra = next((own for own in ON_DEMAND if f"{module}.".startswith(f"{own}.")), None)
        for name in imported_at_once(ast.parse(path.read_text())):
            package = name.partition(".")[0]
            on_demand = next((own for own in ON_DEMAND if f"{name}.".startswith(f"{own}.")), None)
            if on_demand != (on_demand and of_extra) or (package not in known and package != ON_DEMAND.get(of_extra)):
                foreign.add(f"{module}: {name}")
    assert not foreign


WITHOUT_EXTRAS = """
import sys

sys.modules.update(dict.fromkeys({packages}))  # an import of them raises ModuleNotFoundError
{work}
"""
OF_EXTRAS = [
    "gymnasium",
    "highway_env",
    "libsumo",
    "mlflow",
    "onnx",
    "onnxruntime",
    "onnxscript",
    "optuna",
    "ray",
    "starlette",
    "sumo",
    "uvicorn",
    "warp",
]
LOOK_UPS = f"""
from epo_lightning.registry import parts

for group in {[group for group in registry._HOMES if group != "metric"]}:
    assert parts(group), group
"""
LOAD = "import epo_lightning; assert epo_lightning.load('rpi/v_lstm_epo')"


def run_without_extras(work: str) -> subprocess.CompletedProcess[str]:
    program = WITHOUT_EXTRAS.format(packages=OF_EXTRAS, work=work)
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("work", [LOOK_UPS, LOAD], ids=["look-ups", "load"])
def test_parts_are_found_and_loaded_without_extras(work: str) -> None:
    """Look-ups import whole folders, so no module in them may need a package of an extra at once."""
    done = run_without_extras(work)
    assert done.returncode == 0, done.stderr


def test_extras_are_really_missing_there() -> None:
    assert "ModuleNotFoundError: import of warp halted" in run_without_extras("import warp").stderr
