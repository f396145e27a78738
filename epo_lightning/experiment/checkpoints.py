"""Checkpoints that are written completely or not at all.

Lightning writes a checkpoint to the system's temporary folder and then moves it. If that folder is on another file system,
the move is a copy, and a kill during the copy leaves a broken checkpoint, from which the run could not continue.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO

from epo_lightning.files import write_file


class WholeCheckpoints(TorchCheckpointIO):
    """Checkpoint writer that writes a temporary file in the same folder and renames it."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None) -> None:
        content = io.BytesIO()  # if torch wrote to the disk, a full disk would not be reported as an OSError
        torch.save(checkpoint, content)
        write_file(Path(path), content.getbuffer())
