"""Base class of the forecasters whose joint modes are solutions of games."""

from __future__ import annotations

import dataclasses

from epo_lightning.forecast import JointForecast
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.game.energy import Energy
from epo_lightning.objectives.base import Objective, Terms
from epo_lightning.scene import Scene
from epo_lightning.schedules import Schedule, schedules_in
from epo_lightning.solvers.backward import Backward
from epo_lightning.solvers.base import Minimiser


class GameForecaster(Forecaster):
    """Forecaster whose joint modes minimise an energy, by which its forecasts are explained and its losses computed.

    A subclass sets the four parts, and defines ``forward(scene)`` and :meth:`game_scene`.
    """

    energy: Energy
    """The energy of the games."""
    solver: Minimiser
    """The minimiser of the energy in training."""
    differentiable_solve: Backward
    """The part ``backward``, which runs the minimiser and defines the derivative of its solution. (A LightningModule has a
    method of that name.)"""
    objective: Objective
    """The training objective."""

    def game_scene(self, scene: Scene) -> Scene:
        """The scene as the solver sees it, with the ends of the games."""
        raise NotImplementedError

    @property
    def minimiser(self) -> Minimiser:
        """The minimiser of the current mode, training or evaluation."""
        return self.solver if self.training else self.solver.for_test()

    def explain(self, scene: Scene, forecast: JointForecast) -> JointForecast:
        assert forecast.parameters is not None
        assert forecast.solution is not None
        terms = self.energy.terms(self.game_scene(scene), forecast.parameters, forecast.solution.controls)
        return dataclasses.replace(
            forecast,
            own_energy={name: terms[name] for name in self.energy.own},
            pair_energy={name: terms[name] for name in self.energy.pair},
        )

    def losses(self, scene: Scene, forecast: JointForecast) -> Terms:
        return self.objective(self.game_scene(scene), forecast, self.energy, self.global_step)

    @property
    def schedules(self) -> list[Schedule]:
        return [*super().schedules, *schedules_in(self.objective)]
