"""A frozen forecaster with a game on top of it, of which only the shared weights are trained."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import nn

from epo_lightning.checks import check_number
from epo_lightning.decoders.weights import SharedWeights
from epo_lightning.forecast import JointForecast
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.forecasters.combination import Combination
from epo_lightning.forecasters.epo_settings import check_start
from epo_lightning.forecasters.game_forecaster import GameForecaster
from epo_lightning.game.energy import Energy
from epo_lightning.objectives.base import Objective
from epo_lightning.optimizers import Adam
from epo_lightning.refinement.game import NOISE, check_energy, refined
from epo_lightning.registry import ConfigError, nearest, register
from epo_lightning.scene import Scene
from epo_lightning.solvers.backward import Backward
from epo_lightning.solvers.base import Minimiser
from epo_lightning.task import Task


@register("forecaster", "refined")
class Refined(GameForecaster):
    """Forecaster that refines the joint modes of a trained one (:mod:`epo_lightning.refinement`).

    The trained forecaster stays as it is. One weight per feature, shared by all agents, pairs, modes and scenes, and the
    inverse temperature of the probabilities are learned. A checkpoint holds the trained forecaster as well, so that it can
    be used without the run that is refined.

    Args:
        given: the trained forecaster, which :func:`~epo_lightning.forecasters.build_forecaster` loads from ``frozen``.
        energy: an energy whose inputs a refinement has; its margins are fixed.
        solver: the minimiser of the energy.
        backward: the derivative of the solution.
        objective: the training objective.
        frozen: run folder, checkpoint, or name of a shipped forecaster: what is refined.
        own_start: own weights before training: one number, or numbers by feature name (1 for names that are missing).
        pair_start: the same for pair weights.
        inverse_temperature: beta before training.
        noise: standard deviation [m] of given positions around a smooth motion, which tracking removes.

    Raises:
        ConfigError: parts that do not work together, or a forecaster of another task.
    """

    def __init__(
        self,
        task: Task,
        optimizer: Adam,
        given: Forecaster,
        energy: Energy,
        solver: Minimiser,
        backward: Backward,
        objective: Objective,
        frozen: str | None = None,
        own_start: float | Mapping[str, float] = 1.0,
        pair_start: float | Mapping[str, float] = 3.0,
        inverse_temperature: float = 0.03,
        noise: float = NOISE,
    ) -> None:
        Combination.of(energy=energy, solver=solver, backward=backward, objective=objective).check()
        check_energy(energy, solver)
        if energy.decoded_margins:
            raise ConfigError(
                f"a refinement decodes no margins: fix those of {', '.join(energy.decoded_margins)} in metres, such as "
                f"energy.margins={{{energy.decoded_margins[0]}: 0.5}}"
            )
        _check_task(given, task)
        check_number("forecaster.inverse_temperature", inverse_temperature)
        check_number("forecaster.noise", noise, zero=True)
        super().__init__(task, optimizer)
        self.given = given.eval().requires_grad_(False)
        self.reads_history, self.reads_goal_headings = given.reads_history, given.reads_goal_headings
        self.longest_game = given.longest_game
        self.energy, self.solver, self.objective, self.noise = energy, solver, objective, noise
        self.differentiable_solve = backward
        own, pair = energy.weighted
        _check_pair_start(pair_start, pair)
        self.own_weights = SharedWeights(1, own, check_start(own_start, own, energy.own))
        self.pair_weights = SharedWeights(1, pair, pair_start)
        self.log_inverse_temperature = nn.Parameter(torch.tensor(math.log(inverse_temperature)))

    def train(self, mode: bool = True) -> Refined:
        """Training mode for the refinement; the given forecaster stays in evaluation mode."""
        super().train(mode)
        self.given.eval()
        return self

    def forward(self, scene: Scene) -> JointForecast:
        with torch.no_grad():
            given = self.given(scene)
        batch, agents = scene.agent_mask.shape
        own, pair = (
            self.own_weights.of_rows(batch, agents),
            self.pair_weights.of_rows(batch, agents * (agents - 1) // 2),
        )
        return refined(
            given.states,
            given.log_probabilities,
            scene,
            self.energy,
            {**own, **pair},
            {},
            self.log_inverse_temperature.exp(),
            self.noise,
            self.minimiser,
            self.differentiable_solve,
        )

    def game_scene(self, scene: Scene) -> Scene:
        """The scene as the solver sees it: without ``game_steps``, because all games end with the forecast."""
        return dataclasses.replace(scene, game_steps=None)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """The configuration, with that of the given forecaster, whose weights are among the saved ones."""
        checkpoint["configuration"] = {**self.configuration, "given": self.given.configuration}


def _check_pair_start(start: float | Mapping[str, float], features: Sequence[str]) -> None:
    """Refuse pair weights of features that the energy does not have, and weights that are not positive.

    Raises:
        ConfigError: the message names the feature.
    """
    for name, value in (start if isinstance(start, Mapping) else dict.fromkeys(features, start)).items():
        if name not in features:
            raise ConfigError(f"unknown feature forecaster.pair_start.{name}: {nearest(name, features)}")
        check_number(f"forecaster.pair_start.{name}", value)


def _check_task(given: Forecaster, task: Task) -> None:
    """Refuse to refine a forecaster of scenes with other sizes or units.

    Raises:
        ConfigError: the message names what differs.
    """
    names, known = ["horizon", "dt", "candidates", "map", "scale"], given.task
    if given.reads_history and None not in (known.history, task.history):
        names.append("history")
    differing = [name for name in names if getattr(known, name) != getattr(task, name)]
    if differing:
        shown = ", ".join(
            f"{name} is {getattr(known, name)} there and {getattr(task, name)} here" for name in differing
        )
        raise ConfigError(
            f"forecaster.frozen was trained for scenes of another kind: {shown}; choose the data it knows"
        )
