"""Training of RPI rows whose network is told the weight w of the game: how much of their errors is due to not knowing it?

w says how much both agents avoid each other. It differs between games, and a history shows little of it. The arguments are
those of ``epo train``, for an experiment of RPI with V-LSTM and without calibration, which reads speeds::

    python -m benchmarks.hidden_weight experiment=rpi/v_lstm_sc_relaxed data=rpi budget=reduced score=test

Training has as many values of w as main games, 16 of them by default, so a network may use w less well than it could. Its
initial weights differ from those of the row that is not told w, also for the same seed. The runs have the data set
``rpi_told`` and the backbone ``v_lstm_told``, which only this program knows.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn

from epo_lightning import cli
from epo_lightning.backbones.v_lstm import VLSTM
from epo_lightning.data import cache
from epo_lightning.data.rpi.game import GameConstants
from epo_lightning.data.rpi.scenes import RPIData, RPIDataset
from epo_lightning.experiment.config.compose import compose
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import SPEED, Scene

TOLD = "rpi_told"
NAMES = (f"data.name={TOLD}", "backbone.name=v_lstm_told")
"""The settings that replace data set and backbone of an experiment by those that are told w."""


@register("data", TOLD)
class ToldRPIData(RPIData):
    """RPI with w, scaled to -1 to 1, in the place of both agents' oldest observed speeds.

    No backbone of the package reads speeds, and the games begin with the newest state, so nothing else changes.

    Raises:
        ConfigError: ``games_share`` is not 1, which the lookup of w does not support.
    """

    @property
    def digest(self) -> str:
        """Hash of the data set, which differs from that of RPI without w."""
        return cache.digest({"told": super().digest})[:16]

    def open(self, split: str) -> RPIDataset:
        """The scenes of a split, which are all of its games."""
        if self.games_share != 1:
            raise ConfigError(
                f"data.games_share is {self.games_share}, and w can be told for all games only: leave it out"
            )
        scenes, constants = super().open(split), GameConstants()
        middle = (constants.weight_max + constants.weight_min) / 2
        told = (self.records(split)["weight"].float() - middle) / (constants.weight_max - middle)
        scenes.history = scenes.history.clone()
        scenes.history[:, :, 0, SPEED] = told[:, None]
        return scenes


@register("backbone", "v_lstm_told")
class ToldVLSTM(VLSTM):
    """V-LSTM with w as another input, added to the features of each agent's history."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.weight_to_graph = nn.Linear(1, self.width)

    def agent_features(self, scene: Scene) -> Float[Tensor, "B N {self.width}"]:
        """Features of each agent's history and of w."""
        return super().agent_features(scene) + self.weight_to_graph(scene.history[:, :, 0, SPEED, None])


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    words = list(sys.argv[1:] if given is None else given)
    try:
        config = compose("train", words)
    except ConfigError as error:
        raise SystemExit(f"hidden_weight: {error}") from None
    if (
        config["data"]["name"] != "rpi"
        or config["backbone"]["name"] != "v_lstm"
        or config["forecaster"].get("calibration")
    ):
        raise SystemExit(
            "hidden_weight: w can be told to rows of RPI with backbone=v_lstm and without calibration, such as "
            "experiment=rpi/v_lstm_sc_relaxed and experiment=rpi/v_lstm_epo_relaxed"
        )
    cli.main(["train", *words, *NAMES])


if __name__ == "__main__":
    main()
