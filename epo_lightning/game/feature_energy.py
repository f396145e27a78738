"""The paper's energy: a sum of squared, weighted, named residuals (nonlinear least squares)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.checks import check_whole
from epo_lightning.forecast import GameParameters
from epo_lightning.game.circles import disc, separation
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.energy import FEATURES, GRADIENT, RESIDUALS, STAGES, Energy
from epo_lightning.game.feature_checks import check_bounds, check_features, check_inputs, check_margins, refuse_flaws
from epo_lightning.game.feature_derivatives import (
    Bounds,
    Surroundings,
    own_derivatives,
    pair_derivatives,
    signal_and_change,
    undeclared_change,
)
from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES, TARGETS, WHEELBASE, OwnFeature, PairFeature
from epo_lightning.game.game_end import residual_mask, until
from epo_lightning.game.limits import Bound, bounds_of_agents
from epo_lightning.game.pairs import pair_mask, pairs
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import Scene


@register("energy", "features")
@dataclass(frozen=True)
class FeatureEnergy(Energy):
    """The potential of Eqs. 10 and 11, E = 1/2 sum_i |w_i c(u_i, g_i)|^2 + 1/2 sum_{i<j} |w_ij d(u_i, u_j)|^2.

    Every named feature has a weight of its own: a residual is w c, so weights enter the energy squared and their sign has
    no effect. Because the pair terms are symmetric, a minimum of E is an open-loop Nash equilibrium in which agent i
    minimises its own terms plus the pair terms it takes part in (Theorem 1).

    :meth:`residuals` is the reference. The fast solver evaluates the same features, with their derivatives, in
    :mod:`epo_lightning.solvers.gauss_newton.expansion`. A feature is *declared* if its source gives its Jacobian in closed
    form; all built-in own features, ``proximity`` and ``clearance`` are. Automatic differentiation serves the others.

    A pair with a weight of exactly zero does not interact: solvers skip it, and because weights enter squared, its weight
    has no gradient. Set weights to zero to define which pairs of a game do not interact.

    Example::

        energy = FeatureEnergy(own=["goal", "vel", "acc", "turnr"], pair=["proximity"])
        energy(scene, parameters, controls)            # [B, M]
        energy.residuals(scene, parameters, controls)  # {"goal": [B, M, N, 2], ..., "proximity": [B, M, P, K]}

    Attributes:
        own: names of :data:`~epo_lightning.game.features.OWN_FEATURES`, which includes custom features
            (:func:`~epo_lightning.game.features.own_feature`).
        pair: names of :data:`~epo_lightning.game.features.PAIR_FEATURES`. For ``proximity`` an agent is a disc whose radius
            is half its length; for ``circles`` see :mod:`~epo_lightning.game.circles`.
        bounds: lowest and highest value of a signal (speed ``vel``, acceleration ``acc``, ...), for features whose name ends
            in ``b``: ``{"vel": (-0.05, 2.0)}``, or by kind:
            ``{"vel": {"pedestrian": (0.0, 3.0), "default": (-2.0, 20.0)}}``.
        dynamics: a :class:`~epo_lightning.game.dynamics.Unicycle`.
        pair_stride: steps between evaluations of pair features: they are evaluated at k = stride, 2 stride, ...
        margins: fixed margins [m] of pair features, ``{"clearance": 0.5}``; those of other features with a margin are
            ``parameters.margins``.
        lane_slides: true if the nearest point of a line moves with the agent in the Jacobian of ``lane``, which is the exact
            derivative. Otherwise the point is held: motion along the line then seems to have a cost, so Gauss-Newton steps
            are shorter, but they lead to the same solution.

    A game of ``scene.game_steps`` steps has no terms after its end (:mod:`~epo_lightning.game.game_end`).
    """

    offers = frozenset({GRADIENT, RESIDUALS, FEATURES})

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
        if not isinstance(self.dynamics, Unicycle):
            raise ConfigError(
                "named features are defined for dynamics=unicycle, not for "
                f"{type(self.dynamics).__name__}; energy=convex works with dynamics=double_integrator"
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
        if not self.between_steps:
            object.__setattr__(self, "offers", self.offers | {STAGES})

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
        """Names of the features that may depend on more than one time step."""
        own = [name for name, feature in self.own_features.items() if not feature.stepwise]
        return [*own, *(name for name, pair in self.pair_features.items() if not (pair.declared or pair.stepwise))]

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

    @cached_property
    def undeclared(self) -> FeatureEnergy | None:
        """The part of the energy whose derivatives need automatic differentiation; None if all features are declared."""
        own = [name for name, feature in self.own_features.items() if not feature.declared]
        pair = [name for name, feature in self.pair_features.items() if not feature.declared]
        return dataclasses.replace(self, own=own, pair=pair) if own or pair else None

    def residuals(
        self, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
    ) -> dict[str, Float[Tensor, "B M _ _"]]:
        """Weighted residuals w c by feature: [B, M, N, R] for own features and [B, M, P, R] for pairs.

        R is K, K - 1 for jerk and turnacc, 2 for the goal, 1 for its heading, 2 K for the lane, the number of evaluated
        steps for pairs, and the number of values that an undeclared feature returns. Residuals of absent agents, and of
        steps after the end of a game, are zero.

        Raises:
            ValueError: shapes or names of scene, parameters and controls that do not fit together.
        """
        self.validate(scene, parameters, controls)
        no_direction = controls.new_zeros(0, *controls.shape)
        return {name: residual for name, residual, _ in self._features(scene, parameters, controls, no_direction)}

    def linearisation(
        self,
        scene: Scene,
        parameters: GameParameters,
        controls: Float[Tensor, "B M N K 2"],
        directions: Float[Tensor, "D B M N K 2"],
    ) -> tuple[Float[Tensor, "B M R"], Float[Tensor, "D B M R"]]:
        """The vector r of all residuals, and its directional derivatives J v along D directions v of the controls.

        Both are differentiable with respect to controls and parameters. Which bounds are violated and which agents overlap
        is held constant.
        """
        _, residuals, changes = zip(*self._features(scene, parameters, controls, directions), strict=True)
        return torch.cat([r.flatten(2) for r in residuals], -1), torch.cat([c.flatten(3) for c in changes], -1)

    def _features(
        self, scene: Scene, parameters: GameParameters, controls: Tensor, directions: Tensor
    ) -> Iterator[tuple[str, Tensor, Tensor]]:
        """Name, weighted residual and its change along every direction, feature by feature."""
        controls = torch.where(scene.agent_mask[:, None, :, None, None], controls, 0.0)
        states = self.dynamics.rollout(self.current_states(scene), controls, scene.dt)
        change = self.dynamics.tangent(states, directions, scene.dt)
        yield from self._of_agents(scene, parameters, (states, controls), (change, directions))
        first, second = pairs(controls.shape[2], controls.device)
        both = states[:, :, first], states[:, :, second]
        yield from self.pair_residuals(scene, parameters, both, (change[:, :, :, first], change[:, :, :, second]))

    def _of_agents(
        self, scene: Scene, parameters: GameParameters, at: tuple[Tensor, Tensor], moved: tuple[Tensor, Tensor]
    ) -> Iterator[tuple[str, Tensor, Tensor]]:
        """Name, weighted residual and its change of every own feature.

        Args:
            scene, parameters: the game.
            at: states and controls.
            moved: their changes along D directions, in the first dimension.
        """
        around = self.surroundings(scene, parameters)
        for name in self.own:
            yield name, *self.own_residual(name, scene, parameters, around, at, moved)

    def own_residual(
        self,
        name: str,
        scene: Scene,
        parameters: GameParameters,
        around: Surroundings,
        at: tuple[Tensor, Tensor],
        moved: tuple[Tensor, Tensor],
        slide: bool = False,
    ) -> tuple[Float[Tensor, "B C N R"], Float[Tensor, "D B C N R"]]:
        """The weighted residual w c of one own feature, and its change along D changes of the trajectories.

        Args:
            name: the feature.
            scene, parameters, around: the game.
            at: states and controls.
            moved: their changes along D directions, in the first dimension.
            slide: whether the nearest point of a line moves with the agent also if ``lane_slides`` is false.
        """
        feature = self.own_features[name]
        if feature.declared:
            signal, change = signal_and_change(feature, *at, *moved, around, slide or self.lane_slides)
            mask = self.residual_mask(scene, feature, at[1].shape[-2])
            value, first, _ = own_derivatives(feature, signal, around.bounds).within(mask)
            change = change if first is None else first * change
        else:
            assert feature.function is not None
            value, change = undeclared_change(until(feature.function, scene.game_steps), at, moved)
            present = scene.agent_mask[:, None, :, None]
            value, change = torch.where(present, value, 0.0), torch.where(present, change, 0.0)
        weight = self.own_weight(scene, parameters, name)[..., None]
        return weight * value, weight * change

    def pair_residuals(
        self, scene: Scene, parameters: GameParameters, both: tuple[Tensor, Tensor], moved: tuple[Tensor, Tensor]
    ) -> Iterator[tuple[str, Tensor, Tensor]]:
        """Name, weighted residual and its change of every pair feature.

        Args:
            scene, parameters: the game.
            both: states of the first and of the second agents.
            moved: their changes along D directions, in the first dimension.
        """
        if not self.pair:
            return
        agents = scene.agent_mask.shape[1]
        first, second = pairs(agents, scene.agent_mask.device)
        both, moved = ((self.at_pair_steps(one), self.at_pair_steps(other)) for one, other in (both, moved))
        distance, normal = separation(both[0][..., :2], both[1][..., :2])
        closing = (normal * (moved[0] - moved[1])[..., :2]).sum(-1)
        for name, pair in self.pair_features.items():
            if pair.declared:
                value, slope, _ = pair_derivatives(pair, distance, self.reach(scene, parameters, name)[..., None])
                assert slope is not None
                change = slope * closing
            else:
                others = [self.size(scene)[:, None, members, None] for members in (first, second) if pair.needs]
                others += [self.margin(scene, parameters, name)[..., None]] if pair.margin else []
                function = pair.function if pair.stepwise else until(pair.function, self.evaluated(scene))
                value, change = undeclared_change(function, both, moved, *others)
            exists = self.pair_exists(scene, pair, distance.shape[-1])
            weight = self.pair_weight(scene, parameters, name)[..., None]
            yield name, weight * torch.where(exists, value, 0.0), weight * torch.where(exists, change, 0.0)

    def own_terms(
        self,
        scene: Scene,
        parameters: GameParameters,
        states: Float[Tensor, "B C N K 4"],
        controls: Float[Tensor, "B C N K 2"],
    ) -> dict[str, Float[Tensor, "B C N"]]:
        """1/2 |w c|^2 by own feature."""
        no_direction = states.new_zeros(0, *states.shape), controls.new_zeros(0, *controls.shape)
        features = self._of_agents(scene, parameters, (states, controls), no_direction)
        return {name: 0.5 * residual.square().sum(-1) for name, residual, _ in features}

    def pair_terms(
        self,
        scene: Scene,
        parameters: GameParameters,
        first: Float[Tensor, "B C P K 4"],
        second: Float[Tensor, "B C P K 4"],
    ) -> dict[str, Float[Tensor, "B C P"]]:
        """1/2 |w d|^2 by pair feature."""
        no_direction = first.new_zeros(0, *first.shape)
        features = self.pair_residuals(scene, parameters, (first, second), (no_direction, no_direction))
        return {name: 0.5 * residual.square().sum(-1) for name, residual, _ in features}

    def check_horizon(self, steps: int) -> None:
        """Check that the features are defined for controls of K = ``steps`` steps.

        Raises:
            ValueError: a horizon of less than two steps, or shorter than ``pair_stride``.
        """
        if steps < 2:
            raise ValueError(f"controls span K = {steps} step(s); an energy needs at least 2")
        if self.pair and self.pair_stride > steps:
            raise ValueError(
                f"energy.pair_stride={self.pair_stride} evaluates pairs at no step: controls span K = {steps} steps; "
                f"choose 1 to {steps}"
            )

    def validate(self, scene: Scene, parameters: GameParameters, controls: Tensor) -> None:
        """Check that scene, parameters and controls fit together.

        Raises:
            ValueError: a wrong shape, a missing weight or margin, missing goals, goal headings, references, reference
                speeds or sizes, a negative margin, a horizon shorter than ``pair_stride``, or a game that ends after the
                controls. The message names the tensor and the expected shape.
        """
        super().validate(scene, parameters, controls)
        check_inputs(self, scene, parameters, controls)

    def finite(self, scene: Scene, parameters: GameParameters) -> Bool[Tensor, "B M"]:
        """Mask of the games whose inputs are finite.

        A NaN of most inputs reaches the controls and is found there. This mask checks the others, whose NaN or infinity may
        have no effect on the solution: weights of pairs that never touch, positions of agents that no feature uses, and
        points of reference lines that are never the nearest.
        """
        present = scene.agent_mask
        finite = torch.where(present[..., None], scene.current, 0.0).isfinite().flatten(1).all(1)
        if self.needs_shape:
            finite = finite & self.size(scene).isfinite().flatten(1).all(1)
        elif self.needs_reach or "size" in self.needs:
            finite = finite & self.size(scene)[..., 0].isfinite().all(1)
        of_modes = finite[:, None].expand(-1, parameters.initial_controls.shape[1])
        for name in self.pair:
            of_modes = of_modes & self.pair_weight(scene, parameters, name).isfinite().all(-1)
        for name in self.decoded_margins:
            of_modes = of_modes & self.margin(scene, parameters, name).isfinite().all(-1)
        if "reference" in self.needs:
            line = self.surroundings(scene, parameters).line
            assert line is not None
            of_modes = of_modes & torch.where(present[:, None, :, None, None], line, 0.0).isfinite().flatten(2).all(2)
        return of_modes

    # The methods below return the inputs of the residuals; solvers use them as well. They set absent agents to zero.

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
            self.current_states(scene),
            scene.dt,
            goals,
            line,
            reference_speed,
            wheelbase,
            headings,
            scene.game_steps,
            reference_controls,
            self._bounds_of(scene),
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

    def reach(self, scene: Scene, parameters: GameParameters, name: str) -> Float[Tensor, "B _ P"]:
        """The distance [m] at which the discs of two agents touch, r_i + r_j, with the margin of the pair feature ``name``.

        The shape is [B, M, P] for decoded margins and [B, 1, P] otherwise.
        """
        radius = disc(self.size(scene))
        first, second = pairs(scene.agent_mask.shape[1], radius.device)
        reach = (radius[:, first] + radius[:, second])[:, None]
        return reach + self.margin(scene, parameters, name) if self.pair_features[name].margin else reach

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

    def of_scenes(self, rows: Tensor | slice) -> FeatureEnergy:
        """The energy of some scenes of a batch: this one, if it holds no values of single scenes."""
        return self

    def at_pair_steps(self, states: Float[Tensor, "*batch K X"]) -> Float[Tensor, "*batch L X"]:
        """The states at k = stride, 2 stride, ..., the steps at which pair features are evaluated."""
        return states[..., self.pair_stride - 1 :: self.pair_stride, :]
