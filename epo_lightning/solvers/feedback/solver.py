"""The solver ``feedback``: feedback equilibria on both sides on which agents can pass."""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from epo_lightning.checks import check_number, check_whole
from epo_lightning.forecast import GameParameters, Solution, Status
from epo_lightning.game.energy import FEATURES, STAGES, Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import Scene
from epo_lightning.solvers.base import STATIONARY, Minimiser
from epo_lightning.solvers.feedback import derivative, iteration, kernel
from epo_lightning.solvers.feedback.iteration import FeedbackGame
from epo_lightning.solvers.gauss_newton.both_sides import BothSides
from epo_lightning.solvers.gauss_newton.kernel import interface
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt
from epo_lightning.solvers.general import descent


@dataclass(frozen=True)
class ToFeedback(Minimiser):
    """Iterated LQ games, from the open-loop equilibrium below every initial strategy to a feedback equilibrium.

    Attributes:
        iterations, tolerance, regularisation, terms: those of :class:`Feedback`.
        open_loop: the steps to the open-loop equilibrium; None to begin at the initial strategies themselves.
        backend: ``pytorch``, or another one for the compiled kernel where it can solve the game (:func:`.kernel.obstacle`).
    """

    needs_from_energy = frozenset({FEATURES, STAGES})
    provides = frozenset({STATIONARY})
    on_host = True

    iterations: int
    tolerance: float
    regularisation: float
    terms: int
    open_loop: LevenbergMarquardt | None = None
    backend: str = "auto"

    def near_minimum(self) -> ToFeedback:
        """The iterations without the steps to the open-loop equilibrium."""
        return dataclasses.replace(self, open_loop=None)

    @torch.no_grad()
    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """Solve the open-loop game, then iterate.

        Raises:
            ValueError: the energy has other terms than features of single time steps; or as
                :meth:`LevenbergMarquardt.run`.
        """
        energy = _checked(energy)
        scene, start = descent.begin(energy, scene, parameters)
        if start.numel() == 0:
            return descent.nothing(start)
        parameters = parameters.for_every_mode(start.shape[1])
        at_start = LevenbergMarquardt(steps=0)(energy, scene, dataclasses.replace(parameters, initial_controls=start))
        if self.open_loop is not None:
            start = self.open_loop(energy, scene, parameters).controls
        game = self._game(energy, scene, parameters)
        iterate = kernel.iterate if self._compiled(game) else iteration.iterate
        controls, status = iterate(game, _on_host(start), self.iterations, self.tolerance)
        ended = dataclasses.replace(parameters, initial_controls=controls.to(start))
        found = LevenbergMarquardt(steps=0)(energy, scene, ended)
        status = torch.maximum(status.to(start.device), found.status)
        return dataclasses.replace(found, initial_energy=at_start.energy, status=status)

    def attach(
        self, energy: Energy, scene: Scene, parameters: GameParameters, solution: Solution, exact: bool
    ) -> tuple[Tensor, Tensor]:
        """Controls with the derivative of the fixed point, which is zero where the game is not solved, and the status.

        Warns if more than half of the games are not solved.

        Raises:
            ConfigError: ``exact`` is false. Gauss-Newton costs are part of the fixed point, and cannot be left out.
        """
        if not exact:
            raise ConfigError("backward.hessian=gauss_newton has no effect with solver=feedback: leave it out")
        assert isinstance(energy, FeatureEnergy)
        solved = _on_host(solution.status == Status.COMPLETED)
        if solved.numel() > 2 * solved.sum():
            warnings.warn(
                "solver=feedback: more than half of the games of a batch are not solved and have no gradient: raise "
                "solver.iterations, or begin with other weights (docs/troubleshooting.md)",
                stacklevel=2,
            )
        game = self._game(energy, scene, parameters.for_every_mode(solution.controls.shape[1]))
        attach = kernel.attach if self._compiled(game) else derivative.attach
        controls = attach(game, _on_host(solution.controls), solved, self.terms)
        return controls.to(solution.controls), solution.status

    def _game(self, energy: FeatureEnergy, scene: Scene, parameters: GameParameters) -> FeedbackGame:
        scene = dataclasses.replace(scene, future=None, future_mask=None, lanes=None, lane_mask=None)  # not used
        return FeedbackGame(energy, scene.map(_on_host), parameters.map(_on_host), self.regularisation)

    def _compiled(self, game: FeedbackGame) -> bool:
        return self.backend != "pytorch" and kernel.obstacle(game) is None


def _checked(energy: Energy) -> FeatureEnergy:
    """The energy, whose features are all of single time steps, and whose LQ games the compiled layer solves.

    Raises:
        ValueError: it is another one; the message names the features.
        ConfigError: the compiled layer is missing, and nothing can take its place.
    """
    library = interface.find()
    if isinstance(library, str):
        raise ConfigError(
            f"solver=feedback needs the compiled layer of this package, which is missing: {library}. Games of agents that "
            "do not react to each other are solved without it (solver=both_sides)"
        )
    if not isinstance(energy, FeatureEnergy):
        raise ValueError(f"solver=feedback takes energy=features, not {type(energy).__name__}")
    if energy.between_steps:
        raise ValueError(
            "solver=feedback takes features of the states or of the controls of single time steps, and not "
            f"{', '.join(energy.between_steps)}: leave them out, or choose another solver"
        )
    return energy


def _on_host(tensor: Tensor) -> Tensor:
    """The tensor on the CPU, numbers in double precision."""
    return tensor.to("cpu", torch.double) if tensor.is_floating_point() else tensor.cpu()


@register("solver", "feedback")
@dataclass(frozen=True)
class Feedback(BothSides):
    """Feedback equilibria of one game: open-loop equilibria on both sides, from which LQ games are iterated.

    The agents react to each other's deviations (:mod:`~epo_lightning.solvers.feedback.lq_game`). The solution is no minimum
    of E, and has a derivative of its own: use ``backward=implicit``.

    Attributes:
        iterations: largest number of LQ games.
        tolerance: a game is solved once its policies change no state [m, rad, m/s] by this much.
        regularisation: multiple of the identity that is added to the Hessians of every agent's cost by states and controls.
            It is part of the game: policies depend on it. 5 in GameInference.jl (Peters, 2020), which the paper's data are
            made with.
        terms: number of steps of GMRES for the derivative (:func:`~.derivative.attach`).
    """

    needs_from_energy = frozenset({FEATURES, STAGES})
    on_host = True

    iterations: int = 30
    tolerance: float = 1e-3
    regularisation: float = 5.0
    terms: int = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        check_whole("solver.iterations", self.iterations)
        check_number("solver.tolerance", self.tolerance)
        check_number("solver.regularisation", self.regularisation, zero=True)
        check_whole("solver.terms", self.terms)

    def descent(self) -> ToFeedback:
        """The steps from each initial strategy to the feedback equilibrium of its side."""
        return ToFeedback(
            self.iterations, self.tolerance, self.regularisation, self.terms, self.open_loop(), self.backend
        )

    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """Open-loop equilibria on both sides, and the feedback equilibria near them.

        Raises:
            ValueError: as :meth:`ToFeedback.__call__`.
        """
        found = super().__call__(_checked(energy), scene, parameters)
        game = dataclasses.replace(parameters.for_every_mode(self.modes), initial_controls=found.controls)
        return dataclasses.replace(
            self.descent().near_minimum()(energy, scene, game), initial_energy=found.initial_energy
        )

    def attach(
        self, energy: Energy, scene: Scene, parameters: GameParameters, solution: Solution, exact: bool
    ) -> tuple[Tensor, Tensor]:
        """The controls with their derivative, and a status.

        Raises:
            ConfigError: as :meth:`ToFeedback.attach`.
        """
        return self.descent().attach(energy, scene, parameters, solution, exact)
