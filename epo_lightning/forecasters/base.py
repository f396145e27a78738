"""Base class of all forecasters: training, metrics, checkpoints and prediction."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
from lightning import LightningModule
from torch import Tensor, nn

from epo_lightning import doubts
from epo_lightning.decoders.weights import SharedWeights
from epo_lightning.forecast import JointForecast
from epo_lightning.forecasters.step_means import StepMeans
from epo_lightning.metrics import ForecastMetrics
from epo_lightning.metrics.forecast import COLUMNS, STOPPED, stopped
from epo_lightning.objectives.base import Terms
from epo_lightning.optimizers import Adam
from epo_lightning.scene import Scene
from epo_lightning.schedules import Schedule, schedules_in
from epo_lightning.solvers.base import Minimiser
from epo_lightning.task import Task

PLAUSIBLE = 20
"""Number of plausible batches with moving agents after which :meth:`Forecaster.predict` does not look at motions again."""


class Forecaster(LightningModule):
    """A model from a :class:`Scene` to a :class:`JointForecast`, as a LightningModule.

    A subclass defines ``forward(scene)`` and ``losses(scene, forecast)``. The weighted sum of the losses is minimised, and
    each of them is logged. Validation and test metrics are those of :class:`~epo_lightning.metrics.ForecastMetrics`.

    Args:
        task: sizes and units of the data's scenes.
        optimizer: the optimiser and its learning-rate schedule.
    """

    reads_goal_headings: bool = False
    """Whether forecasts depend on the headings that are wanted at goals."""
    reads_history: bool = True
    """Whether forecasts depend on states before the present one."""
    solver: Minimiser | None
    """The minimiser of its games; None for forecasters without games."""
    longest_game: int | None = None
    """Steps from t0 to the end of the longest game, if games go on after the forecast."""
    configuration: dict[str, Any]
    """The model's configuration, from which this forecaster was built; stored in every checkpoint."""
    step_graph: Callable[[Scene], tuple[Tensor, dict[str, Tensor]]] | None = None
    """A function that takes the place of :meth:`weighted_losses` and of the backward pass: it leaves the gradients of its
    losses with the parameters. None for Lightning's usual steps."""

    def __init__(self, task: Task, optimizer: Adam) -> None:
        super().__init__()
        self.solver = None
        self._plausible = 0  # number of batches whose motions `predict` has found plausible
        self.task = task
        self.optimizer = optimizer
        self.step_means = StepMeans()
        self.scored: frozenset[str] = frozenset()
        """Names of the scores of the last validation or test; a registered metric may have no value in any scene."""
        self.val_metrics = ForecastMetrics(task.subsets, task.shape)
        self.test_metrics = ForecastMetrics(task.subsets, task.shape)

    def losses(self, scene: Scene, forecast: JointForecast) -> Terms:
        """Weight and value of every term of the training objective (Eq. 12), by name."""
        raise NotImplementedError

    @torch.no_grad()
    def predict(self, scene: Scene) -> JointForecast:
        """The forecast in evaluation mode, with the energy of every feature (:meth:`explain`).

        The forecast of a scene with non-finite numbers is NaN, with a warning that names the scene; the forecasts of the
        other scenes of the batch are the same as without it. Warnings say how many joint modes violate hard constraints, and
        which scenes are probably wrong (:mod:`epo_lightning.doubts`). Motions and coordinates are looked at until
        :data:`PLAUSIBLE` batches with moving agents had no doubt: this takes a sixth of a single scene's forecast.

        Several threads may predict at once with a forecaster in evaluation mode, as ``epo_lightning.load`` returns it.

        Raises:
            TypeError: the argument is not a :class:`Scene`.
            ValueError: the scene's time step is not the forecaster's, or its sizes or line indices cannot be used.
        """
        if not isinstance(scene, Scene):
            raise TypeError(f"predict takes an epo_lightning.scene.Scene, not a {type(scene).__name__}")
        self._check_dt(scene)
        scene.validate_values()
        looks = self._plausible < PLAUSIBLE
        motions = (doubts.of_motion(scene), doubts.of_coordinates(scene)) if looks else ()
        self._plausible += looks and not any(motions) and doubts.shows_motion(scene)
        length = doubts.of_history(scene, self.task.history) if self.reads_history else None
        headings = doubts.of_goal_headings(scene) if self.reads_goal_headings else None
        end = doubts.of_game_end(scene, self.longest_game)
        for doubt in filter(None, (length, *motions, headings, end)):
            warnings.warn(doubt, stacklevel=3)
        broken = (~scene.finite).nonzero().flatten().tolist()
        if broken:
            warnings.warn(
                f"non-finite numbers in scene(s) {broken} of the batch: their forecasts are NaN", stacklevel=3
            )
        # Switching hundreds of modules that are in evaluation mode already would take a tenth of a single scene's forecast.
        training = [module for module in self.modules() if module.training]
        for module in training:
            module.training = False
        try:
            scene = self.as_input(scene)
            forecast = self.explain(scene, self(scene))
        finally:
            for module in training:
                module.training = True
        lost = stopped(forecast)
        if lost is not None:
            _warn_of_stopped(float(lost.double().mean()) if lost.numel() else 0.0, len(lost))
        return forecast.map(lambda tensor: _blank(tensor, broken)) if broken else forecast

    def _check_dt(self, scene: Scene) -> None:
        if abs(scene.dt - self.task.dt) > 1e-6:
            raise ValueError(f"the scene has dt = {scene.dt} s, but this forecaster was built for {self.task.dt} s")

    def as_input(self, scene: Scene) -> Scene:
        """The scene on the device and in the precision of the parameters; in float32 on the CPU if there are none."""
        reference = next(self.parameters(), torch.zeros(0))
        return scene.to(reference.device).to(reference.dtype)

    def explain(self, scene: Scene, forecast: JointForecast) -> JointForecast:
        """The forecast with the energy of every feature added; computed for predictions, not in training."""
        return forecast

    def examine(self, scene: Scene, forecast: JointForecast) -> JointForecast:
        """The forecast with further measurements, which are too slow for every validation and are made in tests only."""
        return forecast

    def weighted_losses(self, scene: Scene) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted sum of the losses, which is minimised, and the value of every term."""
        terms = self.losses(scene, self(scene))
        total = torch.stack([weight * value for weight, value in terms.values()]).sum()
        return total, {name: value.detach() for name, (_, value) in terms.items()}

    def training_step(self, scene: Scene, _: int) -> Tensor:
        self._check_dt(scene)
        total, terms = (self.step_graph or self.weighted_losses)(scene)
        values = {"train/loss": total, **{f"train/{name}": value for name, value in terms.items()}}
        self.step_means.add(values, len(scene.history))
        return total

    def on_train_epoch_start(self) -> None:
        self.step_means.reset()

    def on_train_epoch_end(self) -> None:
        for name, (total, scenes) in self.step_means.totals().items():
            self.log(name, total / scenes, batch_size=scenes, sync_dist=True)

    def backward(self, loss: Tensor, *args: Any, **kwargs: Any) -> None:
        """Backward pass; nothing is left to do if the gradients have come with the loss (``step_graph``)."""
        if self.step_graph is None:
            super().backward(loss, *args, **kwargs)

    def optimizer_zero_grad(self, *args: Any) -> None:
        """Drop the gradients of the step before; those of ``step_graph`` are of this step already."""
        if self.step_graph is None:
            super().optimizer_zero_grad(*args)

    def validation_step(self, scene: Scene, _: int) -> None:
        self._check_dt(scene)
        self.val_metrics.update(self(scene), scene)

    def on_validation_epoch_end(self) -> None:
        self._log_metrics("val", self.val_metrics)

    def test_step(self, scene: Scene, _: int) -> dict[str, JointForecast]:
        self._check_dt(scene)
        forecast = self.examine(scene, self(scene))
        self.test_metrics.update(forecast, scene)
        return {"forecast": forecast}

    def on_test_epoch_end(self) -> None:
        self._log_metrics("test", self.test_metrics)

    def _log_metrics(self, split: str, metrics: ForecastMetrics) -> None:
        scores = metrics.compute()
        named = {f"{split}/{name}": value for name, value in scores.items()}
        self.scored = frozenset(named)
        self.log_dict(named)
        if split == "test" and STOPPED in scores:
            _warn_of_stopped(float(scores[STOPPED]), int(metrics.count[0, COLUMNS.index(STOPPED)]))
        metrics.reset()

    def configure_optimizers(self) -> Any:
        parameters = [parameter for parameter in self.parameters() if parameter.requires_grad]
        if not parameters:
            return None
        return self.optimizer.configure(parameters, self.trainer.estimated_stepping_batches, self.shared_weights)

    @property
    def schedules(self) -> list[Schedule]:
        """The numbers of the loss that change during training."""
        return schedules_in(self)

    @property
    def shared_weights(self) -> list[nn.Parameter]:
        """Cost weights that all scenes share; the optimizer may give them another learning rate than the network."""
        return [
            parameter
            for module in self.modules()
            if isinstance(module, SharedWeights)
            for parameter in module.parameters()
            if parameter.requires_grad
        ]

    def configure_gradient_clipping(self, *_: Any, **__: Any) -> None:
        """Clip by the limit of the optimizer's configuration instead of the Trainer's."""
        if self.optimizer.clip is not None:
            torch.nn.utils.clip_grad_norm_(self.parameters(), self.optimizer.clip)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["configuration"] = self.configuration


def _warn_of_stopped(share: float, scenes: int) -> None:
    """Warn if a share of the joint modes of some scenes is above zero: their solver stopped."""
    if share:
        warnings.warn(
            f"in {share:.2%} of the joint modes of {scenes} scene(s) the solver stopped before hard constraints were met. "
            "Their strategies have no meaning, but are scored like all others (forecast.solution.status names them). Use a "
            "smaller clearance, or more solver.rounds",
            stacklevel=3,
        )


def _blank(tensor: Tensor, scenes: list[int]) -> Tensor:
    if not tensor.is_floating_point():
        return tensor
    tensor = tensor.clone()
    tensor[scenes] = torch.nan
    return tensor
