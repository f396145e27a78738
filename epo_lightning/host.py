"""A test of whether the values of tensors may be looked at.

On a GPU, a look at a value makes the host wait for the device; while a program is exported (``torch.export``), there are no
values at all. Shortcuts and checks that depend on values are taken elsewhere only.
"""

from __future__ import annotations

import torch
from torch import Tensor


def readable(tensor: Tensor) -> bool:
    """Whether the tensor's values exist and can be looked at without waiting."""
    return tensor.device.type == "cpu" and not torch.compiler.is_exporting()
