"""What a backbone is: a module from scenes to agent features."""

from __future__ import annotations

from torch import nn


class Backbone(nn.Module):
    """Observation encoder phi_glob: ``forward(scene)`` returns features z [B, N, width] of all agents (Section 4.1)."""

    width: int
