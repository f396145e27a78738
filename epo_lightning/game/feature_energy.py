"""The paper's energy: a sum of squared, weighted, named residuals, nonlinear least squares."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.game.circles import disc, overlap, separation
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.energy import FEATURES, GRADIENT, RESIDUALS, Energy, check_names
from epo_lightning.game.features import (
    OWN_FEATURES,
    PAIR_FEATURES,
    WHEELBASE,
    OwnFeature,
    PairFeature,
    Source,
    Surroundings,
    signal,
    signal_change,
    slope,
    violation,
)
from epo_lightning.game.pairs import pair_mask, pairs
from epo_lightning.registry import ConfigError, nearest, register
from epo_lightning.scene import GameParameters, Scene


@register("energy", "features")
@dataclass(frozen=True)
class FeatureEnergy(Energy):
    """The potential of Eqs. 10 and 11, E = 1/2 sum_i |w_i c(u_i, g_i)|^2 + 1/2 sum_{i<j} |w_ij d(u_i, u_j)|^2.

    Every named feature is weighted on its own: a residual is w c, so weights enter the energy squared and their sign is of
    no consequence. Because the pair terms are symmetric, a minimiser of E is an open-loop Nash equilibrium in which agent
    i minimises its own terms plus the pair terms it takes part in (Theorem 1).

    A pair whose weight is exactly zero is no edge of the game: it costs nothing to solve, and because weights enter squared
    its weight has no gradient either. Setting weights to zero is thus how a game is told which pairs interact.

    Example::

        energy = FeatureEnergy(own=["goal", "vel", "acc", "turnr"], pair=["proximity"])
        energy(scene, parameters, controls)            # [B, M]
        energy.residuals(scene, parameters, controls)  # {"goal": [B, M, N, 2], ..., "proximity": [B, M, P, K]}

    Attributes:
        own: names out of :data:`~epo_lightning.game.features.OWN_FEATURES`, where one's own are found too
            (:func:`~epo_lightning.game.features.own_feature`).
        pair: names out of :data:`~epo_lightning.game.features.PAIR_FEATURES`. Discs have half an agent's length as radius;
            for the rows of circles see :mod:`~epo_lightning.game.circles`.
        bounds: lowest and highest value of a signal, for features whose name ends in ``b``: ``{"vel": (-0.05, 2.0)}``.
        dynamics: a :class:`~epo_lightning.game.dynamics.Unicycle`.
        pair_stride: pairs are looked at in every step (1), every second step (2), ...: k = stride, 2 stride, ...
    """

    offers = frozenset({GRADIENT, RESIDUALS, FEATURES})

    own: Sequence[str]
    pair: Sequence[str] = ("proximity",)
    bounds: Mapping[str, Sequence[float]] = field(default_factory=dict)
    dynamics: Any = field(default_factory=Unicycle)  # what else is given is refused below, with a reason
    pair_stride: int = 1

    def __post_init__(self) -> None:
        check_names("own", self.own, OWN_FEATURES, "feature")
        check_names("pair", self.pair, PAIR_FEATURES, "feature")
        if not self.own and not self.pair:
            raise ConfigError("an energy needs at least one feature")
        if not isinstance(self.dynamics, Unicycle):
            raise ConfigError(
                "named features are those of a unicycle: they go with dynamics=unicycle, not with "
                f"{type(self.dynamics).__name__}; energy=convex goes with dynamics=double_integrator"
            )
        for name, feature in self.own_features.items():
            if feature.bounded and feature.signal not in self.bounds:
                raise ConfigError(f"feature {name!r} needs energy.bounds.{feature.signal}: [lowest, highest]")
        if not isinstance(self.pair_stride, int) or self.pair_stride < 1:
            raise ConfigError(f"energy.pair_stride must be a whole number, 1 or more, not {self.pair_stride}")
        for name, pair in self.pair_features.items():
            _refuse_asymmetry(name, pair)
        signals = {feature.signal for feature in OWN_FEATURES.values() if feature.bounded}
        for name, bound in self.bounds.items():
            if name not in signals:
                raise ConfigError(f"unknown signal energy.bounds.{name}: {nearest(name, signals)}")
            if len(bound) != 2 or not bound[0] < bound[1]:
                raise ConfigError(f"energy.bounds.{name} must be [lowest, highest], not {list(bound)}")

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
        """What the own features refer to: some of ``goals``, ``reference``, ``reference_speed``, ``size``."""
        return {feature.needs for feature in self.own_features.values() if feature.needs}

    @property
    def heading(self) -> set[str]:
        """Names of the features of goals and of lines."""
        return {name for name, feature in self.own_features.items() if feature.needs in ("goals", "reference")}

    @cached_property
    def needs_goals(self) -> bool:
        """Whether a feature asks where agents are heading."""
        return "goals" in self.needs

    @cached_property
    def needs_reach(self) -> bool:
        """Whether a pair feature asks for the agents' radii."""
        return any(feature.source is Source.DISTANCE for feature in self.pair_features.values())

    @cached_property
    def needs_shape(self) -> bool:
        """Whether a pair feature asks for the agents' lengths and widths."""
        return any(feature.needs == "size" for feature in self.pair_features.values())

    def residuals(
        self, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
    ) -> dict[str, Float[Tensor, "B M _ _"]]:
        """Weighted residuals w c by feature: [B, M, N, R] for own features and [B, M, P, R] for pairs.

        R is K, K - 1 for jerk and turnacc, 2 for the goal, 2 K for the lane, the number of evaluated steps for pairs, and
        what the function returns for undeclared features. Absent agents have residuals of zero.

        Raises:
            ValueError: shapes or names of scene, parameters and controls that do not fit together.
        """
        self.validate(scene, parameters, controls)
        still = controls.new_zeros(0, *controls.shape)
        return {name: residual for name, residual, _ in self._features(scene, parameters, controls, still)}

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
        _, residuals, changes = zip(*self._features(scene, parameters, controls, directions), strict=True)
        return torch.cat([r.flatten(2) for r in residuals], -1), torch.cat([c.flatten(3) for c in changes], -1)

    def _features(
        self, scene: Scene, parameters: GameParameters, controls: Tensor, directions: Tensor
    ) -> Iterator[tuple[str, Tensor, Tensor]]:
        """Name, weighted residual and its change along every direction of one feature after the other."""
        controls = torch.where(scene.agent_mask[:, None, :, None, None], controls, 0.0)
        states = self.dynamics.rollout(self.initial(scene), controls, scene.dt)
        moved = self.dynamics.tangent(states, directions, scene.dt)
        yield from self._of_agents(scene, parameters, (states, controls), (moved, directions))
        first, second = pairs(controls.shape[2], controls.device)
        both, apart = (states[:, :, first], states[:, :, second]), (moved[:, :, :, first], moved[:, :, :, second])
        yield from self._of_pairs(scene, parameters, both, apart)

    def _of_agents(
        self, scene: Scene, parameters: GameParameters, at: tuple[Tensor, Tensor], along_: tuple[Tensor, Tensor]
    ) -> Iterator[tuple[str, Tensor, Tensor]]:
        """The own features for states and controls, and their change along changes of both."""
        around = self.surroundings(scene, parameters)
        for name, feature in self.own_features.items():
            if feature.source is Source.TRAJECTORY:
                assert feature.function is not None
                value, change = along(feature.function, at, along_)
                present = scene.agent_mask[:, None, :, None]
                value, change = torch.where(present, value, 0.0), torch.where(present, change, 0.0)
            else:
                value, steepness = self.shape(feature, signal(feature, *at, around))
                change = steepness * signal_change(feature, *at, *along_, around)
            weight = self.own_weight(scene, parameters, name)[..., None]
            yield name, weight * value, weight * change

    def _of_pairs(
        self, scene: Scene, parameters: GameParameters, both: tuple[Tensor, Tensor], apart: tuple[Tensor, Tensor]
    ) -> Iterator[tuple[str, Tensor, Tensor]]:
        """The pair features for the states of both agents, and their change along changes of both."""
        if not self.pair:
            return
        agents = scene.agent_mask.shape[1]
        first, second = pairs(agents, scene.agent_mask.device)
        both, apart = ((self.at_pair_steps(one), self.at_pair_steps(other)) for one, other in (both, apart))
        distance, normal = separation(both[0][..., :2], both[1][..., :2])
        closing = (normal * (apart[0] - apart[1])[..., :2]).sum(-1)
        for name, pair in self.pair_features.items():
            if pair.source is Source.TRAJECTORY:
                sizes = [self.size(scene)[:, None, members, None] for members in (first, second) if pair.needs]
                value, change = along(pair.function, both, apart, *sizes)
            else:
                value, steepness = self.pair_shape(pair, distance, self.reach(scene)[:, None, :, None])
                change = steepness * closing
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
        still = states.new_zeros(0, *states.shape), controls.new_zeros(0, *controls.shape)
        features = self._of_agents(scene, parameters, (states, controls), still)
        return {name: 0.5 * residual.square().sum(-1) for name, residual, _ in features}

    def pair_terms(
        self,
        scene: Scene,
        parameters: GameParameters,
        first: Float[Tensor, "B C P K 4"],
        second: Float[Tensor, "B C P K 4"],
    ) -> dict[str, Float[Tensor, "B C P"]]:
        """1/2 |w d|^2 by pair feature."""
        still = first.new_zeros(0, *first.shape)
        features = self._of_pairs(scene, parameters, (first, second), (still, still))
        return {name: 0.5 * residual.square().sum(-1) for name, residual, _ in features}

    def validate(self, scene: Scene, parameters: GameParameters, controls: Tensor) -> None:
        """Refuse tensors that do not fit together, naming the one that does not and the shape it should have.

        Raises:
            ValueError: a wrong shape, a missing weight, missing goals, references, reference speeds or sizes.
        """
        super().validate(scene, parameters, controls)
        batch, agents = scene.agent_mask.shape
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
                shape = list(given[name].shape) if isinstance(given[name], Tensor) else given[name]
                if shape not in ([batch, modes, count], [batch, 1, count]):
                    raise ValueError(f"{kind}[{name!r}] has shape {shape}; these controls take {[batch, modes, count]}")
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
        if "reference" in self.needs and controls.device.type == "cpu":  # elsewhere, looking would make the host wait
            assert scene.references is not None
            assert parameters.reference is not None
            lines = scene.references.shape[2]
            index = torch.where(scene.agent_mask[:, None], parameters.reference, 0)
            if (scene.agent_mask[:, None] & ((index < 0) | (index >= lines))).any():
                raise ValueError(
                    f"parameters.reference chooses among the R = {lines} lines of scene.references by 0 .. R-1"
                )
        if (self.needs_reach or self.needs_shape) and scene.size is None:
            what = "sizes" if self.needs_shape else "radii"
            raise ValueError(f"pair features take the agents' {what} from scene.size [B, N, 2], which is None")

    def known(self, scene: Scene, parameters: GameParameters) -> Bool[Tensor, "B M"]:
        """Whose game is all finite numbers where nothing computed from it would tell otherwise.

        A pair that never touches hides its weight, an agent that no feature places hides where it is, and a reference line
        hides all its points but the nearest.
        """
        present = scene.agent_mask
        known = torch.where(present[..., None], scene.current, 0.0).isfinite().flatten(1).all(1)
        if self.needs_shape:
            known = known & self.size(scene).isfinite().flatten(1).all(1)
        elif self.needs_reach or "size" in self.needs:
            known = known & self.size(scene)[..., 0].isfinite().all(1)
        of_modes = known[:, None].expand(-1, parameters.initial_controls.shape[1])
        for name in self.pair:
            of_modes = of_modes & self.pair_weight(scene, parameters, name).isfinite().all(-1)
        if "reference" in self.needs:
            line = self.surroundings(scene, parameters).line
            assert line is not None
            of_modes = of_modes & torch.where(present[:, None, :, None, None], line, 0.0).isfinite().flatten(2).all(2)
        return of_modes

    # What solvers share with the residuals: absent agents are silenced here, once.

    def surroundings(self, scene: Scene, parameters: GameParameters) -> Surroundings:
        """What own features refer to besides the trajectory."""
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
        """Where in ``scene.references`` the lines are that agents follow, and which of them exist."""
        assert scene.reference_mask is not None
        assert parameters.reference is not None
        present = scene.agent_mask[:, None]
        scenes = torch.arange(len(present), device=present.device)[:, None, None]
        agents = torch.arange(present.shape[2], device=present.device)
        index = scenes, agents, torch.where(present, parameters.reference, 0).long()
        return index, scene.reference_mask[index] & present

    def own_weight(self, scene: Scene, parameters: GameParameters, name: str) -> Float[Tensor, "B M N"]:
        """Weights of an own feature, zero for absent agents and where the line to follow does not exist."""
        active = scene.agent_mask[:, None]
        if OWN_FEATURES[name].source is Source.POSITION:
            _, active = self._followed(scene, parameters)
        return torch.where(active, parameters.own_weights[name], 0.0)

    def pair_weight(self, scene: Scene, parameters: GameParameters, name: str) -> Float[Tensor, "B M P"]:
        """Weights of a pair feature, zero for pairs with an absent agent."""
        return torch.where(pair_mask(scene)[:, None], parameters.pair_weights[name], 0.0)

    def extent(self, scene: Scene) -> Float[Tensor, "B N"] | None:
        """How far from their positions agents can be felt by others; None where a pair feature knows no limit."""
        extents = [feature.extent for feature in self.pair_features.values()]
        known = [extent(self.size(scene)) for extent in extents if extent is not None]
        return torch.stack(known).amax(0) if len(known) == len(extents) else None

    def reach(self, scene: Scene) -> Float[Tensor, "B P"]:
        """The distance at which the discs of two agents touch."""
        radius = disc(self.size(scene))
        first, second = pairs(scene.agent_mask.shape[1], radius.device)
        return radius[:, first] + radius[:, second]

    def at_pair_steps(self, states: Float[Tensor, "*batch K X"]) -> Float[Tensor, "*batch L X"]:
        """The steps k = stride, 2 stride, ... at which pairs are looked at."""
        return states[..., self.pair_stride - 1 :: self.pair_stride, :]

    def shape(self, feature: OwnFeature, value: Float[Tensor, "*shape"]) -> tuple[Tensor, Tensor]:
        """A declared own feature's value c(z) for its signal z, and the slope dc/dz."""
        if feature.bounded:
            lower, upper = self.bounds[feature.signal]
            return violation(value, lower, upper)
        if feature.function is not None:
            return slope(feature.function, value)
        return value, torch.ones_like(value)

    def pair_shape(self, feature: PairFeature, distance: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
        """A declared pair feature's value for a distance, and its slope."""
        if feature.function is overlap:
            return overlap(distance, reach), -(distance < reach).to(distance.dtype)
        return slope(feature.function, distance, reach)


def _refuse_asymmetry(name: str, feature: PairFeature) -> None:
    """Two agents must share a pair's cost, or the game has no potential.

    Raises:
        ConfigError: a feature that depends on the order of the agents, or a function that fails on a trial.
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
            f"pair feature {name!r} fails on a trial: {type(error).__name__}: {error}. It takes the {takes} "
            "and returns residuals [.., R]"
        ) from error
    if costs is not None:
        raise ConfigError(
            f"pair feature {name!r} is not symmetric: for some two agents 1/2 |r|^2 is {costs[0]:.4g}, and {costs[1]:.4g} "
            "when they are swapped. Then this is not a potential game: no energy of this form has its equilibria as minima. "
            "Make the feature symmetric, for instance by returning the residuals of both orders. If agents only mind it to "
            "different degrees, a_i E_ij with a_i > 0, keep E_ij symmetric: that is the same as dividing the own terms of "
            "every agent by its a_i, which decoded own weights can do already"
        )


def along(
    function: Callable[..., Tensor], at: tuple[Tensor, Tensor], directions: tuple[Tensor, Tensor], *others: Tensor
) -> tuple[Tensor, Tensor]:
    """Value of an undeclared feature, and its change along every one of D directions (their first dimension).

    What else the function takes stays as it is.
    """
    value = function(*at, *others)
    if len(directions[0]) == 0:
        return value, value.new_zeros(0, *value.shape)
    return value, torch.func.vmap(
        lambda *moved: torch.func.jvp(lambda *states: function(*states, *others), at, moved)[1]
    )(*directions)
