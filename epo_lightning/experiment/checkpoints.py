"""Checkpoints that are whole or not there.

Lightning writes a checkpoint to the system's folder of temporary files and moves it; where that lies on another file system
the move is a copy, and a kill in the middle of it leaves a run that cannot go on.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO

from epo_lightning.run_folder import write_bytes


class WholeCheckpoints(TorchCheckpointIO):
    """Writes beside the file that is to be, and renames."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None) -> None:
        content = io.BytesIO()  # torch hides a full disk behind a complaint of its own
        torch.save(checkpoint, content)
        write_bytes(Path(path), content.getbuffer())
