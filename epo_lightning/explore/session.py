"""Scenes and a trained forecaster, whose games are changed, solved and reported as plain values."""

from __future__ import annotations

import dataclasses
import time
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from epo_lightning.explore.edit import Edit
from epo_lightning.forecast import JointForecast
from epo_lightning.forecasters.epo import EPO
from epo_lightning.game.pairs import pairs
from epo_lightning.metrics.forecast import equilibrium_values
from epo_lightning.registry import ConfigError
from epo_lightning.scene import KINDS, Scene
from epo_lightning.solvers.base import TABLES

DISC = 0.5
"""Diameter [m] with which agents without a size are drawn: that of RPI's pedestrian."""


class Session:
    """Games that can be explored: those that a forecaster infers for given scenes.

    Args:
        forecaster: a trained forecaster of the family, whose solver computes strategies.
        scenes: the scenes.
        title: name of the row.
        subsets: names of the scenes' subsets.

    Raises:
        ConfigError: a forecaster without a game, or one whose solver chooses among candidate strategies.
    """

    def __init__(self, forecaster: Any, scenes: Scene, title: str = "", subsets: tuple[str, ...] = ()) -> None:
        if not isinstance(forecaster, EPO):
            raise ConfigError(
                f"{title or type(forecaster).__name__} infers no game, so nothing can be changed: choose a run with "
                "forecaster=epo"
            )
        if TABLES in forecaster.solver.provides:
            raise ConfigError(
                f"{title or 'this run'} chooses among fixed candidate strategies, so its solution does not follow small "
                "changes of a game: choose a run whose solver computes strategies, such as levenberg_marquardt"
            )
        self.forecaster, self.scenes, self.title, self.subsets = forecaster.eval(), scenes, title, subsets
        self._inferred = lru_cache(maxsize=64)(self._infer_index)

    def describe(self, index: int) -> dict[str, Any]:
        """The parts of a scene that no change of the game alters: agents, their past and future, lanes, names of features.

        Raises:
            ConfigError: no scene with this index.
        """
        scene = self._scene(index)
        present = scene.agent_mask[0].nonzero().flatten().tolist()
        size = scene.size[0].tolist() if scene.size is not None else [[DISC, DISC]] * scene.agent_mask.shape[1]
        kinds = None if scene.kind is None else scene.kind[0].tolist()
        first, second = (which.tolist() for which in pairs(scene.agent_mask.shape[1]))
        return {
            "index": index,
            "count": len(self.scenes.history),
            "title": self.title,
            "subset": self.subsets[int(scene.subset[0])] if scene.subset is not None and self.subsets else None,
            "dt": scene.dt,
            "agents": [
                {
                    "number": agent,
                    "kind": "agent" if kinds is None else KINDS[kinds[agent]],
                    "size": size[agent],
                    "disc": size[agent][0] == size[agent][1],
                    "history": _known(scene.history[0, agent, :, :2], scene.history_mask[0, agent]),
                    "state": _plain(scene.current[0, agent]),
                    "future": _future(scene, agent),
                }
                for agent in present
            ],
            "pairs": [[i, j] for i, j in zip(first, second, strict=True)],
            "lanes": _lanes(scene),
            "goals": self._inferred(index).parameters.goals is not None,
            "own": list(self.forecaster.energy.own),
            "pair": list(self.forecaster.energy.pair),
            "weighted": [list(names) for names in self.forecaster.energy.weighted],
        }

    @torch.no_grad()
    def solve(self, edit: Edit) -> dict[str, Any]:
        """The changed game's joint modes, and the energies, weights and Nash gap of one of them.

        Raises:
            ConfigError: the changes do not fit the scene or its game.
        """
        began = time.perf_counter()
        original = self._scene(edit.scene)
        edit.check(
            original, self.forecaster.modes, [name for names in self.forecaster.energy.weighted for name in names]
        )
        moved = edit.moved(original)
        inferred = self._infer(moved) if edit.states else self._inferred(edit.scene)
        scene = edit.without_absent(moved)
        decoded = time.perf_counter()
        assert inferred.parameters is not None
        parameters = edit.applied(inferred.parameters)
        solution = self.forecaster.solve(scene, parameters)
        solved = time.perf_counter()
        mode = int(inferred.probabilities[0].argmax()) if edit.mode is None else edit.mode
        # The equilibrium report is that of the most likely mode: let it be the chosen one.
        chosen = torch.zeros_like(inferred.probabilities).index_fill(1, torch.tensor([mode]), 1.0)
        forecast = dataclasses.replace(inferred, parameters=parameters, solution=solution, probabilities=chosen)
        forecast = self.forecaster.examine(scene, self.forecaster.explain(scene, forecast))
        gap = equilibrium_values(forecast).get("nash_gap_relative")
        ended = time.perf_counter()
        present = scene.agent_mask[0].nonzero().flatten().tolist()
        horizon, start = self.forecaster.task.horizon, inferred.initial_states
        return {
            "mode": mode,
            "present": present,
            "modes": [
                {
                    "probability": float(inferred.probabilities[0, m]),
                    "states": {agent: _plain(solution.states[0, m, agent, :horizon]) for agent in present},
                    "start": {} if start is None else {a: _plain(start[0, m, a, :, :2]) for a in present},
                    "goals": {}
                    if parameters.goals is None
                    else {a: _plain(parameters.goals[0, m, a]) for a in present},
                }
                for m in range(solution.states.shape[1])
            ],
            "states": {agent: _plain(scene.current[0, agent]) for agent in present},
            "energy": float(solution.energy[0, mode]),
            "own_energy": {name: _plain(value[0, mode]) for name, value in (forecast.own_energy or {}).items()},
            "pair_energy": {name: _plain(value[0, mode]) for name, value in (forecast.pair_energy or {}).items()},
            "own_weights": {name: _plain(value[0, mode]) for name, value in parameters.own_weights.items()},
            "pair_weights": {name: _plain(value[0, mode]) for name, value in parameters.pair_weights.items()},
            "nash_gap": None if gap is None else _number(gap),
            "milliseconds": {
                "network": 1000 * (decoded - began),
                "solver": 1000 * (solved - decoded),
                "all": 1000 * (ended - began),
            },
        }

    def _scene(self, index: int) -> Scene:
        count = len(self.scenes.history)
        if not 0 <= index < count:
            raise ConfigError(f"scene must be a number from 0 to {count - 1}, not {index}")
        return self.scenes[index]

    def _infer_index(self, index: int) -> Any:
        return self._infer(self._scene(index))

    @torch.no_grad()
    def _infer(self, scene: Scene) -> JointForecast:
        """The forecast of the unchanged game."""
        forecast: JointForecast = self.forecaster.predict(scene)
        return forecast


def _plain(values: Tensor) -> Any:
    """Numbers rounded to a tenth of a millimetre, as nested lists."""
    return (values.double() * 1e4).round().div(1e4).tolist()


def _number(value: Tensor) -> float | None:
    """The value of a single scene; None where it is not known."""
    return float(value[0]) if bool(value.isfinite().all()) else None


def _known(values: Tensor, mask: Tensor) -> Any:
    return _plain(values[mask])


def _future(scene: Scene, agent: int) -> Any:
    """The observed positions of an agent's future; None if there is no future."""
    if scene.future is None or scene.future_mask is None:
        return None
    return _known(scene.future[0, agent, :, :2], scene.future_mask[0, agent])


def _lanes(scene: Scene) -> Any:
    """All lane vectors [x, y, x, y] in m."""
    if scene.lanes is None or scene.lane_mask is None:
        return []
    return _plain(scene.lanes[0][scene.lane_mask[0]])
