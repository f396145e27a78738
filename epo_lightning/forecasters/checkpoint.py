"""Reading of checkpoint files, without executing code from them and with a check for damage."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import torch

from epo_lightning.pretrained import names
from epo_lightning.registry import ConfigError, nearest


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """The contents of a checkpoint: tensors and plain values.

    A checkpoint is a zip archive, in which PyTorch writes a CRC-32 beside every entry; PyTorch itself does not compare them
    when it reads.

    Raises:
        ConfigError: the file is missing, is not a checkpoint of this project, differs from what was written, or holds
            weights that are not finite.
    """
    path = Path(path)
    if not path.is_file():
        others = sorted(file.name for file in path.parent.glob("*.ckpt"))
        if others and path.suffix == ".ckpt":  # not the name of a forecaster
            raise ConfigError(f"no checkpoint at {path}; the folder has {', '.join(others)}")
        raise ConfigError(
            f"no checkpoint at {path}: give the path of a .ckpt file, such as RUN/checkpoints/best.ckpt, or the name of a "
            f"forecaster that ships with the package ({nearest(str(path), names())})"
        )
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
        if damaged is not None:
            raise zipfile.BadZipFile(f"{damaged} differs from its checksum")
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # for damaged files, zipfile, zlib, pickle and torch raise many types of exceptions
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigError(f"{path} is not a checkpoint that epo_lightning wrote, or is damaged ({reason})") from error
    parts = [content.get(key) for key in ("state_dict", "configuration")] if isinstance(content, dict) else [None]
    if not all(isinstance(part, dict) for part in parts):
        raise ConfigError(f"{path} is not a checkpoint that epo_lightning wrote: it lacks state_dict or configuration")
    for name, value in content["state_dict"].items():
        if value.is_floating_point() and not value.isfinite().all():
            raise ConfigError(
                f"{path} holds weights that are not finite ({name}): its training diverged; use checkpoint=best, or train "
                "again with a smaller optimizer.lr or with optimizer.clip=1"
            )
    return content
