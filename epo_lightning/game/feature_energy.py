"""The paper's energy: a sum of squared, weighted, named residuals (nonlinear least squares)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.forecast import GameParameters
from epo_lightning.game.circles import separation
from epo_lightning.game.energy import FEATURES, GRADIENT, RESIDUALS, STAGES
from epo_lightning.game.feature_checks import check_inputs
from epo_lightning.game.feature_derivatives import (
    Surroundings,
    own_derivatives,
    pair_derivatives,
    signal_and_change,
    stepwise_change,
    undeclared_change,
)
from epo_lightning.game.feature_inputs import FeatureInputs
from epo_lightning.game.features import BUILT_IN, Source
from epo_lightning.game.game_end import until
from epo_lightning.game.pairs import pair_mask, pairs
from epo_lightning.registry import register
from epo_lightning.scene import Scene


@register("energy", "features")
@dataclass(frozen=True)
class FeatureEnergy(FeatureInputs):
    """The potential of Eqs. 10 and 11, E = 1/2 sum_i |w_i c(u_i, g_i)|^2 + 1/2 sum_{i<j} |w_ij d(u_i, u_j)|^2.

    Every named feature has a weight of its own: a residual is w c, so weights enter the energy squared and their sign has
    no effect. (Eq. 10 prints w^T c, a sum over features. Here w c is the vector of all weighted features, which have
    different units and lengths.) Because the pair terms are symmetric, a minimum of E is an open-loop Nash equilibrium in
    which agent i minimises its own terms plus the pair terms it takes part in (Theorem 1).

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

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.between_steps:
            object.__setattr__(self, "offers", self.offers | {STAGES})

    @cached_property
    def undeclared(self) -> FeatureEnergy | None:
        """The part of the energy whose derivatives need automatic differentiation; None if all features are declared."""
        own = [name for name, feature in self.own_features.items() if not feature.declared]
        pair = [name for name, feature in self.pair_features.items() if not feature.declared]
        return self._part(own, pair)

    @cached_property
    def built_in(self) -> FeatureEnergy | None:
        """The part of the energy whose features are built in, which kernels know; None if there are none."""
        return self._part(
            [name for name in self.own if name in BUILT_IN], [name for name in self.pair if name in BUILT_IN]
        )

    @cached_property
    def custom(self) -> FeatureEnergy | None:
        """The part of the energy whose features are functions of the user; None if there are none."""
        return self._part(
            [name for name in self.own if name not in BUILT_IN], [name for name in self.pair if name not in BUILT_IN]
        )

    def _part(self, own: Sequence[str], pair: Sequence[str]) -> FeatureEnergy | None:
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
            exists = scene.agent_mask[:, None, :, None]
            if feature.source is Source.STEP:
                value, change = stepwise_change(feature.function, at, moved)
                mask = self.residual_mask(scene, feature, at[1].shape[-2])
                exists = exists if mask is None else exists & mask
            else:
                value, change = undeclared_change(until(feature.function, scene.game_steps), at, moved)
            value, change = torch.where(exists, value, 0.0), torch.where(exists, change, 0.0)
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
        both, moved = ((self._of_present(scene, one), self._of_present(scene, other)) for one, other in (both, moved))
        distance, normal = separation(both[0][..., :2], both[1][..., :2])
        closing = (normal * (moved[0] - moved[1])[..., :2]).sum(-1)
        for name, pair in self.pair_features.items():
            if pair.declared:
                value, slope, _ = pair_derivatives(pair, distance, self.reach(scene, parameters, name))
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

    def _of_present(self, scene: Scene, values: Float[Tensor, "*batch P K X"]) -> Float[Tensor, "*batch P L X"]:
        """Values at the steps at which pairs are evaluated, without a gradient for pairs with an absent agent.

        All numbers of an absent agent are zero, where a function may have no finite derivative.
        """
        values = self.at_pair_steps(values)
        present = pair_mask(scene)[:, None, :, None, None]
        return torch.where(present, values, values.detach()) if values.requires_grad else values

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

    def finite_inputs(self, scene: Scene, parameters: GameParameters) -> Bool[Tensor, "B M"]:
        """Mask of the games whose inputs are finite, and whose sizes are not negative.

        A NaN of most inputs reaches the controls and is found there. This mask checks the others, whose NaN or infinity may
        have no effect on the solution: weights of pairs that never touch, positions of agents that no feature uses, and
        points of reference lines that are never the nearest.
        """
        present = scene.agent_mask
        finite = scene.current_or_zero.isfinite().flatten(1).all(1)
        paired = present.shape[1] > 1
        if (paired and (self.needs_shape or self.needs_reach)) or "size" in self.needs:
            size = self.size(scene) if paired and self.needs_shape else self.size(scene)[..., :1]
            finite = finite & ((size >= 0) & (size < torch.inf)).flatten(1).all(1)
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

    def of_scenes(self, rows: Tensor | slice) -> FeatureEnergy:
        """The energy of some scenes of a batch: this one, if it holds no values of single scenes."""
        return self
