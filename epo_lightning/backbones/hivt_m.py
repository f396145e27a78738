"""HiVT-M: transformer histories, attention to the map and then among agents (after Zhou et al. 2022)."""

from __future__ import annotations

from dataclasses import dataclass

from epo_lightning.backbones.vibes import VIBES
from epo_lightning.encoders.history import TransformerHistory
from epo_lightning.registry import register


@register("backbone", "hivt_m")
@dataclass(eq=False, repr=False)
class HiVTM(VIBES):
    """Hierarchical Vector Transformer, modified: VIBES with a transformer per agent in place of its LSTM.

    In HiVT itself the transformer already sees lanes and other agents; the paper moves both to the global graph (Appendix
    E.1, "Agent History Encoder").

    Attributes:
        history_heads: heads of the transformer's attention.
    """

    history_heads: int = 4

    def history_encoder(self) -> TransformerHistory:
        return TransformerHistory(self.history_width, self.history_depth, self.history_heads, self.scale)
