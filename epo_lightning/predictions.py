"""Files of predictions: the futures that any model forecast, and as much of their scenes as a refinement takes.

A file is a compressed NumPy archive (``.npz``) with these arrays; B scenes, M joint modes, N agents, K future and H history
steps:

==================  =====================  ==========================================================================
``states``          [B, M, N, K, 2 or 4]   futures: x, y [m], and perhaps heading [rad], speed [m/s]; step 1 is dt after t0
``probabilities``   [B, M]                 probabilities of the joint modes
``history``         [B, N, H, 4]           x, y, heading, speed up to t0, the last step; H = 1 is enough
``dt``              one number             length of a step [s]
``agent_mask``      [B, N], optional       agents that exist
``history_mask``    [B, N, H], optional    steps that were observed
``size``            [B, N, 2], optional    length and width [m]; energies with bodies need it
``kind``            [B, N], optional       index into :data:`~epo_lightning.scene.KINDS`
``id``              [B], optional          number of each scene
==================  =====================  ==========================================================================

The folder that ``epo predict`` writes has the same tensors and can be read as well.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from epo_lightning.files import write_file
from epo_lightning.refinement.given import check_forecast
from epo_lightning.registry import ConfigError, nearest
from epo_lightning.scene import Scene

REQUIRED = ("states", "probabilities", "history", "dt")
OPTIONAL = ("agent_mask", "history_mask", "size", "kind", "id")
FORECASTS = "forecasts.safetensors"
"""Name of the file of tensors that ``epo predict`` writes."""
INDEX = "index.json"
"""Name of the file beside it, which says what the tensors are."""
_DAMAGED = (OSError, ValueError, EOFError, AttributeError, TypeError, NotImplementedError, RuntimeError)
"""Errors of NumPy and zipfile for damaged archives, beside those of their own."""


class Predictions(NamedTuple):
    """Forecasts and their scenes: the first three arguments of :func:`~epo_lightning.refinement.refine`."""

    states: Tensor
    probabilities: Tensor
    scene: Scene


def write_predictions(path: str | Path, states: Tensor, probabilities: Tensor, scene: Scene) -> Path:
    """Write futures, probabilities and scenes to an ``.npz`` file, completely or not at all.

    Raises:
        ConfigError: the name does not end with ``.npz``, or the file exists: nothing is overwritten.
        TypeError, ValueError: as :func:`~epo_lightning.refinement.refine` refuses futures and probabilities.
    """
    path = Path(path).expanduser()
    if path.suffix != ".npz":
        raise ConfigError(f"files of predictions are NumPy archives: call {path} {path.stem}.npz")
    if path.exists():
        raise ConfigError(f"{path} exists: nothing is overwritten; choose another name")
    check_forecast(states, probabilities, scene)
    arrays: dict[str, Any] = {"states": states, "probabilities": probabilities, "dt": np.float64(scene.dt)}
    arrays |= {name: value for name in ("history", *OPTIONAL) if (value := getattr(scene, name)) is not None}
    content = io.BytesIO()
    plain: Any = {name: _array(a) if isinstance(a, Tensor) else a for name, a in arrays.items()}
    np.savez_compressed(content, **plain)
    write_file(path, content.getbuffer())
    return path


def read_predictions(path: str | Path) -> Predictions:
    """Read a file of predictions, or the folder that ``epo predict`` wrote. No code in a file is executed.

    Floating-point numbers become float32, unless the futures are in float64.

    Raises:
        ConfigError: the file is missing, damaged or of another kind, an array is missing, unknown or has another type or
            shape, futures that are not finite, or probabilities that do not sum to one; the message names file and array.
    """
    path = Path(path).expanduser()
    arrays = _folder(path) if path.is_dir() else _archive(path)
    for name in REQUIRED:
        if name not in arrays:
            raise ConfigError(f"{path} lacks the array {name!r}; it has {', '.join(sorted(arrays)) or 'none'}")
    try:
        dt = np.asarray(arrays["dt"])
        if dt.size != 1 or dt.dtype.kind not in "fiu":
            raise ValueError(f"dt has shape {list(dt.shape)} and type {dt.dtype}; it is one number of seconds")
        names = [name for name in (*REQUIRED, *OPTIONAL) if name in arrays and name != "dt"]
        tensors = {name: _tensor(name, arrays[name]) for name in names}
        number = torch.float64 if tensors["states"].dtype == torch.float64 else torch.float32
        tensors = {name: t.to(number) if t.is_floating_point() else t for name, t in tensors.items()}
        scene = Scene(
            dt=float(dt.item()), **{name: t for name, t in tensors.items() if name not in ("states", "probabilities")}
        )
        check_forecast(tensors["states"], tensors["probabilities"], scene)
        scene.validate_values()
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{path}: {error}") from error
    return Predictions(tensors["states"], tensors["probabilities"], scene)


def _array(tensor: Tensor) -> np.ndarray:
    """A tensor as an array; NumPy has no bfloat16, whose numbers are also of float32."""
    tensor = tensor.detach().cpu()
    return (tensor.float() if tensor.dtype == torch.bfloat16 else tensor).numpy()


def _tensor(name: str, array: Any) -> Tensor:
    """An array as a tensor, in the byte order of this machine; whole numbers have 64 bits, and masks of 0 and 1 are boolean.

    Raises:
        TypeError: no array of numbers; the message names it.
    """
    array = np.asarray(array)
    if array.dtype.kind in "iu":
        is_mask = name.endswith("_mask") and np.isin(array, (0, 1)).all()
        array = array.astype(bool if is_mask else np.int64)
    try:
        return torch.from_numpy(array.astype(array.dtype.newbyteorder("="), copy=False))
    except TypeError:
        raise TypeError(
            f"{name} is of type {array.dtype}, expected numbers that PyTorch has, such as float32"
        ) from None


def _archive(path: Path) -> dict[str, Any]:
    """The arrays of a NumPy archive.

    Raises:
        ConfigError: the file is missing or no such archive, or has an array that files of predictions do not have.
    """
    if not path.is_file():
        raise ConfigError(f"no predictions at {path}: give an .npz file, or the folder that `epo predict` wrote")
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = dict(archive)
    except (*_DAMAGED, zipfile.BadZipFile, zlib.error) as error:
        raise ConfigError(f"{path} is not a NumPy archive of plain arrays, or is damaged ({error})") from error
    known = (*REQUIRED, *OPTIONAL)
    for name in arrays:
        if name not in known:
            raise ConfigError(f"{path} has an unknown array {name!r}: {nearest(name, known)}")
    return arrays


def _folder(path: Path) -> dict[str, Any]:
    """The tensors that ``epo predict`` wrote, as far as files of predictions have them.

    Raises:
        ConfigError: the folder lacks one of the two files, or one is damaged.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    tensors, index = path / FORECASTS, path / INDEX
    for file in (tensors, index):
        if not file.is_file():
            raise ConfigError(f"{path} lacks {file.name}: give an .npz file, or the folder that `epo predict` wrote")
    try:
        found, about = load_file(tensors), json.loads(index.read_text(encoding="utf-8"))
        if not isinstance(about, dict) or "dt" not in about:
            raise ValueError(f"{index.name} has no entry dt")
        return {**{name: found[name] for name in (*REQUIRED, *OPTIONAL) if name in found}, "dt": about["dt"]}
    except (OSError, ValueError, KeyError, SafetensorError) as error:
        raise ConfigError(f"{path} was not written by `epo predict`, or is damaged ({error})") from error
