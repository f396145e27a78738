"""Combinations of energy, minimiser, derivative and objective (the four parts of the paper's Table 1) that work together.

Every part declares what it needs of the others and what it provides. A combination that cannot work is refused before
anything runs, with the reason and the single changes that would make it work.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from epo_lightning.game.energy import FEATURES, GRADIENT, RESIDUALS, STAGES
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError, parts
from epo_lightning.solvers.base import PATH, SAMPLES, STATIONARY, STEPS, TABLES

WORDS = {
    GRADIENT: "a gradient",
    RESIDUALS: "residuals (it must be half the sum of their squares)",
    FEATURES: "named features whose structure the solver knows",
    STAGES: "features of the states or of the controls of single time steps alone, such as energy=rpi_game (no jerk or "
    "other rates, no steering)",
    PATH: "a path that can be differentiated",
    STEPS: "steps that can be interrupted and continued",
    STATIONARY: "solutions with an implicit derivative",
    SAMPLES: "samples",
    TABLES: "energies of candidates",
}
KINDS = ("energy", "solver", "backward", "objective")


@dataclass(frozen=True)
class Combination:
    """One part of each of the four kinds. An energy or objective may be a class, whose declarations are class attributes.

    What an energy of features offers and what a solver provides can depend on their settings.

    Attributes:
        names: registered names of the parts, by kind; for messages.
    """

    energy: Any
    solver: Any
    backward: Any
    objective: Any
    names: dict[str, str]

    @classmethod
    def of(cls, **chosen: Any) -> Combination:
        """Build from the four parts."""
        names = {
            kind: next((name for name, known in parts(kind).items() if type(part) is known), type(part).__name__)
            for kind, part in chosen.items()
        }
        return cls(**chosen, names=names)

    @property
    def obstacle(self) -> str | None:
        """The reason why the combination cannot work; None where it can."""
        solver, backward, objective = (f"{kind}={self.names[kind]}" for kind in KINDS[1:])
        for part, needed in (
            (solver, self.solver.needs_from_energy),
            (backward, self.backward.needs_from_energy),
            (objective, self.objective.needs_from_energy),
        ):
            if lacking := needed - self.energy.offers:  # all of them are needed
                energy = f"energy.name={self.names['energy']}"
                reason = f"{part} needs an energy with {_and(lacking)}, which {energy} does not offer"
                if STAGES in lacking and isinstance(self.energy, FeatureEnergy):
                    between = ", ".join(self.energy.between_steps)
                    reason += f": {between} may depend on several steps, or on a state and a control together"
                return reason
        for part, needed in (
            (backward, self.backward.needs_from_solver),
            (objective, self.objective.needs_from_solver),
        ):
            if needed and not needed & self.solver.provides:  # one of them is enough
                provided = _or(self.solver.provides) or _nothing()
                return f"{part} needs {_or(needed)}, and {solver} as it is set provides {provided}"
        if self.objective.through_solution and not self.backward.teaches:
            return f"{objective} learns through the solution, which has no derivative with {backward}"
        if self.backward.teaches and not self.objective.through_solution:
            return f"{objective} learns from energies, so the derivative of the solution, {backward}, would be unused"
        return None

    @property
    def neighbours(self) -> Iterator[tuple[str, Combination]]:
        """Combinations that differ in one part, each with the override that makes the change."""
        for kind in KINDS:
            for name, part in parts(kind).items():
                if name != self.names[kind]:
                    # The settings of solvers and derivatives all have defaults.
                    changed = part() if kind in ("solver", "backward") else part
                    word = f"an energy named {name}" if kind == "energy" else f"{kind}={name}"
                    yield word, replace(self, **{kind: changed}, names={**self.names, kind: name})

    def check(self) -> None:
        """Refuse a combination that cannot work.

        Raises:
            ConfigError: the reason, and the changes with which it would work; or a setting of the solver that does not
                fit the energy.
        """
        obstacle = self.obstacle
        if obstacle is None:
            self.solver.check(self.energy)
            return
        working = [word for word, other in self.neighbours if other.obstacle is None]
        if not working:
            two = {
                " with ".join(sorted((word, other))): None
                for word, one in self.neighbours
                for other, both in one.neighbours
                if both.obstacle is None
            }
            working = list(two)[:6]
        if not working:
            raise ConfigError(f"{obstacle}. More than two parts would have to change: begin with an existing row")
        alternatives = Counter(word.partition("=")[0] for word in working)
        working.sort(
            key=lambda word: alternatives[word.partition("=")[0]]
        )  # the one that is left of its kind comes first
        raise ConfigError(f"{obstacle}. With this instead it works: {', or '.join(working)}")


def _and(what: Iterable[str]) -> str:
    return " and ".join(WORDS[word] for word in sorted(what))


def _or(what: Iterable[str]) -> str:
    return " or ".join(WORDS[word] for word in sorted(what))


def _nothing() -> str:
    """Text for a solver that declares nothing in ``provides``: the declarations that derivatives need."""
    needs = {name: getattr(part, "needs_from_solver", ()) for name, part in parts("backward").items()}
    uses = [
        f"{' or '.join(sorted(map(str.upper, words)))} for backward={name}" for name, words in needs.items() if words
    ]
    return (
        "nothing, because its `provides` is empty: declare there what its solutions have "
        f"({', '.join(uses)}; from epo_lightning.solvers.base)"
    )
