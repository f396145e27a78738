"""Minimisers over candidates: tables against energies of joint strategies, and solutions against the tables."""

from __future__ import annotations

import dataclasses
import itertools
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import yaml
from games import leaves_of, pad, random_game, random_scene, widen
from torch import Tensor

from epo_lightning import registry
from epo_lightning.forecast import GameParameters, Status
from epo_lightning.game.energy import Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene
from epo_lightning.solvers.discrete import assignments, candidates
from epo_lightning.solvers.discrete.candidates import Enumeration, SumProduct

NAN, INF = float("nan"), float("inf")
OWN = ("goal", "acc")
ENERGY = FeatureEnergy(OWN, ["proximity"])
KINDS: tuple[Callable[..., candidates.Candidates], ...] = (Enumeration, SumProduct)


def game_of(scene: Scene, count: int = 3, horizon: int = 5) -> GameParameters:
    """One game, and C candidates of every agent."""
    one = random_game(scene, 1, horizon, OWN)
    scenes, agents = scene.agent_mask.shape
    controls = torch.randn(scenes, count, agents, horizon, 2, dtype=scene.history.dtype)
    return dataclasses.replace(one, initial_controls=controls)


def played(scenes: int = 2, agents: int = 3, count: int = 3) -> tuple[Scene, GameParameters]:
    scene = random_scene(scenes, agents, size=2.0, dtype=torch.float64)
    return scene, game_of(scene, count)


def with_absent(game: GameParameters) -> GameParameters:
    """Scene and game with an absent agent whose values are nan."""
    controls = game.initial_controls
    wide = widen(dataclasses.replace(game, initial_controls=controls[:, :1]), 1)
    nothing = torch.full_like(controls[:, :, :1], NAN)
    return dataclasses.replace(wide, initial_controls=torch.cat((controls, nothing), 2))


class Given(Energy):
    """Tables that a test gives, of agents that do not move."""

    own, pair, dynamics = (), (), ENERGY.dynamics

    def __init__(self, unary: Tensor, pair: Tensor) -> None:
        self.given = unary, pair

    def own_terms(self, scene, parameters, states, controls):
        return {}

    def pair_terms(self, scene, parameters, first, second):
        return {}

    def tables(self, scene, parameters, candidates):
        return self.given


def test_tables_add_up_to_the_energy_of_every_joint_strategy():
    scene, game = played()
    scene, game = pad(scene, 1), with_absent(game)
    unary, pair = assignments.settle(*ENERGY.tables(scene, game, game.initial_controls), scene.agent_mask)
    assert (pair[:, 0] > 0).any(), "somebody touches"
    for choice in itertools.product(range(3), range(3), range(3), range(1)):
        joint = torch.stack([game.initial_controls[:, k, i] for i, k in enumerate(choice)], 1)[:, None]
        chosen = torch.tensor(choice).expand(2, 1, 4)
        torch.testing.assert_close(assignments.energies(unary, pair, chosen), ENERGY(scene, game, joint))


@pytest.mark.parametrize("kind", KINDS)
def test_modes_are_the_best_joint_strategies(kind):
    scene, game = played()
    solution = kind(candidates=3).for_modes(4)(ENERGY, scene, game)
    choices = list(itertools.product(range(3), repeat=3))
    joint = [torch.stack([game.initial_controls[:, k, i] for i, k in enumerate(choice)], 1) for choice in choices]
    energies = torch.cat([ENERGY(scene, game, controls[:, None]) for controls in joint], 1)
    lowest, order = energies.sort(1)
    torch.testing.assert_close(solution.energy, lowest[:, :4])
    for s, mode in itertools.product(range(2), range(4)):
        assert torch.equal(solution.controls[s, mode], joint[order[s, mode]][s])
    torch.testing.assert_close(
        solution.states, ENERGY.dynamics.rollout(ENERGY.current_states(scene), solution.controls, 0.1)
    )
    assert (solution.initial_energy >= solution.energy[:, :1]).all()
    assert (solution.status == Status.COMPLETED).all()
    assert solution.gradient_norm.isnan().all()
    tables = solution.tables
    assert tables is not None
    torch.testing.assert_close(tables.log_marginals.exp().sum(-1), torch.ones(2, 3, dtype=torch.float64))
    if kind is Enumeration:
        torch.testing.assert_close(tables.log_partition, (-energies).logsumexp(1))


def test_the_initial_energy_is_that_of_agents_choosing_independently():
    scene, game = played(count=4)
    solution = Enumeration(candidates=4, modes=2)(ENERGY, scene, game)
    own = dataclasses.replace(game, pair_weights={"proximity": 0.0 * game.pair_weights["proximity"]})
    alone = Enumeration(candidates=4)(ENERGY, scene, own)
    torch.testing.assert_close(solution.initial_energy, ENERGY(scene, game, alone.controls).expand(2, 2))


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_energies_states_and_densities_equal_differences(kind):
    """Finite differences along one direction of everything that the network decodes."""
    scene, game = played(scenes=1)
    solver, leaves = kind(candidates=3, modes=2), leaves_of(game)

    def value(parameters: GameParameters) -> Tensor:
        solution = solver(ENERGY, scene, parameters)
        assert solution.tables is not None
        density = solution.tables.log_partition.sum() + solution.tables.log_marginals[..., 0].sum()
        return density + solution.energy.sum() + solution.controls.square().sum() + solution.states.square().sum()

    value(leaves).backward()
    for name, leaf in (
        ("initial_controls", leaves.initial_controls),
        ("goals", leaves.goals),
        ("own_weights", leaves.own_weights["acc"]),
        ("pair_weights", leaves.pair_weights["proximity"]),
    ):
        assert leaf is not None
        direction = torch.randn_like(leaf)

        def moved(by: float, name=name, leaf=leaf, direction=direction) -> Tensor:
            other: Tensor | dict[str, Tensor] = leaf.detach() + by * direction
            if name.endswith("weights"):
                other = {**getattr(game, name), {"own_weights": "acc", "pair_weights": "proximity"}[name]: other}
            return value(dataclasses.replace(game, **{name: other}))

        slope = (moved(1e-6) - moved(-1e-6)) / 2e-6
        torch.testing.assert_close((leaf.grad * direction).sum(), slope, rtol=1e-6, atol=1e-6)
        assert leaf.grad.abs().sum() > 0


@pytest.mark.parametrize("kind", KINDS)
def test_other_scenes_and_absent_agents_do_not_change_solutions(kind):
    scene, game = played(scenes=3)
    scene = dataclasses.replace(scene, agent_mask=scene.agent_mask.clone())
    scene.agent_mask[1, 0] = False
    scene.history[1, 0] = NAN
    game.initial_controls[1, :, 0] = NAN
    solver = kind(candidates=3, modes=3, apart=0.2)
    together = solver(ENERGY, scene, game)
    leaves = leaves_of(with_absent(game))
    padded = solver(ENERGY, pad(scene, 1), leaves)
    torch.testing.assert_close(padded.controls[:, :, :3], together.controls)
    torch.testing.assert_close(padded.states[:, :, :3], together.states)
    torch.testing.assert_close(padded.energy, together.energy)
    assert (padded.controls[:, :, 3] == 0).all()
    (padded.energy.sum() + padded.tables.log_partition.sum() + padded.states.sum()).backward()
    assert leaves.initial_controls.grad.isfinite().all()
    assert all(weight.grad.isfinite().all() for weight in (*leaves.own_weights.values(), *leaves.pair_weights.values()))
    for number in range(3):
        alone = solver(ENERGY, scene[number], game[number])
        for name in ("controls", "states", "energy", "initial_energy", "status"):
            torch.testing.assert_close(getattr(alone, name), getattr(together, name)[number : number + 1])
        torch.testing.assert_close(alone.tables.log_partition, together.tables.log_partition[number : number + 1])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "broken",
    ["no number", "minus infinity", "minus infinity of a pair", "nothing fits", "a triangle of two colours"],
)
@pytest.mark.parametrize("apart", [0.0, 0.2])
def test_scenes_without_an_answer_stop_and_leave_the_others_alone(kind, broken, apart):
    scene, game = played(scenes=3)
    solver = kind(candidates=3, modes=2, apart=apart)
    unary, pair = torch.randn(3, 3, 3, dtype=torch.float64), torch.rand(3, 3, 3, 3, dtype=torch.float64)
    whole = solver(Given(unary.clone(), pair.clone()), scene, game)
    if broken == "nothing fits":
        pair[1, 0] = INF
    elif broken == "a triangle of two colours":  # every pair can differ, but not all three; messages do not notice it
        unary[1, :, 2] = INF
        pair[1] = torch.where(torch.eye(3, dtype=torch.bool), INF, pair[1])
    elif broken == "minus infinity of a pair":
        pair[1, 2, 0, 1] = -INF
    else:
        unary[1, 2, 1] = NAN if broken == "no number" else -INF
    unary.requires_grad_()
    solution = solver(Given(unary, pair), scene, game)
    assert (solution.status[1] == Status.STOPPED).all()
    assert torch.equal(solution.controls[1], game.initial_controls[1, 0].expand(2, 3, 5, 2))
    assert solution.tables.log_partition[1].isnan()
    others = [0, 2]
    assert (solution.status[others] == Status.COMPLETED).all()
    torch.testing.assert_close(solution.controls[others], whole.controls[others])
    torch.testing.assert_close(solution.energy[others], whole.energy[others])
    torch.testing.assert_close(solution.tables.log_marginals[others], whole.tables.log_marginals[others])
    solution.tables.log_partition[others].sum().backward()
    assert unary.grad.isfinite().all()


def test_agents_without_a_valid_candidate_are_named():
    scene, game = played()
    unary = torch.zeros(2, 3, 3, dtype=torch.float64)
    unary[1, 2] = INF
    with pytest.raises(ValueError, match="agent 2 of scene 1 has no valid candidate"):
        Enumeration(candidates=3)(Given(unary, torch.zeros(2, 3, 3, 3, dtype=torch.float64)), scene, game)


def test_message_passing_replaces_too_large_enumerations_with_one_warning():
    scene, game = played(1, 5, 6)
    candidates._warn_once.cache_clear()
    with pytest.warns(UserWarning, match="more than 4096"):
        many = Enumeration(candidates=6, modes=2)(ENERGY, scene, game)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Enumeration(candidates=6)(ENERGY, scene, game)
    messages = SumProduct(candidates=6, modes=2)(ENERGY, scene, game)
    assert torch.equal(many.tables.log_marginals, messages.tables.log_marginals)
    # The beam finds what all 7776 assignments hold.
    unary, pair = messages.tables.unary, messages.tables.pair
    everything = torch.tensor(list(itertools.product(range(6), repeat=5)))[None]
    lowest = assignments.energies(unary, pair, everything).sort(1).values[:, :2]
    torch.testing.assert_close(messages.energy, lowest)


def test_modes_keep_their_distance():
    scene, _ = played()
    game = game_of(scene, 4, horizon=20)
    close, wide = (Enumeration(candidates=4, modes=3, apart=apart)(ENERGY, scene, game) for apart in (0.0, 0.2))

    def nearest(solution):
        position = solution.states[..., :2]
        ways = [(position[:, i] - position[:, j]).norm(dim=-1).mean((1, 2)) for i, j in ((0, 1), (0, 2), (1, 2))]
        return torch.stack(ways).amin()

    assert nearest(wide) >= 0.2 > nearest(close)


def test_a_scene_in_another_precision_and_one_without_agents():
    scene, game = played()
    solution = Enumeration(candidates=3)(ENERGY, scene.to(torch.float32), game)
    assert solution.energy.dtype == torch.float64
    empty = Scene(history=torch.zeros(2, 0, 4, 4), dt=0.1)
    nobody = GameParameters({}, {}, torch.zeros(2, 3, 0, 5, 2))
    tables = torch.zeros(2, 0, 3), torch.zeros(2, 0, 3, 3)
    for kind in KINDS:
        solution = kind(candidates=3, modes=2)(Given(*tables), empty, nobody)
        assert (solution.energy == 0).all()
        assert (solution.tables.log_partition == 0).all()
        no_scene = kind(candidates=3)(ENERGY, scene[:0], game[:0])
        assert no_scene.controls.shape == (0, 1, 3, 5, 2)


def test_solvers_declare_numbers_of_candidates_games_and_modes():
    for kind in KINDS:
        solver = kind(candidates=5)
        assert (solver.strategies(3), solver.games(3), solver.for_modes(3).modes, solver.modes) == (5, 1, 3, 1)
        assert solver.for_test() is solver


@pytest.mark.parametrize("name", ["enumeration", "sum_product"])
def test_configuration_files_state_the_defaults(name):
    page = Path(__file__).parents[3] / "conf" / "solver" / f"{name}.yaml"
    given = yaml.safe_load(page.read_text())
    solver = registry.build("solver", given)
    assert set(given) - {"name"} == {field.name for field in dataclasses.fields(solver)} - {"modes"}
    assert solver == type(solver)(candidates=given["candidates"])


@pytest.mark.parametrize(
    ("kind", "wrong"),
    [
        (Enumeration, {"candidates": 0}),
        (Enumeration, {"modes": 0}),
        (Enumeration, {"apart": -1.0}),
        (SumProduct, {"apart": INF}),
        (SumProduct, {"iterations": 0}),
        (SumProduct, {"damping": 1.0}),
    ],
)
def test_invalid_settings_are_refused(kind, wrong):
    with pytest.raises(ConfigError, match=f"solver.{next(iter(wrong))}"):
        kind(**wrong)


def test_messages_are_updated_as_often_and_damped_as_configured():
    unary, pair = torch.randn(2, 3, 4, dtype=torch.float64), torch.randn(2, 3, 4, 4, dtype=torch.float64)
    mask = torch.ones(2, 3, dtype=torch.bool)
    found, total = SumProduct(candidates=4, iterations=2, damping=0.5).density(unary, pair, mask)
    expected = assignments.sum_product(unary, pair, mask, iterations=2, damping=0.5)
    assert torch.equal(found, expected[0])
    assert torch.equal(total, expected[1])
    for iterations, damping in ((10, 0.5), (2, 0.0)):
        assert not torch.equal(found, assignments.sum_product(unary, pair, mask, iterations, damping)[0])
