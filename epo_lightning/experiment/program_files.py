"""Files of exported programs: how each format is written, and how the program in it is run again.

Every file also has a description of the program, ``about``: its title, time step, inputs and outputs.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.export import ExportedProgram

Tensors = dict[str, Tensor]
Run = Callable[[Tensors], Tensors]
"""A program as a function of its inputs by name."""

COMPILER = {"realize_opcount_threshold": 8, "realize_acc_reads_threshold": 4, "realize_reads_threshold": 1}
"""Options of PyTorch's compiler: when a value that several expressions read is stored, and not computed anew in each.

A solver fills its matrices part by part. With the default options, C++ code of a game is nine times as long."""


@dataclass(frozen=True)
class Format:
    """A file format.

    Attributes:
        suffix: end of the file's name.
        games: whether programs that solve games can be written.
        write: writes a program and its description to a path.
        load: the program in a file.
        packages: what it needs besides PyTorch.
    """

    suffix: str
    games: bool
    write: Callable[[ExportedProgram, dict[str, Any], Path], object]
    load: Callable[[Path], Run]
    packages: tuple[str, ...] = ()


def _write_program(program: ExportedProgram, about: dict[str, Any], path: Path) -> None:
    torch.export.save(program, path, extra_files={"about.json": json.dumps(about)})


def _load_program(path: Path) -> Run:
    return torch.export.load(path).module()


def _write_package(program: ExportedProgram, about: dict[str, Any], path: Path) -> None:
    from torch._inductor import aoti_compile_and_package

    # C++ gives inputs by position: their names stand in a form that it can split.
    names = {kind: " ".join(about[kind]) for kind in ("inputs", "outputs")}
    options = {**COMPILER, "aot_inductor.metadata": {"about": json.dumps(about), **names}}
    aoti_compile_and_package(program, package_path=str(path), inductor_configs=options)


def _load_package(path: Path) -> Run:
    from torch._inductor import aoti_load_package

    return aoti_load_package(str(path))


def _write_onnx(program: ExportedProgram, about: dict[str, Any], path: Path) -> None:
    inputs, outputs = list(about["inputs"]), list(about["outputs"])
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(
        logging.ERROR
    )  # it misses torchvision, which nothing needs
    written = torch.onnx.export(program, input_names=inputs, output_names=outputs, dynamo=True, verbose=False)
    assert written is not None
    written.model.metadata_props["about"] = json.dumps(about)
    written.save(path)


def _load_onnx(path: Path) -> Run:
    import onnxruntime

    session = onnxruntime.InferenceSession(path)
    names = [output.name for output in session.get_outputs()]

    def run(tensors: Tensors) -> Tensors:
        found = session.run(names, {name: value.numpy() for name, value in tensors.items()})
        return {name: torch.from_numpy(value) for name, value in zip(names, found, strict=True)}

    return run


FORMATS = {
    "pt2": Format(".pt2", True, _write_program, _load_program),
    "aoti": Format(".pt2", True, _write_package, _load_package),
    "onnx": Format(".onnx", False, _write_onnx, _load_onnx, ("onnx", "onnxscript", "onnxruntime")),
}
"""``pt2``: operations that PyTorch runs one by one. ``aoti``: compiled for this machine's kind of processor, for C++.
``onnx``: operations of ONNX, which has none for a game's Cholesky factorisations."""
