"""The interface of energies. An energy is a sum of terms of agents and of pairs, and so the potential of a game (Eq. 7).

    E(u; o) = sum_i E_i(u_i; o) + sum_{i<j} E_ij(u_i, u_j; o)

Agent i's own objective is J_i = E_i + sum_j E_ij. Pair terms are symmetric, so a change of u_i alone changes J_i and E
by the same amount: a minimum of E is a Nash equilibrium (Theorem 1). General solvers use an energy through these terms
only. The layer knows the features of :class:`~epo_lightning.game.feature_energy.FeatureEnergy` and their derivatives.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.forecast import GameParameters
from epo_lightning.game.dynamics import Dynamics
from epo_lightning.game.pair_order import PairOrder
from epo_lightning.game.pairs import pairs
from epo_lightning.registry import ConfigError, nearest, parts
from epo_lightning.scene import Scene

GRADIENT, RESIDUALS, FEATURES, STAGES = "gradient", "residuals", "features", "stages"
"""Optional properties of an energy. GRADIENT: it can be minimised along its gradient with respect to the controls.
RESIDUALS: it is half the sum of squares of residuals. FEATURES: its residuals are named features, whose Jacobians have a
structure that the fast solver uses. STAGES: each of these features depends on one time step, a control and the state that it
leads to."""

_TABLE_ENTRIES = 2_000_000
"""Largest number of (pair of candidates, step) entries that are evaluated together, which bounds the memory."""


def check_names(
    key: str, names: Any, known: Collection[str], what: str, hint: Callable[[str], str | None] = lambda _: None
) -> None:
    """Check a list of names of terms: all are known, and no name is repeated.

    Args:
        key: key of the list in the configuration of the energy.
        names: the list.
        known: the names that there are.
        what: what the names are names of.
        hint: what to do about an unknown name, if there is more to say than the nearest known one.

    Raises:
        ConfigError: an unknown name (the message suggests the nearest known one), a repeated name, or no list.
    """
    if isinstance(names, str) or not isinstance(names, Sequence):
        raise ConfigError(
            f"energy.{key} must be a list of names, not {names!r}; on a command line, energy.{key}=[name]"
        )
    if not all(isinstance(name, str) for name in names):
        raise ConfigError(f"energy.{key} must be a list of names, not {list(names)}")
    if not set(names) <= set(known):
        parts("energy")  # loads third-party packages, which may register the missing names
    for name in names:
        if name not in known:
            raise ConfigError(f"unknown {key} {what} {name!r} in energy.{key}: {hint(name) or nearest(name, known)}")
    if len(set(names)) < len(names):
        raise ConfigError(f"energy.{key} names a {what} twice: {list(names)}")


class Energy(ABC):
    """The interface of all energies. Subclasses define the terms; this class adds them up.

    Attributes:
        offers: the properties that the energy has, of :data:`GRADIENT`, :data:`RESIDUALS`, :data:`FEATURES` and
            :data:`STAGES`.
        own, pair: names of the terms of agents (own terms) and of pairs (pair terms).
        dynamics: the map from controls to states.
    """

    offers: ClassVar[frozenset[str]] = frozenset()
    own: Sequence[str]
    pair: Sequence[str]
    dynamics: Dynamics

    @property
    def weighted(self) -> tuple[Sequence[str], Sequence[str]]:
        """Names of the own and pair terms that have a decoded weight."""
        return self.own, self.pair

    @property
    def needs(self) -> set[str]:
        """Inputs of the terms, which the scene or the decoded parameters supply.

        Some of ``goals``, ``goal_headings``, ``reference``, ``reference_speed``, ``reference_controls``, ``size``,
        ``context`` and ``order``. Sizes that only named pair features use (:mod:`~epo_lightning.game.features`) are not
        listed; ``validate`` checks that they are there. Sizes that other pair terms use are listed.
        """
        return set()

    @property
    def decoded_margins(self) -> Sequence[str]:
        """Names of the pair terms that take a decoded margin, ``parameters.margins``."""
        return ()

    @property
    def goal_terms(self) -> set[str]:
        """Names of the own terms that attract an agent to its goal or its reference line."""
        return set()

    @property
    def pair_order(self) -> PairOrder | None:
        """The meaning of the orders in ``parameters.order``; None for energies without orders."""
        return None

    @abstractmethod
    def own_terms(
        self,
        scene: Scene,
        parameters: GameParameters,
        states: Float[Tensor, "B C N K 4"],
        controls: Float[Tensor, "B C N K 2"],
    ) -> dict[str, Float[Tensor, "B C N"]]:
        """Values of the own terms E_i by name, zero for absent agents.

        ``states`` and ``controls`` hold C strategies of every agent. ``parameters`` hold C games, one for each strategy, or
        one game for all strategies.
        """

    @abstractmethod
    def pair_terms(
        self,
        scene: Scene,
        parameters: GameParameters,
        first: Float[Tensor, "B C P K 4"],
        second: Float[Tensor, "B C P K 4"],
    ) -> dict[str, Float[Tensor, "B C P"]]:
        """Values of the pair terms E_ij by name, from the states of both agents of every pair; zero if one is absent.

        A pair term must be symmetric: swapping the two agents does not change it.
        """

    def check_horizon(self, steps: int) -> None:  # noqa: B027 - most energies are defined for every horizon
        """Check that the energy is defined for controls of K = ``steps`` steps.

        Raises:
            ValueError: it is not; the message says which horizons are possible.
        """

    def validate(self, scene: Scene, parameters: GameParameters, controls: Tensor) -> None:
        """Check that scene, parameters and controls fit together.

        Raises:
            ValueError: they do not; the message names the tensor and the expected shape.
        """
        batch, agents = scene.agent_mask.shape
        if controls.dim() != 5 or controls.shape[0] != batch or controls.shape[2] != agents or controls.shape[4] != 2:
            expected = f"[{batch}, M, {agents}, K, 2]"
            raise ValueError(f"controls have shape {list(controls.shape)}; this scene takes {expected}")
        if scene.game_steps is not None and FEATURES not in self.offers:
            raise ValueError(
                f"scene.game_steps is given, but for {type(self).__name__} all games end with the last control: only "
                "energy=features has games of different lengths"
            )

    def terms(
        self, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
    ) -> dict[str, Float[Tensor, "B M _"]]:
        """The values of all terms by name: [B, M, N] for agents, [B, M, P] for pairs."""
        self.validate(scene, parameters, controls)
        controls = torch.where(scene.agent_mask[:, None, :, None, None], controls, 0.0)
        states = self.dynamics.rollout(self.current_states(scene), controls, scene.dt)
        first, second = pairs(controls.shape[2], controls.device)
        own = self.own_terms(scene, parameters, states, controls)
        pair = self.pair_terms(scene, parameters, states[:, :, first], states[:, :, second])
        # A term that is not named would be minimised, and be no part of any objective.
        for key, names, found in (("own", self.own, own), ("pair", self.pair, pair)):
            if found.keys() != set(names):
                raise ValueError(
                    f"{type(self).__name__}.{key}_terms returns {sorted(found)}, and {key} names {sorted(names)}: both must "
                    "have the same terms"
                )
        return {**own, **pair}

    def __call__(
        self, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
    ) -> Float[Tensor, "B M"]:
        """The energy E(u) of every joint strategy."""
        # Terms are added one by one, because a sum over stacked terms would round differently in batches of other sizes.
        first, *others = (term.sum(-1) for term in self.terms(scene, parameters, controls).values())
        return sum(others, first)

    def objectives(
        self, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
    ) -> Float[Tensor, "B M N"]:
        """The agents' objectives J_i: own terms plus those of the pairs that the agent is part of."""
        terms = self.terms(scene, parameters, controls)
        objective = torch.stack([terms[name] for name in self.own]).sum(0) if self.own else 0.0 * controls[..., 0, 0]
        first, second = pairs(controls.shape[2], controls.device)
        for name in self.pair:
            objective = objective.index_add(2, first, terms[name]).index_add(2, second, terms[name])
        return objective

    def tables(
        self, scene: Scene, parameters: GameParameters, candidates: Float[Tensor, "B C N K 2"]
    ) -> tuple[Float[Tensor, "B N C"], Float[Tensor, "B P C C"]]:
        """Tables of E_i for C candidate strategies of every agent, and of E_ij for every two candidates of a pair.

        Args:
            scene: the scene.
            parameters: one game, M = 1.
            candidates: controls of the candidates.

        Returns:
            E_i [B, N, C], and E_ij [B, P, C, C], whose entry (k, l) belongs to agent i's k-th and agent j's l-th candidate.
        """
        self.validate(scene, parameters, candidates)
        controls = torch.where(scene.agent_mask[:, None, :, None, None], candidates, 0.0)
        states = self.dynamics.rollout(self.current_states(scene), controls, scene.dt)
        unary = sum(self.own_terms(scene, parameters, states, controls).values())
        first, second = pairs(controls.shape[2], controls.device)
        batch, count, _, steps, _ = states.shape
        unary = states.new_zeros(batch, states.shape[2], count) if isinstance(unary, int) else unary.transpose(1, 2)
        if not self.pair or not len(first):
            return unary, states.new_zeros(batch, len(first), count, count)
        one, other = states[:, :, first], states[:, :, second]
        rows = max(1, _TABLE_ENTRIES // max(1, batch * count * len(first) * steps))
        parts = []
        for start in range(0, count, rows):
            some = one[:, start : start + rows]
            shape = (batch, some.shape[1], count, *one.shape[2:])
            left, right = some[:, :, None].expand(shape), other[:, None].expand(shape)
            terms = self.pair_terms(scene, parameters, left.flatten(1, 2), right.flatten(1, 2))
            parts.append(torch.stack(list(terms.values())).sum(0).unflatten(1, shape[1:3]))
        return unary, torch.cat(parts, 1).permute(0, 3, 1, 2)

    def current_states(self, scene: Scene) -> Float[Tensor, "B 1 N 4"]:
        """The states x_0 at t0, zero for absent agents."""
        return scene.current_or_zero[:, None]

    def size(self, scene: Scene) -> Float[Tensor, "B N 2"]:
        """The agents' lengths and widths, zero for absent agents.

        Raises:
            ValueError: the scene has no sizes.
        """
        if scene.size is None:
            raise ValueError("this energy takes the agents' sizes from scene.size [B, N, 2], which is None")
        return torch.where(scene.agent_mask[..., None], scene.size, 0.0)
