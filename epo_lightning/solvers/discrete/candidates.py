"""Minimisers over finite sets: every agent has C candidates, and joint modes are the best of their C^N combinations.

JFP (Luo et al., CoRL 2022) decodes the candidates and looks at all combinations; DSDNet (Zeng et al., ECCV 2020) draws them
from a model of motion and passes messages. Energies may be anything: nothing is differentiated to find the minimum, and the
minimum is one of the candidates exactly.
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

from epo_lightning.game.energy import Energy
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import GameParameters, Scene, Solution, Status, Tables
from epo_lightning.solvers.base import TABLES, Minimiser
from epo_lightning.solvers.discrete import assignments


@dataclass(frozen=True)
class Candidates(Minimiser):
    """What minimisers over candidates share: tables of energies, the best assignments, and the density over all of them.

    ``parameters`` hold one game, and the candidates as ``initial_controls`` [B, C, N, K, 2]. Controls, states and energies
    of the modes are differentiable with respect to them and to the game; which candidates they are is not.

    Attributes:
        candidates: number C of strategies of every agent.
        apart: distance [m] that modes keep from each other where they can (:func:`~.assignments.best`); 0 for the best ones.
        modes: number M of joint modes, which the forecaster knows.
    """

    provides = frozenset({TABLES})

    candidates: int = 6
    apart: float = 0.0
    modes: int = 1

    def __post_init__(self) -> None:
        for name in ("candidates", "modes"):
            if getattr(self, name) < 1:
                raise ConfigError(f"solver.{name} must be 1 or more, not {getattr(self, name)}")
        if not 0 <= self.apart < float("inf"):
            raise ConfigError(f"solver.apart must be 0 or more metres, and finite, not {self.apart}")

    def for_modes(self, modes: int) -> Candidates:
        """The same for M joint modes."""
        return dataclasses.replace(self, modes=modes)

    def starts(self, modes: int) -> int:
        """C, however many modes."""
        return self.candidates

    def games(self, modes: int) -> int:
        """One: the modes are different answers to one game."""
        return 1

    @abstractmethod
    def density(
        self, unary: Float[Tensor, "B N C"], pair: Float[Tensor, "B P C C"], mask: Bool[Tensor, "B N"]
    ) -> tuple[Float[Tensor, "B N C"], Float[Tensor, " B"]]:
        """log p(k_i) and log Z of the tables."""

    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """Choose the M best joint assignments.

        A scene whose tables hold what is no number, or in which no joint assignment is possible (or found), is STOPPED: all
        its modes are everyone's first candidate, and its density is not a number.

        Raises:
            ValueError: scene and parameters do not fit together, or (on a CPU) an agent has no valid candidate.
        """
        start, mask = parameters.initial_controls, scene.agent_mask
        if scene.history.dtype != start.dtype:
            scene = scene.to(start.dtype)
        raw = energy.tables(scene, parameters, start)
        controls = torch.where(mask[:, None, :, None, None], start, 0.0)
        states = energy.dynamics.rollout(energy.initial(scene), controls, scene.dt)

        unary, pair = assignments.settle(*raw, mask)
        sound = (unary > -torch.inf).flatten(1).all(1) & (pair > -torch.inf).flatten(1).all(1)
        known = torch.where(sound[:, None, None], unary, 0.0), torch.where(sound[:, None, None, None], pair, 0.0)
        if unary.device.type == "cpu":  # elsewhere, looking would make the host wait
            _check(known[0])
        log_marginals, log_partition = self.density(*known, mask)
        chosen, lowest = assignments.best(*known, mask, self.modes, states, self.apart)
        sound = sound & (log_partition > -torch.inf) & (lowest[:, 0] < torch.inf)
        chosen = torch.where(sound[:, None, None], chosen, 0)
        alone = unary.detach().argmin(2)[:, None]  # everyone's cheapest, whatever the others do
        alone = torch.where(sound[:, None, None], alone, 0)
        found = assignments.energies(unary, pair, chosen)
        return Solution(
            controls=_choose(controls, chosen),
            states=_choose(states, chosen),
            initial_energy=assignments.energies(unary, pair, alone).expand_as(found),
            energy=found,
            gradient_norm=torch.full_like(found, torch.nan),
            status=torch.where(sound, Status.SOLVED, Status.STOPPED)[:, None].expand(found.shape),
            tables=Tables(
                states=states,
                unary=unary,
                pair=pair,
                log_marginals=torch.where(sound[:, None, None], log_marginals, torch.nan),
                log_partition=torch.where(sound, log_partition, torch.nan),
            ),
            assignment=chosen,
        )


@register("solver", "enumeration")
@dataclass(frozen=True)
class Enumeration(Candidates):
    """All joint assignments are looked at: exact, up to C^N = 4096, as 6 candidates of 4 agents stay well below.

    Where there are more, messages take its place (:class:`SumProduct` with its defaults), which a warning says once. Agents
    count by what a batch is padded to.
    """

    def density(
        self, unary: Float[Tensor, "B N C"], pair: Float[Tensor, "B P C C"], mask: Bool[Tensor, "B N"]
    ) -> tuple[Float[Tensor, "B N C"], Float[Tensor, " B"]]:
        _, agents, candidates = unary.shape
        if not assignments.enumerable(agents, candidates):
            _say_once(agents, candidates)
        return assignments.partition(unary, pair, mask)


@register("solver", "sum_product")
@dataclass(frozen=True)
class SumProduct(Candidates):
    """Messages between agents (DSDNet): any number of agents and candidates, marginals and log Z approximate.

    Modes are exact as long as all assignments can be looked at, and found by a beam search where they cannot.

    Attributes:
        iterations: how often everyone sends its messages.
        damping: the share of the message before in every new one, 0 <= damping < 1; for hard pair energies.
    """

    iterations: int = 10
    damping: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.iterations < 1:
            raise ConfigError(f"solver.iterations must be 1 or more, not {self.iterations}")
        if not 0 <= self.damping < 1:
            raise ConfigError(f"solver.damping must be in [0, 1), not {self.damping}")

    def density(
        self, unary: Float[Tensor, "B N C"], pair: Float[Tensor, "B P C C"], mask: Bool[Tensor, "B N"]
    ) -> tuple[Float[Tensor, "B N C"], Float[Tensor, " B"]]:
        return assignments.sum_product(unary, pair, mask, self.iterations, self.damping)


def _choose(of_candidates: Float[Tensor, "B C N K X"], chosen: Int[Tensor, "B M N"]) -> Float[Tensor, "B M N K X"]:
    """What belongs to the candidates that agents take in every mode."""
    index = chosen[..., None, None].expand(-1, -1, -1, *of_candidates.shape[3:])
    return of_candidates.gather(1, index)


def _check(unary: Float[Tensor, "B N C"]) -> None:
    """Refuse scenes in which somebody can do nothing.

    Raises:
        ValueError: as said.
    """
    stuck = ~unary.isfinite().any(2)
    if stuck.any():
        scene, agent = stuck.nonzero()[0].tolist()
        raise ValueError(
            f"agent {agent} of scene {scene} has no valid candidate: the energies of all {unary.shape[2]} are infinite; "
            "give every agent a candidate that the energy allows"
        )


@cache
def _say_once(agents: int, candidates: int) -> None:
    """Make it visible that an approximation takes the place of what was asked for."""
    warnings.warn(
        f"{candidates} candidates of {agents} agents make more than {assignments.LIMIT} joint assignments: marginals and "
        "log Z come from ten rounds of messages and modes from a beam search; solver=sum_product asks for that",
        stacklevel=4,
    )
