"""Gates in scenes of many agents: cost and accuracy of games of which only chosen pairs interact.

    python -m benchmarks.many_agents data=highway_sim_dense data.recordings=1 data.minutes=5 data.windows.agents=64 \\
        data.windows.least_agents=12 data.windows.radius=null data.windows.lane_change=false data.windows.complete=false \\
        data.windows.every=10

The words choose data, as for ``epo generate``. Of the scenes of the test split with the most agents, each of N agents is
made of the focal agent and its N - 1 nearest neighbours. The game is the one of a refinement: every agent intends to keep
its velocity, a deviation has a cost, and bodies do not overlap and keep a headway (vehicles) or a clearance (discs). It is
solved by the steps of a refinement with all pairs and with those that each gate chooses.

For each: pairs per agent; the largest group of agents that chosen pairs connect; CPU times per scene in milliseconds of
decoding five modes' pair weights from features of agents, of choosing the pairs and solving the game, and of the layer in
training (two steps, forward and backward); the share of the decrease of the energy of all pairs; the mean and the largest
distance [m] to the solution with all pairs; mean displacement [m] from the recorded future; and the share of scenes with an
overlap [%]. Nothing is written.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchmarks.command_line import measuring, parser_of
from benchmarks.measure import cpu_milliseconds
from epo_lightning import FeatureEnergy, JointForecast, LevenbergMarquardt, Scene, refine
from epo_lightning.decoders.gates import Gate, NearestGate, RadiusGate
from epo_lightning.decoders.weights import PairWeights
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.compose import compose
from epo_lightning.game.neighbours import group_sizes
from epo_lightning.game.pairs import pair_mask
from epo_lightning.metrics import ForecastMetrics
from epo_lightning.metrics.functional.interaction import straight_on
from epo_lightning.refinement import SOLVER
from epo_lightning.registry import ConfigError

WIDTH, MODES = 128, 5
"""Size of the agents' features, and number of modes, of which pair weights are decoded."""
TRAINING = LevenbergMarquardt(steps=2, step_size=0.3, damping=10.0)
OWN = {"accref": 1.0, "turnrref": 20.0}
PAIR = {"box": ({"circles": 10.0, "headway": 3.0}, {"headway": 0.0}), "disc": ({"clearance": 10.0}, {"clearance": 0.2})}
"""Weights and margins [m] of the pair features, by the agents' outline."""
Row = dict[str, float]


def gates(ahead: float, seconds: Sequence[float]) -> dict[str, Gate | None]:
    """The gates that are compared, by name; None for all pairs.

    Args:
        ahead: the horizon [s].
        seconds: other times [s] within which the closest approach is looked for.
    """
    found: dict[str, Gate | None] = {
        "all": None,
        "radius 10 m": RadiusGate(10.0, None, ahead),
        "nearest 4": NearestGate(4, None, ahead),
        "nearest 8": NearestGate(8, None, ahead),
    }
    found |= {f"nearest 4 within {other:g} s": NearestGate(4, None, other) for other in seconds}
    for group in (16, 8):
        found[f"radius 10 m, group {group}"] = RadiusGate(10.0, group, ahead)
        found[f"nearest 8, group {group}"] = NearestGate(8, group, ahead)
    return found


def largest_scenes(words: Sequence[str], count: int) -> tuple[Scene, str]:
    """The scenes of the test split with the most agents, and the agents' outline.

    Raises:
        ConfigError: data that cannot be read, or without futures or sizes.
    """
    data = assembly.build_data({**compose("generate", list(words))["data"], "batch_size": 256})
    data.words = list(words)  # for the command that an error names
    data.setup("test")
    best: list[tuple[int, int, Scene]] = []
    for number, scenes in enumerate(data.test_dataloader()):
        agents = scenes.agent_mask.sum(1)
        # Scenes of one moment are alike: every tenth one is enough.
        best += [(-int(agents[row]), number * 256 + row, scenes[[row]]) for row in range(0, len(agents), 10)]
        best = sorted(best, key=lambda one: one[:2])[:count]
    chosen = [one for *_, one in best]
    if not chosen or chosen[0].future is None or chosen[0].size is None:
        raise ConfigError("the test split has no scenes with futures and sizes")
    fields = ("history", "agent_mask", "future", "future_mask", "size")
    joined: dict[str, Any] = {name: torch.cat([getattr(one, name) for one in chosen]) for name in fields}
    return Scene(**joined, dt=chosen[0].dt), data.task.shape


def of_agents(scene: Scene, agents: int) -> Scene:
    """The scene of the focal agent and its nearest neighbours, N agents together."""
    gap = (scene.current[..., :2] - scene.current[:, :1, :2]).norm(dim=-1)
    order = torch.where(scene.agent_mask, gap, torch.inf).argsort(dim=-1, stable=True)[:, :agents]
    rows = torch.arange(len(order))[:, None]
    names = ("history", "agent_mask", "future", "future_mask", "size")
    return Scene(**{name: getattr(scene, name)[rows, order] for name in names}, dt=scene.dt)


def intentions(scene: Scene) -> Tensor:
    """Futures [B, 1, N, K, 4] of agents that keep their velocities."""
    assert scene.future is not None
    current = torch.where(scene.agent_mask[..., None], scene.current, 0.0)
    time_ahead = scene.dt * torch.arange(1, scene.future.shape[2] + 1)
    return straight_on(current, time_ahead)[:, None]


def milliseconds(action: Callable[[], object], scenes: int, repeats: int) -> float:
    """Median CPU time per scene of an action on a batch."""
    times = [cpu_milliseconds(action, scenes)[1] for _ in range(repeats + 1)]
    return statistics.median(times[1:])


def measured(scene: Scene, shape: str, chosen: dict[str, Gate | None], repeats: int) -> dict[str, Row]:
    """The columns of the table for every gate."""
    pair_weights, margins = PAIR[shape]
    energy = FeatureEnergy(own=tuple(OWN), pair=tuple(pair_weights), margins=margins)
    batch, agents = scene.agent_mask.shape
    given, certain = intentions(scene), torch.ones(batch, 1)
    z = torch.randn(batch, agents, WIDTH, generator=torch.Generator().manual_seed(0))
    decoder = PairWeights(WIDTH, MODES, tuple(pair_weights)).eval()
    rows: dict[str, Row] = {}
    reference: JointForecast | None = None
    for name, gate in chosen.items():

        def weights(gate: Gate | None = gate) -> dict[str, float | Tensor]:
            if gate is None:
                return {**OWN, **pair_weights}
            mask = gate(z, scene).chosen[:, None].float()
            return {**OWN, **{pair: weight * mask for pair, weight in pair_weights.items()}}

        def solve(weights: Callable[[], dict[str, float | Tensor]] = weights) -> JointForecast:
            return refine(given, certain, scene, energy, weights(), solver=SOLVER, inverse_temperature=0.0)

        with torch.no_grad():
            mask = None if gate is None else gate(z, scene).chosen
            found = solve()
            spent = milliseconds(solve, batch, repeats)
            decoded = milliseconds(partial(decoder, z, mask), batch, repeats)
        assert found.solution is not None
        assert found.parameters is not None
        assert found.controls is not None
        leaves = found.parameters.map(lambda tensor: tensor.clone().requires_grad_())

        def train(leaves: Any = leaves) -> None:
            TRAINING(energy, scene, leaves).states.sum().backward()

        if reference is None:
            reference = found
        exists = pair_mask(scene) if mask is None else mask
        assert reference.parameters is not None
        assert reference.solution is not None
        with torch.no_grad():
            reached = energy(scene, reference.parameters, found.controls)
        first, least = reference.solution.initial_energy, reference.solution.energy
        apart = (found.states - reference.states)[..., :2].norm(dim=-1)
        apart = torch.where(scene.agent_mask[:, None, :, None], apart, 0.0)
        metrics = ForecastMetrics((), shape)
        metrics.update(found, scene)
        scores = {key: float(value) for key, value in metrics.compute().items()}
        rows[name] = {
            "pairs": 2 * float(exists.sum() / scene.agent_mask.sum()),
            "group": statistics.median(max(sizes) for sizes in group_sizes(exists, agents)),
            "decode": decoded,
            "solve": spent,
            "train": milliseconds(train, batch, repeats),
            "decrease": float((first - reached).sum() / (first - least).sum()),
            "mean": float(apart.sum() / (scene.agent_mask.sum() * apart.shape[-1])),
            "largest": float(apart.max()),
            "SADE": scores["minSADE"],
            "OR": 100 * scores["overlap_jfp"],
        }
    return rows


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("many_agents", __doc__)
    parser.add_argument("words", nargs="+", help="the data, as for `epo generate`")
    parser.add_argument("--agents", type=int, nargs="+", default=[4, 8, 16, 32, 64], help="numbers N of agents")
    parser.add_argument("--scenes", type=int, default=16, help="number of scenes")
    parser.add_argument("--repeats", type=int, default=3, help="repeats of every time, of which the median is printed")
    parser.add_argument("--ahead", type=float, nargs="*", default=[], help="other times [s] of the closest approach")
    chosen = parser.parse_args(given)
    with measuring(parser):
        scenes, shape = largest_scenes(chosen.words, chosen.scenes)
        assert scenes.future is not None
        for agents in chosen.agents:
            scene = of_agents(scenes, agents)
            present = float(scene.agent_mask.sum() / len(scene.agent_mask))
            print(f"N = {agents}: {len(scene.agent_mask)} scenes, {present:.1f} agents in the mean", flush=True)
            ahead = scene.dt * scenes.future.shape[2]
            for number, (name, row) in enumerate(
                measured(scene, shape, gates(ahead, chosen.ahead), chosen.repeats).items()
            ):
                if not number:
                    print(f"{'':<24}" + "".join(f"{column:>10}" for column in row))
                print(f"{name:<24}" + "".join(f"{value:>10.3g}" for value in row.values()), flush=True)


if __name__ == "__main__":
    main()
