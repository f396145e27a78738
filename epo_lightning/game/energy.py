"""The energy of a joint strategy: one potential for all agents, a sum of squared, weighted, named residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES, OwnFeature, proximity, signal, violation
from epo_lightning.registry import ConfigError, nearest, register
from epo_lightning.scene import GameParameters, Scene


def pairs(agents: int, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """First and second agents i < j of all P pairs, in the order of every pairwise tensor."""
    first, second = torch.triu_indices(agents, agents, 1, device=device)
    return first, second


@register("energy", "features")
@dataclass(frozen=True)
class Energy:
    """The potential of Eqs. 10 and 11, E = 1/2 sum_i |w_i c(u_i, g_i)|^2 + 1/2 sum_{i<j} |w_ij d(u_i, u_j)|^2.

    Every named feature is weighted on its own: a residual is w c, so weights enter the energy squared and their sign is of
    no consequence. Because the pair terms are symmetric, a minimiser of E is an open-loop Nash equilibrium in which agent
    i minimises its own terms plus the pair terms it takes part in (Theorem 1).

    Example::

        energy = Energy(own=["goal", "vel", "acc", "turnr"], pair=["proximity"])
        energy(scene, parameters, controls)            # [B, M]
        energy.residuals(scene, parameters, controls)  # {"goal": [B, M, N, 2], ..., "proximity": [B, M, P, K]}

    Attributes:
        own: names out of :data:`~epo_lightning.game.features.OWN_FEATURES`.
        pair: names out of :data:`~epo_lightning.game.features.PAIR_FEATURES`. Discs have half an agent's length as radius.
        bounds: lowest and highest value of a signal, for features whose name ends in ``b``: ``{"vel": (-0.05, 2.0)}``.
        dynamics: what turns controls into states.
    """

    own: Sequence[str]
    pair: Sequence[str] = ("proximity",)
    bounds: Mapping[str, Sequence[float]] = field(default_factory=dict)
    dynamics: Unicycle = field(default_factory=Unicycle)

    def __post_init__(self) -> None:
        for kind, names, known in (("own", self.own, OWN_FEATURES), ("pair", self.pair, PAIR_FEATURES)):
            if isinstance(names, str):
                raise ConfigError(f"energy.{kind} takes a list of names, not the one name {names!r}")
            for name in names:
                if name not in known:
                    raise ConfigError(f"unknown {kind} feature {name!r}: {nearest(str(name), known)}")
            if len(set(names)) < len(names):
                raise ConfigError(f"energy.{kind} names a feature twice: {list(names)}")
        if not self.own and not self.pair:
            raise ConfigError("an energy needs at least one feature")
        for name, feature in self.own_features.items():
            if feature.bounded and feature.signal not in self.bounds:
                raise ConfigError(f"feature {name!r} needs energy.bounds.{feature.signal}: [lowest, highest]")
        signals = {feature.signal for feature in OWN_FEATURES.values() if feature.bounded}
        for name, bound in self.bounds.items():
            if name not in signals:
                raise ConfigError(f"unknown signal energy.bounds.{name}: {nearest(name, signals)}")
            if len(bound) != 2 or not bound[0] < bound[1]:
                raise ConfigError(f"energy.bounds.{name} must be [lowest, highest], not {list(bound)}")

    @property
    def own_features(self) -> dict[str, OwnFeature]:
        """The own features by name."""
        return {name: OWN_FEATURES[name] for name in self.own}

    @property
    def needs_goals(self) -> bool:
        """Whether a feature asks where agents are heading."""
        return "goal" in self.own

    def residuals(
        self, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
    ) -> dict[str, Float[Tensor, "B M _ _"]]:
        """Weighted residuals w c by feature: [B, M, N, R] for own features and [B, M, P, K] for pairs.

        R is K, K - 1 for jerk and turnacc, 2 for the goal. Absent agents have residuals of zero.

        Raises:
            ValueError: shapes or names of scene, parameters and controls that do not fit together.
        """
        self.validate(scene, parameters, controls)
        controls = torch.where(scene.agent_mask[:, None, :, None, None], controls, 0.0)
        states = self.dynamics.rollout(self.initial(scene), controls, scene.dt)
        residuals = {}
        for name, feature in self.own_features.items():
            weight = self.own_weight(scene, parameters, name)
            value, _ = self.shape(feature, signal(feature, states, controls, self.goals(scene, parameters), scene.dt))
            residuals[name] = weight[..., None] * value
        for name in self.pair:
            depth, _, _ = self.closeness(scene, states)
            residuals[name] = self.pair_weight(scene, parameters, name)[..., None] * depth
        return residuals

    def linearisation(
        self,
        scene: Scene,
        parameters: GameParameters,
        controls: Float[Tensor, "B M N K 2"],
        directions: Float[Tensor, "D B M N K 2"],
    ) -> tuple[Float[Tensor, "B M R"], Float[Tensor, "D B M R"]]:
        """All residuals r in one row, and their change J v along D directions v of the controls.

        Both are differentiable with respect to controls and parameters; hinges keep their side.
        """
        controls = torch.where(scene.agent_mask[:, None, :, None, None], controls, 0.0)
        states = self.dynamics.rollout(self.initial(scene), controls, scene.dt)
        moved = self.dynamics.tangent(states, directions, scene.dt)
        goals = self.goals(scene, parameters)
        still = None if goals is None else torch.zeros_like(goals)
        residuals, changes = [], []
        for name, feature in self.own_features.items():
            weight = self.own_weight(scene, parameters, name)[..., None]
            value, slope = self.shape(feature, signal(feature, states, controls, goals, scene.dt))
            residuals.append(weight * value)
            changes.append(weight * slope * signal(feature, moved, directions, still, scene.dt))
        if self.pair:
            first, second = pairs(controls.shape[2], controls.device)
            depth, normal, active = self.closeness(scene, states)
            apart = moved[..., first, :, :2] - moved[..., second, :, :2]
            closing = -torch.where(active, (normal * apart).sum(-1), 0.0)
            for name in self.pair:
                weight = self.pair_weight(scene, parameters, name)[..., None]
                residuals.append(weight * depth)
                changes.append(weight * closing)
        return torch.cat([r.flatten(2) for r in residuals], -1), torch.cat([c.flatten(3) for c in changes], -1)

    def terms(
        self, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
    ) -> dict[str, Float[Tensor, "B M _"]]:
        """The energy by feature and agent [B, M, N], or by feature and pair [B, M, P]."""
        residuals = self.residuals(scene, parameters, controls)
        return {name: 0.5 * residual.square().sum(-1) for name, residual in residuals.items()}

    def __call__(
        self, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
    ) -> Float[Tensor, "B M"]:
        """The energy of every joint strategy."""
        return torch.stack([term.sum(-1) for term in self.terms(scene, parameters, controls).values()]).sum(0)

    def validate(self, scene: Scene, parameters: GameParameters, controls: Tensor) -> None:
        """Refuse tensors that do not fit together, naming the one that does not and the shape it should have.

        Raises:
            ValueError: a wrong shape, a missing weight, missing goals or sizes.
        """
        batch, agents = scene.agent_mask.shape
        if controls.dim() != 5 or controls.shape[0] != batch or controls.shape[2] != agents or controls.shape[4] != 2:
            expected = f"[{batch}, M, {agents}, K, 2]"
            raise ValueError(f"controls have shape {list(controls.shape)}; this scene takes {expected}")
        modes, steps = controls.shape[1], controls.shape[3]
        if steps < 2:
            raise ValueError(f"controls span K = {steps} step(s); an energy needs at least 2")
        for kind, names, given, count in (
            ("own_weights", self.own, parameters.own_weights, agents),
            ("pair_weights", self.pair, parameters.pair_weights, agents * (agents - 1) // 2),
        ):
            for name in names:
                if name not in given:
                    raise ValueError(f"{kind} lacks the feature {name!r}; it has {sorted(given)}")
                if given[name].shape != (batch, modes, count):
                    shape = list(given[name].shape)
                    raise ValueError(f"{kind}[{name!r}] has shape {shape}; these controls take {[batch, modes, count]}")
        if self.needs_goals:
            if parameters.goals is None:
                raise ValueError("the energy has the feature 'goal', but parameters.goals is None")
            if parameters.goals.shape != (batch, modes, agents, 2):
                shape = list(parameters.goals.shape)
                raise ValueError(f"goals have shape {shape}; these controls take {[batch, modes, agents, 2]}")
        if self.pair and scene.size is None:
            raise ValueError("pair features take the agents' radii from scene.size [B, N, 2], which is None")

    # What the Gauss-Newton assembly shares with the residuals: absent agents are silenced here, once.

    def initial(self, scene: Scene) -> Float[Tensor, "B 1 N 4"]:
        """The states x_0, zero for absent agents."""
        return torch.where(scene.agent_mask[..., None], scene.current, 0.0)[:, None]

    def goals(self, scene: Scene, parameters: GameParameters) -> Float[Tensor, "B M N 2"] | None:
        """Where agents are heading, zero for absent agents."""
        if parameters.goals is None:
            return None
        return torch.where(scene.agent_mask[:, None, :, None], parameters.goals, 0.0)

    def own_weight(self, scene: Scene, parameters: GameParameters, name: str) -> Float[Tensor, "B M N"]:
        """Weights of an own feature, zero for absent agents."""
        return torch.where(scene.agent_mask[:, None], parameters.own_weights[name], 0.0)

    def pair_mask(self, scene: Scene) -> Bool[Tensor, "B P"]:
        """Pairs of which both agents exist."""
        first, second = pairs(scene.agent_mask.shape[1], scene.agent_mask.device)
        return scene.agent_mask[:, first] & scene.agent_mask[:, second]

    def pair_weight(self, scene: Scene, parameters: GameParameters, name: str) -> Float[Tensor, "B M P"]:
        """Weights of a pair feature, zero for pairs with an absent agent."""
        return torch.where(self.pair_mask(scene)[:, None], parameters.pair_weights[name], 0.0)

    def shape(self, feature: OwnFeature, value: Float[Tensor, "*shape"]) -> tuple[Tensor, Tensor]:
        """A feature's value c(z) for its signal z, and the slope dc/dz."""
        if feature.bounded:
            lower, upper = self.bounds[feature.signal]
            return violation(value, lower, upper)
        return value, torch.ones_like(value)

    def closeness(self, scene: Scene, states: Float[Tensor, "B M N K 4"]) -> tuple[Tensor, Tensor, Tensor]:
        """Depth [B, M, P, K], normal [B, M, P, K, 2] and activity [B, M, P, K] of the pairs' overlaps."""
        first, second = pairs(scene.agent_mask.shape[1], states.device)
        assert scene.size is not None
        radius = torch.where(scene.agent_mask, scene.size[..., 0] / 2, 0.0)
        reach = (radius[:, first] + radius[:, second])[:, None, :, None]
        return proximity(states[:, :, first, :, :2], states[:, :, second, :, :2], reach)
