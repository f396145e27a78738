"""Inputs of named features: settings, weights, targets, sizes and masks. Absent agents have zeros."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.checks import check_whole
from epo_lightning.forecast import GameParameters
from epo_lightning.game.circles import disc
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.energy import Energy
from epo_lightning.game.feature_checks import check_bounds, check_features, check_margins, refuse_flaws
from epo_lightning.game.feature_derivatives import Bounds, Surroundings
from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES, TARGETS, WHEELBASE, OwnFeature, PairFeature, Source
from epo_lightning.game.game_end import residual_mask
from epo_lightning.game.limits import Bound, bounds_of_agents
from epo_lightning.game.pairs import pair_mask, pairs
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene


@dataclass(frozen=True)
class FeatureInputs(Energy):
    """The settings of a :class:`~epo_lightning.game.feature_energy.FeatureEnergy`, and the inputs of its features in a game.

    The energy evaluates its features on these inputs, and so do solvers, which need more derivatives.
    """

    own: Sequence[str]
    pair: Sequence[str] = ("proximity",)
    bounds: Mapping[str, Bound] = field(default_factory=dict)
    dynamics: Any = field(default_factory=Unicycle)  # Any, so that other dynamics are refused below with a reason
    pair_stride: int = 1
    margins: Mapping[str, float] = field(default_factory=dict)
    lane_slides: bool = False

    def __post_init__(self) -> None:
        check_features(self.own, self.pair)
        if not self.own and not self.pair:
            raise ConfigError("an energy needs at least one feature")
        if type(self.dynamics) is not Unicycle:  # the kernels do not call the methods of a subclass
            raise ConfigError(
                "named features are defined for dynamics=unicycle, not for "
                f"{type(self.dynamics).__name__}; energy=convex works with dynamics=double_integrator, and other dynamics "
                "need an energy of their own (docs/extend.md)"
            )
        check_whole("energy.pair_stride", self.pair_stride)
        for name, own in self.own_features.items():
            refuse_flaws("own", name, own)
        for name, pair in self.pair_features.items():
            refuse_flaws("pair", name, pair)
        check_bounds(self.bounds)
        check_margins(self.margins)
        for name, feature in self.own_features.items():
            if feature.bounded and feature.signal not in self.bounds:
                raise ConfigError(f"feature {name!r} needs energy.bounds.{feature.signal}: [lowest, highest]")

    @cached_property
    def own_features(self) -> dict[str, OwnFeature]:
        """The own features by name."""
        return {name: OWN_FEATURES[name] for name in self.own}

    @cached_property
    def pair_features(self) -> dict[str, PairFeature]:
        """The pair features by name."""
        return {name: PAIR_FEATURES[name] for name in self.pair}

    @cached_property
    def between_steps(self) -> Sequence[str]:
        """Names of the features that may depend on more than one time step, or on a state and a control together."""
        own = [name for name, feature in self.own_features.items() if not feature.of_control_or_state]
        return [*own, *(name for name, pair in self.pair_features.items() if not (pair.declared or pair.stepwise))]

    @cached_property
    def sources(self) -> Sequence[tuple[str, Source]]:
        """Name and source of every own feature, and then of every pair feature."""
        own = [(name, feature.source) for name, feature in self.own_features.items()]
        return own + [(name, feature.source) for name, feature in self.pair_features.items()]

    @property
    def of_trajectories(self) -> bool:
        """Whether some feature is a function of whole trajectories, so that its derivatives are slow."""
        return any(source is Source.TRAJECTORY for _, source in self.sources)

    @cached_property
    def needs(self) -> set[str]:
        """Inputs of the own features: some of ``goals``, ``goal_headings``, ``reference``, ``reference_speed``,
        ``reference_controls``, ``size``."""
        return {feature.needs for feature in self.own_features.values() if feature.needs}

    @property
    def goal_terms(self) -> set[str]:
        """Names of the features of goals, of their headings and of lines."""
        goals = ("goals", "goal_headings", "reference")
        return {name for name, feature in self.own_features.items() if feature.needs in goals}

    @cached_property
    def decoded_margins(self) -> Sequence[str]:
        """Names of the pair features whose margin is ``parameters.margins``, and not fixed."""
        return [name for name, feature in self.pair_features.items() if feature.margin and name not in self.margins]

    @cached_property
    def bounded_by_kind(self) -> Sequence[str]:
        """Signals of the own features whose bounds depend on the kind of agent."""
        signals = {feature.signal for feature in self.own_features.values() if feature.bounded}
        return [name for name, bound in self.bounds.items() if name in signals and isinstance(bound, Mapping)]

    @cached_property
    def targets(self) -> Sequence[str]:
        """The fields of the parameters, of :data:`~.features.TARGETS`, that the features need."""
        return [name for name in TARGETS if name in self.needs]

    @cached_property
    def needs_reach(self) -> bool:
        """Whether a pair feature needs the agents' radii."""
        return any(feature.declared for feature in self.pair_features.values())

    @cached_property
    def needs_shape(self) -> bool:
        """Whether a pair feature needs the agents' lengths and widths."""
        return any(feature.needs == "size" for feature in self.pair_features.values())

    def surroundings(self, scene: Scene, parameters: GameParameters) -> Surroundings:
        """The inputs of own features besides the trajectory."""
        present, needs = scene.agent_mask, self.needs
        goals = line = reference_speed = wheelbase = headings = reference_controls = None
        if "goals" in needs:
            assert parameters.goals is not None
            goals = torch.where(present[:, None, :, None], parameters.goals, 0.0)
        if "goal_headings" in needs:
            assert parameters.goal_headings is not None
            headings = torch.where(present[:, None], parameters.goal_headings, 0.0)
        if "reference" in needs:
            assert scene.references is not None
            followed, on_line = self._followed(scene, parameters)
            line = torch.where(on_line[..., None, None], scene.references[followed], 0.0)
        if "reference_speed" in needs:
            assert scene.reference_speed is not None
            reference_speed = torch.where(present, scene.reference_speed, 0.0)[:, None]
        if "size" in needs:
            wheelbase = WHEELBASE * self.size(scene)[:, None, :, 0]
        if "reference_controls" in needs:
            assert parameters.reference_controls is not None
            reference_controls = torch.where(present[:, None, :, None, None], parameters.reference_controls, 0.0)
        return Surroundings(
            initial=self.current_states(scene),
            dt=scene.dt,
            goals=goals,
            line=line,
            reference_speed=reference_speed,
            wheelbase=wheelbase,
            goal_headings=headings,
            ends=scene.game_steps,
            reference_controls=reference_controls,
            bounds=self._bounds_of(scene),
        )

    def _bounds_of(self, scene: Scene) -> Bounds:
        """Lowest and highest value by signal: numbers, or for bounds by kind those of every agent."""
        found: dict[str, Sequence[float] | tuple[Tensor, Tensor]] = {}
        for name, bound in self.bounds.items():
            if not isinstance(bound, Mapping):
                found[name] = bound
            elif name in self.bounded_by_kind:
                assert scene.kind is not None
                found[name] = bounds_of_agents(bound, scene.kind, scene.history.dtype)
        return found

    def _followed(self, scene: Scene, parameters: GameParameters) -> tuple[tuple[Tensor, ...], Bool[Tensor, "B M N"]]:
        """The indices of the followed lines in ``scene.references``, and a mask of those that exist."""
        assert scene.reference_mask is not None
        assert parameters.reference is not None
        present = scene.agent_mask[:, None]
        scenes = torch.arange(present.shape[0], device=present.device)[:, None, None]
        agents = torch.arange(present.shape[2], device=present.device)
        index = scenes, agents, torch.where(present, parameters.reference, 0).long()
        return index, scene.reference_mask[index] & present

    def own_weight(self, scene: Scene, parameters: GameParameters, name: str) -> Float[Tensor, "B M N"]:
        """Weights of an own feature: zero for absent agents, and for features of lines, where the line does not exist."""
        active = scene.agent_mask[:, None]
        if self.own_features[name].needs == "reference":
            _, active = self._followed(scene, parameters)
        return torch.where(active, parameters.own_weights[name], 0.0)

    def pair_weight(self, scene: Scene, parameters: GameParameters, name: str) -> Float[Tensor, "B M P"]:
        """Weights of a pair feature, zero for pairs with an absent agent."""
        return torch.where(pair_mask(scene)[:, None], parameters.pair_weights[name], 0.0)

    def margin(self, scene: Scene, parameters: GameParameters, name: str) -> Float[Tensor, "B _ P"]:
        """Margins [m] of a pair feature, fixed or decoded, [B, 1, P] or [B, M, P]; zero for pairs with an absent agent."""
        exists = pair_mask(scene)[:, None]
        if name in self.margins:
            return self.margins[name] * exists.to(scene.history.dtype)
        return torch.where(exists, parameters.margins[name], 0.0)

    def extent(self, scene: Scene) -> Float[Tensor, "B N"] | None:
        """Radius [m] in which an agent can affect others, without margins; None if a pair feature has no limit."""
        extents = [feature.extent for feature in self.pair_features.values()]
        finite = [extent(self.size(scene)) for extent in extents if extent is not None]
        return torch.stack(finite).amax(0) if len(finite) == len(extents) else None

    def reach(self, scene: Scene, parameters: GameParameters, name: str) -> Float[Tensor, "B _ P _"]:
        """The distance [m] at which the discs of two agents touch, r_i + r_j, with the margin of the pair feature ``name``.

        The shape is [B, M, P, 1] for decoded margins and [B, 1, P, 1] otherwise; other energies may have distances that
        differ from step to step.
        """
        radius = disc(self.size(scene))
        first, second = pairs(scene.agent_mask.shape[1], radius.device)
        reach = (radius[:, first] + radius[:, second])[:, None]
        return (reach + self.margin(scene, parameters, name) if self.pair_features[name].margin else reach)[..., None]

    def residual_mask(self, scene: Scene, feature: OwnFeature, steps: int) -> Bool[Tensor, "B 1 1 R"] | None:
        """Mask of the residuals of a declared own feature before the end of each game; None if no residual is after it."""
        return None if scene.game_steps is None else residual_mask(feature.source, scene.game_steps, steps)

    def evaluated(self, scene: Scene) -> Int[Tensor, " B"] | None:
        """Number of steps of each game at which pair features are evaluated; None if all games have the same number."""
        return None if scene.game_steps is None else scene.game_steps // self.pair_stride

    def pair_exists(self, scene: Scene, feature: PairFeature, steps: int) -> Bool[Tensor, "B 1 P _"]:
        """Mask of the residuals of a pair feature whose agents are present, at L = ``steps`` evaluated steps, up to the end
        of each game."""
        exists, evaluated = pair_mask(scene)[:, None, :, None], self.evaluated(scene)
        if evaluated is None or not (feature.declared or feature.stepwise):
            return exists
        return exists & (torch.arange(steps, device=exists.device) < evaluated[:, None, None, None])

    def at_pair_steps(self, states: Float[Tensor, "*batch K X"]) -> Float[Tensor, "*batch L X"]:
        """The states at k = stride, 2 stride, ..., the steps at which pair features are evaluated."""
        return states[..., self.pair_stride - 1 :: self.pair_stride, :]
