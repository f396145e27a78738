"""Minimisers over finite sets: every agent has C candidates, and joint modes are the best of their C^N combinations.

JFP (Luo et al., CoRL 2022) decodes the candidates and enumerates all combinations; DSDNet (Zeng et al., ECCV 2020) samples
them from a model of motion and uses sum-product message passing. Energies need no gradient, and the minimum over the finite
set of combinations is exact (up to C^N = 4096; beyond that it is searched).
"""

from __future__ import annotations

import dataclasses
import warnings
from abc import abstractmethod
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.checks import check_number, check_whole, is_number
from epo_lightning.forecast import GameParameters, Solution, Status, Tables
from epo_lightning.game.energy import Energy
from epo_lightning.host import readable
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import Scene
from epo_lightning.solvers.base import TABLES, Minimiser
from epo_lightning.solvers.discrete import assignments


@dataclass(frozen=True)
class Candidates(Minimiser):
    """The base of minimisers over candidates: energy tables, the best assignments, and the density over all assignments.

    ``parameters`` hold one game, and the candidates as ``initial_controls`` [B, C, N, K, 2]. Controls, states and energies
    of the modes are differentiable with respect to them and to the game; the choice of candidates is not.

    Attributes:
        candidates: number C of strategies of every agent.
        apart: distance [m] between modes where possible (:func:`~epo_lightning.solvers.discrete.assignments.best`); 0 for
            the best assignments.
        detached: whether energies take the candidates as constants, so that their density teaches the energies alone and
            not the candidates.
        modes: number M of joint modes, set by the forecaster.
    """

    provides = frozenset({TABLES})

    candidates: int = 6
    apart: float = 0.0
    modes: int = 1
    detached: bool = False

    def __post_init__(self) -> None:
        for name in ("candidates", "modes"):
            check_whole(f"solver.{name}", getattr(self, name))
        check_number("solver.apart [m]", self.apart, zero=True)

    def for_modes(self, modes: int) -> Candidates:
        """This minimiser for M joint modes."""
        return dataclasses.replace(self, modes=modes)

    def strategies(self, modes: int) -> int:
        """Number C of candidates, for any number of modes."""
        return self.candidates

    def games(self, modes: int) -> int:
        """One game, of which the modes are different assignments."""
        return 1

    @abstractmethod
    def density(
        self, unary: Float[Tensor, "B N C"], pair: Float[Tensor, "B P C C"], mask: Bool[Tensor, "B N"]
    ) -> tuple[Float[Tensor, "B N C"], Float[Tensor, " B"]]:
        """log p(k_i) and log Z of the tables."""

    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """Choose the M best joint assignments.

        A scene whose tables contain NaN or minus infinity, or in which no joint assignment is possible (or found), is
        STOPPED: all its modes are the first candidates of all agents, and its density is NaN.

        Raises:
            ValueError: scene and parameters do not fit together, or (on a CPU) an agent has no valid candidate.
        """
        start, mask = parameters.initial_controls, scene.agent_mask
        if scene.history.dtype != start.dtype:
            scene = scene.to(start.dtype)
        raw = energy.tables(scene, parameters, start.detach() if self.detached else start)
        controls = torch.where(mask[:, None, :, None, None], start, 0.0)
        states = energy.dynamics.rollout(energy.current_states(scene), controls, scene.dt)

        unary, pair = assignments.settle(*raw, mask)
        valid = (unary > -torch.inf).flatten(1).all(1) & (pair > -torch.inf).flatten(1).all(1)
        known = torch.where(valid[:, None, None], unary, 0.0), torch.where(valid[:, None, None, None], pair, 0.0)
        if readable(unary):  # on other devices, the check would make the host wait
            _check(known[0])
        log_marginals, log_partition = self.density(*known, mask)
        chosen, lowest = assignments.best(*known, mask, self.modes, states, self.apart)
        solved = valid & (log_partition > -torch.inf) & (lowest[:, 0] < torch.inf)
        chosen = torch.where(solved[:, None, None], chosen, 0)
        alone = unary.detach().argmin(2)[:, None]  # every agent's cheapest candidate, without pair terms
        alone = torch.where(solved[:, None, None], alone, 0)
        found = assignments.energies(unary, pair, chosen)
        return Solution(
            controls=_choose(controls, chosen),
            states=_choose(states, chosen),
            initial_energy=assignments.energies(unary, pair, alone).expand_as(found),
            energy=found,
            gradient_norm=torch.full_like(found, torch.nan),
            status=torch.where(solved, Status.COMPLETED, Status.STOPPED)[:, None].expand(found.shape),
            tables=Tables(
                states=states,
                unary=unary,
                pair=pair,
                log_marginals=torch.where(solved[:, None, None], log_marginals, torch.nan),
                log_partition=torch.where(solved, log_partition, torch.nan),
            ),
            assignment=chosen,
        )


@register("solver", "enumeration")
@dataclass(frozen=True)
class Enumeration(Candidates):
    """Enumeration of all joint assignments: exact, for up to C^N = 4096 assignments (6 candidates of 4 agents are 1296).

    For more assignments :class:`SumProduct` with its defaults is used instead, with a warning once. N is the number of
    agents that a batch is padded to.
    """

    def density(
        self, unary: Float[Tensor, "B N C"], pair: Float[Tensor, "B P C C"], mask: Bool[Tensor, "B N"]
    ) -> tuple[Float[Tensor, "B N C"], Float[Tensor, " B"]]:
        _, agents, candidates = unary.shape
        if not assignments.enumerable(agents, candidates):
            _warn_once(agents, candidates)
        return assignments.partition(unary, pair, mask)


@register("solver", "sum_product")
@dataclass(frozen=True)
class SumProduct(Candidates):
    """Sum-product message passing between agents (DSDNet): approximate marginals and log Z for any number of agents.

    Modes are exact as long as all assignments can be enumerated, and found by a beam search otherwise.

    Attributes:
        iterations: number of message updates.
        damping: weight of the old log-message in the new one, 0 <= damping < 1; useful if pair energies are large.
    """

    iterations: int = 10
    damping: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_whole("solver.iterations", self.iterations)
        if not is_number(self.damping) or not 0 <= self.damping < 1:
            raise ConfigError(f"solver.damping must be a number in [0, 1), not {self.damping!r}")

    def density(
        self, unary: Float[Tensor, "B N C"], pair: Float[Tensor, "B P C C"], mask: Bool[Tensor, "B N"]
    ) -> tuple[Float[Tensor, "B N C"], Float[Tensor, " B"]]:
        return assignments.sum_product(unary, pair, mask, self.iterations, self.damping)


def _choose(of_candidates: Float[Tensor, "B C N K X"], chosen: Int[Tensor, "B M N"]) -> Float[Tensor, "B M N K X"]:
    """The values of the candidates that agents take in every mode."""
    index = chosen[..., None, None].expand(-1, -1, -1, *of_candidates.shape[3:])
    return of_candidates.gather(1, index)


def _check(unary: Float[Tensor, "B N C"]) -> None:
    """Check that every agent has a valid candidate.

    Raises:
        ValueError: all energies of an agent are infinite; the message names scene and agent.
    """
    stuck = ~unary.isfinite().any(2)
    if stuck.any():
        scene, agent = stuck.nonzero()[0].tolist()
        raise ValueError(
            f"agent {agent} of scene {scene} has no valid candidate: the energies of all {unary.shape[2]} are infinite; "
            "give every agent a candidate that the energy allows"
        )


@cache
def _warn_once(agents: int, candidates: int) -> None:
    """Warn that sum-product messages are used instead of enumeration."""
    warnings.warn(
        f"{candidates} candidates of {agents} agents make more than {assignments.LIMIT} joint assignments: marginals and "
        "log Z come from ten message updates and modes from a beam search; choose solver=sum_product to silence this",
        stacklevel=4,
    )
