"""The paper's energy: a sum of squared, weighted, named residuals (nonlinear least squares)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.checks import check_whole, is_number
from epo_lightning.game.circles import disc, separation
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.energy import FEATURES, GRADIENT, RESIDUALS, Energy, check_names
from epo_lightning.game.feature_derivatives import (
    Surroundings,
    own_derivatives,
    pair_derivatives,
    signal_and_change,
    undeclared_change,
)
from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES, WHEELBASE, OwnFeature, PairFeature
from epo_lightning.game.pairs import pair_mask, pairs
from epo_lightning.registry import ConfigError, nearest, register
from epo_lightning.scene import GameParameters, Scene


@register("energy", "features")
@dataclass(frozen=True)
class FeatureEnergy(Energy):
    """The potential of Eqs. 10 and 11, E = 1/2 sum_i |w_i c(u_i, g_i)|^2 + 1/2 sum_{i<j} |w_ij d(u_i, u_j)|^2.

    Every named feature has a weight of its own: a residual is w c, so weights enter the energy squared and their sign has
    no effect. Because the pair terms are symmetric, a minimum of E is an open-loop Nash equilibrium in which agent i
    minimises its own terms plus the pair terms it takes part in (Theorem 1).

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
            in ``b``: ``{"vel": (-0.05, 2.0)}``.
        dynamics: a :class:`~epo_lightning.game.dynamics.Unicycle`.
        pair_stride: steps between evaluations of pair features: they are evaluated at k = stride, 2 stride, ...
    """

    offers = frozenset({GRADIENT, RESIDUALS, FEATURES})

    own: Sequence[str]
    pair: Sequence[str] = ("proximity",)
    bounds: Mapping[str, Sequence[float]] = field(default_factory=dict)
    dynamics: Any = field(default_factory=Unicycle)  # Any, so that other dynamics are refused below with a reason
    pair_stride: int = 1

    def __post_init__(self) -> None:
        check_names("own", self.own, OWN_FEATURES, "feature")
        check_names("pair", self.pair, PAIR_FEATURES, "feature")
        if not self.own and not self.pair:
            raise ConfigError("an energy needs at least one feature")
        if not isinstance(self.dynamics, Unicycle):
            raise ConfigError(
                "named features are defined for dynamics=unicycle, not for "
                f"{type(self.dynamics).__name__}; energy=convex works with dynamics=double_integrator"
            )
        check_whole("energy.pair_stride", self.pair_stride)
        for name, pair in self.pair_features.items():
            _refuse_asymmetry(name, pair)
        _check_bounds(self.bounds)
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
    def needs(self) -> set[str]:
        """Inputs of the own features: some of ``goals``, ``reference``, ``reference_speed``, ``size``."""
        return {feature.needs for feature in self.own_features.values() if feature.needs}

    @property
    def goal_terms(self) -> set[str]:
        """Names of the features of goals and of lines."""
        return {name for name, feature in self.own_features.items() if feature.needs in ("goals", "reference")}

    @cached_property
    def needs_goals(self) -> bool:
        """Whether a feature needs goals."""
        return "goals" in self.needs

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

        R is K, K - 1 for jerk and turnacc, 2 for the goal, 2 K for the lane, the number of evaluated steps for pairs, and
        the number of values that an undeclared feature returns. Absent agents have residuals of zero.

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
        states = self.dynamics.rollout(self.initial(scene), controls, scene.dt)
        change = self.dynamics.tangent(states, directions, scene.dt)
        yield from self._of_agents(scene, parameters, (states, controls), (change, directions))
        first, second = pairs(controls.shape[2], controls.device)
        both = states[:, :, first], states[:, :, second]
        yield from self._of_pairs(scene, parameters, both, (change[:, :, :, first], change[:, :, :, second]))

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
            slide: whether the nearest point of a line moves with the agent
        """
        feature = self.own_features[name]
        if feature.declared:
            signal, change = signal_and_change(feature, *at, *moved, around, slide)
            value, first, _ = own_derivatives(feature, signal, self.bounds)
            change = change if first is None else first * change
        else:
            assert feature.function is not None
            value, change = undeclared_change(feature.function, at, moved)
            present = scene.agent_mask[:, None, :, None]
            value, change = torch.where(present, value, 0.0), torch.where(present, change, 0.0)
        weight = self.own_weight(scene, parameters, name)[..., None]
        return weight * value, weight * change

    def _of_pairs(
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
                value, slope, _ = pair_derivatives(pair, distance, self.reach(scene)[:, None, :, None])
                assert slope is not None
                change = slope * closing
            else:
                sizes = [self.size(scene)[:, None, members, None] for members in (first, second) if pair.needs]
                value, change = undeclared_change(pair.function, both, moved, *sizes)
            exists = pair_mask(scene)[:, None, :, None]
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
        features = self._of_pairs(scene, parameters, (first, second), (no_direction, no_direction))
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
            ValueError: a wrong shape, a missing weight, missing goals, references, reference speeds or sizes, or a
                horizon shorter than ``pair_stride``. The message names the tensor and the expected shape.
        """
        super().validate(scene, parameters, controls)
        batch, agents = scene.agent_mask.shape
        modes, steps = controls.shape[1], controls.shape[3]
        self.check_horizon(steps)
        for part, names, given, count in (
            ("own_weights", self.own, parameters.own_weights, agents),
            ("pair_weights", self.pair, parameters.pair_weights, agents * (agents - 1) // 2),
        ):
            for name in names:
                if name not in given:
                    raise ValueError(f"{part} lacks the feature {name!r}; it has {sorted(given)}")
                shape = list(given[name].shape) if isinstance(given[name], Tensor) else given[name]
                if shape not in ([batch, modes, count], [batch, 1, count]):
                    raise ValueError(f"{part}[{name!r}] has shape {shape}; these controls take {[batch, modes, count]}")
        needed: dict[str, tuple[tuple[str, Tensor | None], ...]] = {
            "goals": (("parameters.goals", parameters.goals),),
            "reference": (("scene.references", scene.references), ("parameters.reference", parameters.reference)),
            "reference_speed": (("scene.reference_speed", scene.reference_speed),),
            "size": (("scene.size", scene.size),),
        }
        for name, feature in self.own_features.items():
            for what, value in needed[feature.needs] if feature.needs else ():
                if value is None:
                    raise ValueError(f"the energy has the feature {name!r}, but {what} is None")
                takes = {"parameters.goals": [agents, 2], "parameters.reference": [agents]}.get(what)
                if takes and list(value.shape) not in ([batch, modes, *takes], [batch, 1, *takes]):
                    raise ValueError(
                        f"{what} has shape {list(value.shape)}; these controls take {[batch, modes, *takes]}"
                    )
        if "reference" in self.needs and parameters.reference.is_floating_point():  # type: ignore[union-attr]
            raise ValueError("parameters.reference holds indices of lines: it takes whole numbers, not floats")
        if "reference" in self.needs and controls.device.type == "cpu":  # on a GPU, the check would make the host wait
            assert scene.references is not None
            assert parameters.reference is not None
            lines = scene.references.shape[2]
            index = torch.where(scene.agent_mask[:, None], parameters.reference, 0)
            if (scene.agent_mask[:, None] & ((index < 0) | (index >= lines))).any():
                raise ValueError(
                    f"parameters.reference must be indices 0 .. {lines - 1} of the R = {lines} lines of scene.references"
                )
        if (self.needs_reach or self.needs_shape) and scene.size is None:
            what = "sizes" if self.needs_shape else "radii"
            raise ValueError(f"pair features take the agents' {what} from scene.size [B, N, 2], which is None")

    def finite(self, scene: Scene, parameters: GameParameters) -> Bool[Tensor, "B M"]:
        """Mask of the games whose inputs are finite.

        It checks only inputs whose NaN or infinity may have no effect on the solution: weights of pairs that never touch,
        positions of agents that no feature uses, and points of reference lines that are never the nearest.
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
        if "reference" in self.needs:
            line = self.surroundings(scene, parameters).line
            assert line is not None
            of_modes = of_modes & torch.where(present[:, None, :, None, None], line, 0.0).isfinite().flatten(2).all(2)
        return of_modes

    # The methods below return the inputs of the residuals; solvers use them as well. They set absent agents to zero.

    def surroundings(self, scene: Scene, parameters: GameParameters) -> Surroundings:
        """The inputs of own features besides the trajectory."""
        present, needs = scene.agent_mask, self.needs
        goals = line = reference_speed = wheelbase = None
        if "goals" in needs:
            assert parameters.goals is not None
            goals = torch.where(present[:, None, :, None], parameters.goals, 0.0)
        if "reference" in needs:
            assert scene.references is not None
            followed, on_line = self._followed(scene, parameters)
            line = torch.where(on_line[..., None, None], scene.references[followed], 0.0)
        if "reference_speed" in needs:
            assert scene.reference_speed is not None
            reference_speed = torch.where(present, scene.reference_speed, 0.0)[:, None]
        if "size" in needs:
            wheelbase = WHEELBASE * self.size(scene)[:, None, :, 0]
        return Surroundings(self.initial(scene), scene.dt, goals, line, reference_speed, wheelbase)

    def _followed(self, scene: Scene, parameters: GameParameters) -> tuple[tuple[Tensor, ...], Bool[Tensor, "B M N"]]:
        """The indices of the followed lines in ``scene.references``, and a mask of those that exist."""
        assert scene.reference_mask is not None
        assert parameters.reference is not None
        present = scene.agent_mask[:, None]
        scenes = torch.arange(len(present), device=present.device)[:, None, None]
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

    def extent(self, scene: Scene) -> Float[Tensor, "B N"] | None:
        """Largest distance [m] at which agents affect others; None if a pair feature has no limit."""
        extents = [feature.extent for feature in self.pair_features.values()]
        finite = [extent(self.size(scene)) for extent in extents if extent is not None]
        return torch.stack(finite).amax(0) if len(finite) == len(extents) else None

    def reach(self, scene: Scene) -> Float[Tensor, "B P"]:
        """The distance [m] at which the discs of two agents touch, r_i + r_j."""
        radius = disc(self.size(scene))
        first, second = pairs(scene.agent_mask.shape[1], radius.device)
        return radius[:, first] + radius[:, second]

    def at_pair_steps(self, states: Float[Tensor, "*batch K X"]) -> Float[Tensor, "*batch L X"]:
        """The states at k = stride, 2 stride, ..., the steps at which pair features are evaluated."""
        return states[..., self.pair_stride - 1 :: self.pair_stride, :]


def _check_bounds(bounds: Any) -> None:
    """Check the bounds of signals.

    Raises:
        ConfigError: no mapping, an unknown signal, or a value that is not [lowest, highest].
    """
    signals = {feature.signal for feature in OWN_FEATURES.values() if feature.bounded}
    if not isinstance(bounds, Mapping):
        raise ConfigError(f"energy.bounds must map signals to [lowest, highest], such as vel: [0, 30], not {bounds!r}")
    for name, bound in bounds.items():
        if name not in signals:
            raise ConfigError(f"unknown signal energy.bounds.{name}: {nearest(str(name), signals)}")
        pair = list(bound) if isinstance(bound, Sequence) and not isinstance(bound, str) else []
        if len(pair) != 2 or not all(map(is_number, pair)) or not pair[0] < pair[1]:
            raise ConfigError(
                f"energy.bounds.{name} must be [lowest, highest], two numbers in rising order, not {bound!r}"
            )


def _refuse_asymmetry(name: str, feature: PairFeature) -> None:
    """Refuse a pair feature that costs the two agents of a pair different amounts: the game would have no potential.

    Raises:
        ConfigError: a feature that depends on the order of the agents, or a function that fails on trial inputs.
    """
    try:
        costs = feature.asymmetry
    except Exception as error:
        takes = (
            "states [.., K, 4] and sizes [.., 1, 2] of two agents"
            if feature.needs
            else "states [.., K, 4] of two agents"
        )
        raise ConfigError(
            f"pair feature {name!r} fails on trial inputs: {type(error).__name__}: {error}. It takes the {takes} "
            "and returns residuals [.., R]"
        ) from error
    if costs is not None:
        raise ConfigError(
            f"pair feature {name!r} is not symmetric: for two trial agents 1/2 |r|^2 is {costs[0]:.4g}, and {costs[1]:.4g} "
            "when they are swapped, so the game has no potential, and minimising the energy would not give its equilibria. "
            "Make the feature symmetric, for instance by returning the residuals of both orders. If the agents only weigh "
            "it differently (a_i E_ij with a_i > 0), keep E_ij symmetric: dividing the own terms of agent i by a_i gives "
            "the same game, and the decoded own weights can learn this"
        )
