"""Hard against soft constraints in the games of real scenes: violation, cost and time.

    python -m benchmarks.hard_constraints data=ucy data.folder=data/ucy

The words choose data, as for ``epo generate``. In the scenes of the test split with the most agents (at most ``--agents``,
the focal agent and its nearest ones), every agent intends to keep its velocity; deviations of accelerations and turn rates
have a cost. Agents keep a clearance, and accelerations bounds: as soft terms of several weights, solved to the last digits
by the compiled layer, and as constraints (``solver=augmented_lagrangian``), in float64.

For each: scenes with a violation above 1 cm or 1 cm/s^2 [%], the median and the largest violation, the cost of the
deviations in the mean, and CPU milliseconds per scene. Scenes in which agents touch at t0, or for which no solution that
meets the constraints was found, are counted and left out. Nothing is written.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from benchmarks.command_line import measuring, parser_of
from benchmarks.many_agents import intentions, largest_scenes, of_agents
from benchmarks.measure import cpu_milliseconds
from epo_lightning import FeatureEnergy, GameParameters, LevenbergMarquardt, Scene, Solution
from epo_lightning.forecast import Status
from epo_lightning.game.neighbours import closest_approach
from epo_lightning.refinement.game import NOISE, track
from epo_lightning.registry import ConfigError
from epo_lightning.solvers.base import Minimiser
from epo_lightning.solvers.gauss_newton.augmented_lagrangian import AugmentedLagrangian
from epo_lightning.solvers.gauss_newton.constrained_game import ConstrainedGame

WEIGHTS = (3.0, 10.0, 30.0, 100.0)
"""Weights of the soft terms."""
BOUND = 0.5
"""Largest acceleration and deceleration [m/s^2]."""
CLEARANCE = 0.2
"""Clearance [m] beside the radii of the agents' discs."""
ENERGY = FeatureEnergy(
    own=("accref", "turnrref", "accb"),
    pair=("clearance",),
    bounds={"acc": (-BOUND, BOUND)},
    margins={"clearance": CLEARANCE},
)
SOFT = LevenbergMarquardt(steps=20, step_size=1.0, damping=1.0, adaptive=True, newton_steps=30)
HARD = AugmentedLagrangian()
NOTHING = "there is no scene whose constraints can be met; choose other data"
NOTICED = 0.01
"""Violation that counts [m, m/s^2]."""


def parameters_of(scene: Scene, weight: float) -> GameParameters:
    """The games of agents that intend to keep their velocities, with soft terms of a weight."""
    controls = track(intentions(scene), scene, ENERGY.dynamics, NOISE)
    batch, modes, agents = controls.shape[:3]
    one = controls.new_ones(batch, modes, agents)
    return GameParameters(
        own_weights={"accref": one, "turnrref": one, "accb": weight * one},
        pair_weights={"clearance": controls.new_full((batch, modes, agents * (agents - 1) // 2), weight)},
        initial_controls=controls,
        reference_controls=controls,
    )


def violation(scene: Scene, parameters: GameParameters, controls: Tensor) -> Tensor:
    """The largest violation of every scene [B]."""
    excess = ConstrainedGame(ENERGY, HARD.hard(ENERGY), scene, parameters).excess(controls)
    return torch.cat([value.flatten(1) for value in excess.values()], -1).clamp_min(0.0).amax(-1)


@torch.no_grad()
def solved(minimiser: Minimiser, scene: Scene, parameters: GameParameters) -> tuple[Solution, float]:
    """The solution, and the CPU time per scene [ms]."""
    return cpu_milliseconds(lambda: minimiser(ENERGY, scene, parameters), len(scene.history))


def report(scene: Scene) -> None:
    """Print the table of some scenes.

    Raises:
        ConfigError: there is no scene whose constraints can be met.
    """
    total = len(scene.history)
    scene = scene[(closest_approach(scene, 0.0) > CLEARANCE).all(1)]
    apart = len(scene.history)
    if not apart:
        raise ConfigError(NOTHING)
    hard, spent = solved(HARD, scene, parameters_of(scene, 1.0))
    kept = (hard.status != Status.STOPPED).all(1)
    print(f"{total} scenes, {total - apart} of which start too close, {apart - int(kept.sum())} without a solution")
    if not kept.any():
        raise ConfigError(NOTHING)
    scene, hard = scene[kept], hard[kept]
    assert hard.constraints is not None
    rounds = hard.constraints.rounds.double()
    print(f"rounds of the constrained solver: {rounds.median():.0f} in the median, {rounds.max():.0f} at most")
    print(f"{'':<12}{'above 1 cm':>12}{'median':>11}{'largest':>11}{'deviation':>11}{'ms':>9}")
    rows = [(f"soft, {weight:g}", *solved(SOFT, scene, parameters_of(scene, weight))) for weight in WEIGHTS]
    parameters = parameters_of(scene, 1.0)
    for name, found, milliseconds in (*rows, ("hard", hard, spent)):
        missing = violation(scene, parameters, found.controls)
        terms = ENERGY.terms(scene, parameters, found.controls)
        cost = sum(float(terms[own].sum()) for own in ("accref", "turnrref")) / len(scene.history)
        above = 100 * float((missing > NOTICED).double().mean())
        print(
            f"{name:<12}{above:>11.0f}%{missing.median():>11.1e}{missing.max():>11.1e}{cost:>11.3f}{milliseconds:>9.1f}"
        )


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("hard_constraints", __doc__)
    parser.add_argument("words", nargs="+", help="the data, as for `epo generate`")
    parser.add_argument("--agents", type=int, default=8, help="largest number of agents")
    parser.add_argument("--scenes", type=int, default=64, help="number of scenes")
    chosen = parser.parse_args(given)
    with measuring(parser):
        scenes, _ = largest_scenes(chosen.words, chosen.scenes)
        report(of_agents(scenes, chosen.agents).to(torch.float64))


if __name__ == "__main__":
    main()
