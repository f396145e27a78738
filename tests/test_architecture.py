"""Layering of the package: imports between its top-level modules point one way."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import epo_lightning

ROOT = Path(epo_lightning.__file__).parent
FLOORS = {
    "batch": set(),
    "doubts": {"scene"},
    "frames": {"scene"},
    "scene": {"batch"},
    "forecast": {"batch"},
    "registry": set(),
    "checks": {"registry"},
    "arguments": {"registry"},
    "schema": {"registry"},
    "task": {"scene", "registry"},
    "identity": {"registry"},
    "masking": set(),
    "host": set(),
    "warp_kernels": set(),
    "pretrained": {"scene", "registry"},
    "files": {"registry"},
    "run_folder": {"registry", "masking", "pretrained", "files"},
    "optimizers": {"registry", "checks"},
    "schedules": set(),
    "losses": {"schedules"},
    "game": {"scene", "forecast", "registry", "checks", "host"},
    "solvers": {"game", "scene", "forecast", "registry", "checks", "host", "warp_kernels"},
    "refinement": {"doubts", "game", "solvers", "scene", "forecast", "registry", "checks"},
    "predictions": {"scene", "registry", "files", "refinement"},
    "encoders": {"scene"},
    "metrics": {"scene", "forecast", "registry", "checks"},
    "decoders": {"scene", "registry", "checks", "game", "host", "warp_kernels"},
    "backbones": {"scene", "task", "registry", "encoders", "decoders"},
    "data": {"scene", "frames", "registry", "schema", "checks", "task", "metrics", "files"},
    "objectives": {"scene", "forecast", "registry", "checks", "game", "solvers", "decoders", "losses", "schedules"},
    "forecasters": {
        "scene",
        "doubts",
        "forecast",
        "task",
        "objectives",
        "registry",
        "checks",
        "game",
        "solvers",
        "backbones",
        "decoders",
        "metrics",
        "losses",
        "schedules",
        "optimizers",
        "pretrained",
        "refinement",
    },
    "explore": {"scene", "forecast", "registry", "schema", "forecasters", "game", "metrics", "solvers"},
    "drive": {
        "frames",
        "batch",
        "scene",
        "forecast",
        "registry",
        "schema",
        "checks",
        "data",
        "game",
        "solvers",
        "refinement",
        "forecasters",
        "metrics",
        "report",
        "files",
    },
    "report": {"checks", "scene", "forecast", "registry", "files", "run_folder", "identity", "masking"},
}
"""Top-level modules that each one may import besides itself; `experiment` and `cli` may import all."""


def imported_rooms(path: Path) -> set[str]:
    rooms = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("epo_lightning."):
            rooms.add(node.module.split(".")[1])
        elif isinstance(node, ast.ImportFrom) and node.module == "epo_lightning":
            rooms |= {name.name for name in node.names}
        elif isinstance(node, ast.Import):
            rooms |= {name.name.split(".")[1] for name in node.names if name.name.startswith("epo_lightning.")}
    return rooms


def test_no_room_imports_from_a_higher_floor():
    wrong = []
    for room, allowed in FLOORS.items():
        home = ROOT / room
        for path in home.rglob("*.py") if home.is_dir() else [home.with_suffix(".py")]:
            higher = imported_rooms(path) - allowed - {room}
            wrong += [f"{path.relative_to(ROOT)} imports {other}" for other in higher]
    assert not wrong, "\n".join(wrong)


def test_every_room_has_its_floor():
    rooms = {path.stem for path in ROOT.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert rooms - {"__init__", "cli", "experiment", "conf", "sweeps"} == set(FLOORS)


def modules() -> dict[str, Path]:
    """All modules of the package by name; a package is its ``__init__``."""
    found = {}
    for path in ROOT.rglob("*.py"):
        words = path.relative_to(ROOT.parent).with_suffix("").parts
        found[".".join(words[:-1] if words[-1] == "__init__" else words)] = path
    return found


def imports(tree: ast.AST) -> Iterator[str]:
    """Everything that a module imports of this package, also inside functions; not what only type checkers see."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{name.name}" for name in node.names)
        elif isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        yield from imports(node)


def import_graph(known: dict[str, Path]) -> dict[str, set[str]]:
    """The modules that each module imports."""
    graph = {}
    for module, path in known.items():
        names = set(imports(ast.parse(path.read_text())))
        # `from a.b import c` is the module a.b.c where there is one, and else the module a.b.
        graph[module] = {name if name in known else name.rpartition(".")[0] for name in names} & known.keys() - {module}
    return graph


def test_no_circle_of_imports_also_inside_functions():
    graph = import_graph(modules())
    assert "epo_lightning.experiment.train" in graph["epo_lightning.experiment.verbs"], "imports inside functions count"
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        raise AssertionError(" -> ".join(reversed(error.args[1]))) from None
