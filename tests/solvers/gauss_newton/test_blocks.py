"""The block factorisation against the dense matrix, column by column."""

from __future__ import annotations

import pytest
import torch
from games import ALL, BOUNDS, normal_equations, random_game, random_scene

from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.solvers.gauss_newton import blocks
from epo_lightning.solvers.gauss_newton.edges import Group
from epo_lightning.solvers.gauss_newton.expansion import expand


@pytest.mark.parametrize("integrator", ["euler", "semi_implicit", "heun"])
@pytest.mark.parametrize(("agents", "horizon"), [(1, 2), (1, 40), (2, 17), (3, 9), (6, 5), (12, 4)])
@pytest.mark.parametrize("own", [ALL, ("goal", "acc", "turnr"), ("acc", "jerk", "turnr", "turnacc")], ids=len)
def test_solutions_are_those_of_the_dense_matrix(integrator, agents, horizon, own):
    scene = random_scene(2, agents, history=2, size=2.0, dtype=torch.float64)
    parameters = random_game(scene, 1, horizon)
    energy = FeatureEnergy(own, bounds=BOUNDS, dynamics=Unicycle(integrator), pair_stride=1 + horizon % 2)
    controls = parameters.initial_controls
    damping = torch.tensor([1.0, 20.0], dtype=torch.float64)
    model = expand(energy, scene, parameters, controls, every_pair=True)
    factors, failed = blocks.factorise(model, damping, Group.whole(model.edges))
    assert not failed.any()
    # From covectors of the controls [S, N, 2, K] to those of the nodes, in the order node, component, agent, and back.
    right = torch.randn(2, agents, 2, horizon, dtype=torch.float64)
    nodes = factors.solve(model.at.to_nodes(right).permute(0, 3, 2, 1).flatten(1))
    found = model.at.to_controls(nodes.view(2, horizon, 2, agents).permute(0, 3, 2, 1))

    _, matrix = normal_equations(energy, scene, parameters, controls)
    matrix = matrix[:, 0] + damping[:, None, None] * torch.eye(matrix.shape[-1], dtype=torch.float64)
    expected = torch.linalg.solve(matrix, right.transpose(-1, -2).flatten(1))
    error = (found.transpose(-1, -2).flatten(1) - expected).abs().max() / expected.abs().max()
    assert error < 1e-9


@pytest.mark.parametrize(("steps", "agents"), [(2, 1), (3, 8), (20, 4), (40, 2), (41, 3), (80, 64)])
def test_blocks_cover_all_nodes_two_at_least_at_a_time(steps, agents):
    edges = blocks.block_bounds(steps, agents)
    assert [start for start, _ in edges] == [0] + [end for _, end in edges[:-1]]
    assert edges[-1][1] == steps
    assert all(end - start >= 2 for start, end in edges)
