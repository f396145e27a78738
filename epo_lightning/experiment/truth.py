"""The truth test: how far inferred weights are from those of the games that made the data.

Only ratios of weights mean something, because scaling all weights of a game by one factor changes no minimum. The unit of
all costs is therefore the effort, the cost of squared controls, whose true weight is 10: the inferred cost of a term is

    10 W^2 / (W_acc W_turnr),   and half of that for the pair term,

averaged over both agents (geometrically), with the decoded weights W of the most likely mode. In these units the truth is
w for the pair term, 300 for the goal and 30 for the speed (:class:`~epo_lightning.data.rpi.game.GameConstants`).
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Int
from lightning import LightningModule
from lightning.pytorch import Callback, Trainer
from scipy import stats
from torch import Tensor

from epo_lightning.data.rpi.game import GameConstants
from epo_lightning.forecast import GameParameters, JointForecast
from epo_lightning.scene import Scene

OWN = {"goal": "terminal", "vel": "slowness"}
"""Own terms that are compared, with their true weight in :class:`GameConstants`."""
NEEDED = frozenset({"acc", "turnr"})


def inferred_costs(parameters: GameParameters, mode: Int[Tensor, " B"]) -> dict[str, Tensor]:
    """Inferred costs [B] by term, in units of the true effort: ``pair``, and the terms of :data:`OWN` that the game has.

    Args:
        parameters: the inferred games.
        mode: index of a mode for every scene.
    """
    rows = torch.arange(len(mode))
    own = {name: weight.abs()[rows, mode].double() for name, weight in parameters.own_weights.items()}
    pair = {name: weight.abs()[rows, mode].double() for name, weight in parameters.pair_weights.items()}
    effort = (own["acc"] * own["turnr"]).log().mean(-1).exp() / GameConstants().effort
    found = {name: own[name].square().log().mean(-1).exp() / effort for name in OWN if name in own}
    if pair:
        found["pair"] = 0.5 * torch.stack(list(pair.values())).square().sum(0)[:, 0] / effort
    return found


class TruthTest(Callback):
    """Collector of true and inferred costs during a test. Every record counts once, with its executed future.

    Args:
        weights: w of every record of the split; ``Scene.id`` holds indices of records.
    """

    def __init__(self, weights: Tensor) -> None:
        self._weights = weights.double()
        self._batches: list[dict[str, Tensor]] = []

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Scene, batch_idx: int, *_: Any
    ) -> None:
        assert batch.subset is not None
        assert batch.id is not None
        executed = (batch.subset == 0).nonzero().flatten()
        forecast: JointForecast = outputs["forecast"][executed].map(Tensor.cpu)
        if forecast.parameters is not None and forecast.parameters.own_weights.keys() >= NEEDED:
            costs = inferred_costs(forecast.parameters, forecast.probabilities.argmax(1))
            self._batches.append({"true": self._weights[batch.id[executed].cpu()], **costs})

    def scores(self) -> dict[str, float]:
        """Scores of all collected costs (:func:`compare`); empty for forecasts without the terms to compare."""
        if not self._batches:
            return {}
        return compare({name: torch.cat([batch[name] for batch in self._batches]) for name in self._batches[0]})


def compare(costs: dict[str, Tensor]) -> dict[str, float]:
    """Scores of inferred costs.

    Returns:
        ``pair_rank``, the rank correlation of inferred and true w (Spearman's), unless one is constant; ``pair_error``,
        ``goal_error`` and ``vel_error``, medians of the relative error |inferred / true - 1|.
    """
    constants = GameConstants()
    truths = {"pair": costs["true"], **{name: getattr(constants, key) for name, key in OWN.items()}}
    scores = {
        f"{name}_error": float((costs[name] / truth - 1.0).abs().median())
        for name, truth in truths.items()
        if name in costs
    }
    if "pair" in costs:
        inferred, true = costs["pair"].numpy(), costs["true"].numpy()
        if len({*inferred}) > 1 and len({*true}) > 1:  # constants have no rank correlation
            scores["pair_rank"] = float(stats.spearmanr(inferred, true).statistic)
    return scores
