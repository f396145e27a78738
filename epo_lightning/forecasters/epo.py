"""Energy-based potential games: the network infers a game, and the forecast is what minimises its energy (Sections 3, 4).

The paper's own method (+EPO, Algorithm 1) is one choice of energy, minimiser, derivative and objective; the others of its
Table 1, and the cells that the literature left empty, are other choices of the same four parts.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from epo_lightning.backbones.base import Backbone
from epo_lightning.decoders.goals import NO_CANDIDATE, GoalDecoder, choose, given_goals, most_likely
from epo_lightning.decoders.motions import Motions
from epo_lightning.decoders.orders import Orders, repeated
from epo_lightning.decoders.probabilities import SceneProbabilities
from epo_lightning.decoders.strategies import InitialStrategies
from epo_lightning.decoders.weights import OwnWeights, PairWeights
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.forecasters.combination import Combination
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.energy import FEATURES, RESIDUALS, Energy
from epo_lightning.game.features import OWN_FEATURES
from epo_lightning.objectives.base import Objective, Terms
from epo_lightning.optimizers import Adam
from epo_lightning.registry import ConfigError, nearest, register
from epo_lightning.scene import GameParameters, JointForecast, Scene, Status
from epo_lightning.solvers.backward import Backward
from epo_lightning.solvers.base import TABLES, Minimiser
from epo_lightning.solvers.diagnostics.equilibrium import equilibrium
from epo_lightning.task import Task

INITIAL = ("decoded", "zero", "motions")
"""Where solutions start, or between what they choose: strategies of the network's, (the paper's ablation "no init") controls
of zero, or motions that the dynamics allows."""

EXAMINED = 512
"""Scenes, evenly spread over a split, whose equilibrium is measured where no fast layer and no table does it."""


@register("forecaster", "epo")
class EPO(Forecaster):
    """Weights, goals and initial strategies from the network; joint strategies from the energy's minimisation.

    Where the data has several goal candidates and the energy a goal or a lane, mode m of an agent heads for its m-th most
    likely candidate, along the line on which that lies. A single candidate is a given goal, of all modes. A minimiser that
    chooses among candidates plays one game, and its M best joint choices are the modes; others play a game per mode.

    Args:
        backbone: the observation encoder phi_glob.
        energy: what the network's parameters weigh.
        solver: what minimises the energy.
        backward: which derivative the solution has.
        objective: what is learned.
        modes: number M of joint modes.
        own_start: own weights that a network output of zero stands for, which scale it as well: one number, or some by the
            feature's name while the others are 1. ``vel`` pulls speeds towards zero and has to start small on highways.
        pair_start: pair weight that a network output of zero stands for.
        symmetric_pairs: whether pair weights ignore which agent comes first, so that forecasts do not depend on the order of
            agents.
        initial: ``decoded``, ``zero`` or ``motions``.
        control_scale: initial control that a network output of one stands for.
        motions: largest ``acceleration`` [m/s^2] and ``curvature`` [1/m] of initial motions.
    """

    def __init__(
        self,
        task: Task,
        optimizer: Adam,
        backbone: Backbone,
        energy: Energy,
        solver: Minimiser,
        backward: Backward,
        objective: Objective,
        modes: int,
        own_start: float | Mapping[str, float] = 1.0,
        pair_start: float = 3.0,
        symmetric_pairs: bool = False,
        initial: str = "decoded",
        control_scale: float = 0.3,
        motions: Mapping[str, float] | None = None,
    ) -> None:
        Combination.of(energy=energy, solver=solver, backward=backward, objective=objective).check()
        _check_needs(energy, task)
        chooses = TABLES in solver.provides
        if modes < 1:
            raise ConfigError(f"forecaster.modes must be 1 or more, not {modes}")
        if initial not in INITIAL:
            raise ConfigError(f"unknown forecaster.initial {initial!r}: {nearest(str(initial), INITIAL)}")
        if chooses and initial == "zero":
            raise ConfigError(
                "the solver chooses among candidates, and with forecaster.initial=zero they are all the same: decoded "
                "learns them, motions samples them"
            )
        if initial == "motions" and not isinstance(energy.dynamics, Unicycle):
            raise ConfigError(
                f"forecaster.initial=motions goes with dynamics=unicycle, not with {type(energy.dynamics).__name__}: "
                "motions are those of a unicycle; choose decoded or zero"
            )
        if not 0 < control_scale < math.inf:
            raise ConfigError(f"forecaster.control_scale must be positive, and finite, not {control_scale}")
        super().__init__(task, optimizer)
        self.backbone, self.energy, self.solver, self.modes = backbone, energy, solver.for_modes(modes), modes
        self.differentiate, self.objective = backward, objective  # Lightning calls something else `backward`
        games, starts = solver.games(modes), solver.starts(modes)
        width, scale, horizon = backbone.width, task.scale, task.horizon
        own, pair = energy.weighted
        start = _checked(own_start, own, energy.own)
        self.own_weights = OwnWeights(width, games, own, start) if own else None
        self.pair_weights = PairWeights(width, games, pair, pair_start, symmetric_pairs) if pair else None
        self.strategies = InitialStrategies(width, starts, horizon, control_scale) if initial == "decoded" else None
        ranges = {} if motions is None and initial != "motions" else _ranges(motions)
        self.motions = Motions(horizon, starts, **ranges) if initial == "motions" else None
        self.goals = (
            GoalDecoder(width, scale) if task.candidates > 1 and energy.needs & {"goals", "reference"} else None
        )
        self.pair_order = energy.pair_order
        self.orders = None if self.pair_order is None else Orders(width, games, self.pair_order.symmetric)
        # Where energies or orders do not say how likely a mode is, the network does.
        says = chooses or self.orders is not None
        self.probabilities = None if says else SceneProbabilities(width, modes, horizon, scale)

    def forward(self, scene: Scene) -> JointForecast:
        z = self.backbone(scene)
        logits = None if self.goals is None else self.goals(z, scene)
        orders = self._orders(z, scene)
        parameters = self.infer(scene, z, logits, None if orders is None else orders[0])
        solver = self.solver if self.training else self.solver.for_test()
        solution = self.differentiate(solver, self.energy, scene, parameters)
        if solution.tables is not None:
            stopped = (solution.status == Status.STOPPED).any(1, keepdim=True)
            assert solution.assignment is not None
            probabilities = _once(-torch.where(stopped, 0.0, solution.energy), solution.assignment)
            initial = None
        else:
            starts = parameters.initial_controls
            # Initial strategies that learn through the solution do not learn from their own states as well.
            starts = starts.detach() if self.differentiate.teaches_start else starts
            initial = self.energy.dynamics.rollout(self.energy.initial(scene), starts, scene.dt)
            if orders is not None:
                probabilities = self._probabilities_of(orders, logits)
            else:
                assert self.probabilities is not None
                current = scene.current.where(scene.agent_mask[..., None], 0.0)
                positions = solution.states[..., :2]
                probabilities = self.probabilities(z, positions, current[..., :2], scene.agent_mask)
        return JointForecast(
            states=solution.states,
            probabilities=probabilities,
            controls=solution.controls,
            initial_states=initial,
            parameters=parameters,
            solution=solution,
            goal_probabilities=None if logits is None else logits.softmax(-1).where(logits > NO_CANDIDATE, 0.0),
            order_logits=None if orders is None else orders[2],
        )

    def infer(
        self, scene: Scene, z: Tensor, logits: Tensor | None = None, order: Tensor | None = None
    ) -> GameParameters:
        """The game of every mode: decoded weights and initial strategies, and goals, given or chosen by their ``logits``.

        Raises:
            ValueError: the scene lacks the goals or the reference lines that the energy asks for.
        """
        own_weights = {} if self.own_weights is None else self.own_weights(z, scene.agent_mask)
        goals = reference = None
        if logits is not None:
            goals, reference = choose(scene, most_likely(logits, self.solver.games(self.modes)))
            if "reference" in self.energy.needs and reference is None:
                raise ValueError("the energy follows reference lines, but scene.goal_reference [B, N, G] is None")
            # Who has no candidate heads nowhere, not for the origin.
            heads = (logits > NO_CANDIDATE).any(-1)[:, None]
            own_weights |= {
                name: own_weights[name].where(heads, 0.0) for name in self.energy.heading & own_weights.keys()
            }
        elif "goals" in self.energy.needs:
            goals = given_goals(scene)[:, None].expand(-1, self.solver.games(self.modes), -1, -1)
        return GameParameters(
            own_weights=own_weights,
            pair_weights={} if self.pair_weights is None else self.pair_weights(z),
            initial_controls=self._starts(scene, z),
            goals=goals,
            reference=reference,
            context=z if "context" in self.energy.needs else None,
            order=order,
        )

    def _orders(self, z: Tensor, scene: Scene) -> tuple[Tensor, Tensor, Tensor] | None:
        """Orders of the pairs that the energy holds to one, with their log-probabilities and logits."""
        if self.orders is None or self.pair_order is None:
            return None
        return self.orders(z, scene.agent_mask, self.pair_order.matters(scene, self.task.horizon))

    def _probabilities_of(self, orders: tuple[Tensor, Tensor, Tensor], logits: Tensor | None) -> Tensor:
        """How likely the order of every mode is, and that everybody heads where they do in it, [B, M].

        Goals are taught by where agents ended up, not by which mode came closest, so no gradient goes to their ``logits``.
        """
        order, score, _ = orders
        if logits is None:
            return _once(score, order)
        chosen = most_likely(logits, order.shape[1])
        choices = logits.detach().log_softmax(-1).gather(-1, chosen.transpose(1, 2))  # zero where there is a single one
        heads = (logits > NO_CANDIDATE).any(-1)[..., None]
        score = score + torch.where(heads, choices, 0.0).sum(1)
        return _once(score, torch.cat((order.long(), chosen), -1))

    def _starts(self, scene: Scene, z: Tensor) -> Tensor:
        """Initial strategies."""
        if self.strategies is not None:
            return self.strategies(z)
        if self.motions is not None:
            return self.motions(scene.current.where(scene.agent_mask[..., None], 0.0), scene.dt)
        batch, agents, _ = z.shape
        return z.new_zeros(batch, self.solver.starts(self.modes), agents, self.task.horizon, 2)

    def explain(self, scene: Scene, forecast: JointForecast) -> JointForecast:
        assert forecast.parameters is not None
        assert forecast.controls is not None
        terms = self.energy.terms(scene, forecast.parameters, forecast.controls)
        return dataclasses.replace(
            forecast,
            own_energy={name: terms[name] for name in self.energy.own},
            pair_energy={name: terms[name] for name in self.energy.pair},
        )

    @torch.no_grad()
    def examine(self, scene: Scene, forecast: JointForecast) -> JointForecast:
        assert forecast.solution is not None
        cheap = FEATURES in self.energy.offers or forecast.solution.tables is not None
        scenes = len(scene.history)
        stride = 1 if cheap else max(1, self._batches * scenes // EXAMINED)
        chosen = torch.arange(0, scenes, stride, device=scene.history.device)
        report = equilibrium(self.energy, scene[chosen], forecast[chosen])
        if report is None:
            return forecast
        if RESIDUALS not in self.energy.offers:
            # Where an energy may be negative, zero means nothing, and a share of an objective neither.
            report = dataclasses.replace(report, objective=torch.full_like(report.objective, torch.nan))
        whole = report.map(lambda t: t.new_full((scenes, *t.shape[1:]), torch.nan).index_copy(0, chosen, t))
        return dataclasses.replace(forecast, equilibrium=whole)

    @property
    def _batches(self) -> int:
        """Of the split that is tested; one for whoever asks without a trainer."""
        counts = self._trainer.num_test_batches if self._trainer is not None else [1]
        return int(sum(counts)) or 1

    def losses(self, scene: Scene, forecast: JointForecast) -> Terms:
        return self.objective(scene, forecast, self.energy, self.global_step)


def _check_needs(energy: Energy, task: Task) -> None:
    """Refuse an energy that refers to what the data does not give.

    Raises:
        ConfigError: the message names what is lacking.
    """
    known = {"size", "context", "order"} | ({"goals"} if task.candidates else set())
    lacking = energy.needs - known - ({"reference", "reference_speed"} if task.candidates > 1 else set())
    if lacking:
        raise ConfigError(
            f"features of energy.own need {', '.join(sorted(lacking))}, which this data does not give: leave them out, "
            "or choose data with a map"
        )


def _once(score: Tensor, modes: Tensor) -> Tensor:
    """Probabilities [B, M] of modes from their logarithms, up to a factor: a mode that repeats another has none."""
    return torch.where(repeated(modes), -torch.inf, score).softmax(1)


def _ranges(motions: Mapping[str, float] | None) -> dict[str, float]:
    """What limits initial motions.

    Raises:
        ConfigError: a name that is missing or unknown.
    """
    known, given = ("acceleration", "curvature"), dict(motions or {})
    if set(given) != set(known):
        raise ConfigError(
            "forecaster.motions must name acceleration [m/s^2] and curvature [1/m], which initial=motions takes, not "
            f"{', '.join(sorted(map(str, given))) or 'nothing'}"
        )
    return given


def _checked(
    start: float | Mapping[str, float], features: Sequence[str], all_features: Sequence[str]
) -> float | Mapping[str, float]:
    """The weights that own features start from. Names of features that other energies have are idle.

    Args:
        start: as configured.
        features: own terms whose weight is decoded.
        all_features: all own terms of the energy.

    Raises:
        ConfigError: the name of no feature, or of one whose weight is fixed, or a weight that is not positive.
    """
    named, known = start if isinstance(start, Mapping) else {"all": start}, {"all", *features, *OWN_FEATURES}
    for name, value in named.items():
        if name in all_features and name not in features:
            raise ConfigError(
                f"forecaster.own_start.{name} starts nothing: this energy holds {name} fixed; it decodes weights of "
                f"{', '.join(features) or 'nothing'}"
            )
        if name not in known:
            raise ConfigError(f"unknown feature forecaster.own_start.{name}: {nearest(name, known)}")
        if not value > 0:
            raise ConfigError(f"forecaster.own_start must be positive, but {name} would start at {value}")
    return start
