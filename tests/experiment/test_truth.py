"""Inferred costs in units of the true effort, and their scores against the true ones."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from epo_lightning.experiment import truth
from epo_lightning.experiment.score_files import keep
from epo_lightning.files import read_json, write_json
from epo_lightning.forecast import GameParameters, JointForecast
from epo_lightning.run_folder import RunFolder


def games(weight: torch.Tensor, scale: torch.Tensor, sign: float = 1.0) -> GameParameters:
    """The true RPI game in two modes, all weights of a scene multiplied by ``scale``; mode 0 has a wrong pair weight."""
    batch = len(weight)

    def own(value: float) -> torch.Tensor:
        return sign * scale[:, None, None].expand(batch, 2, 2) * math.sqrt(value)

    pair = scale[:, None] * torch.stack((weight, (2 * weight).sqrt()), 1)
    return GameParameters(
        own_weights={"acc": own(10.0), "turnr": own(10.0), "goal": own(300.0), "vel": own(30.0)},
        pair_weights={"clearance": sign * pair[..., None]},
        initial_controls=torch.zeros(batch, 2, 2, 4, 2),
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_costs_of_the_true_game_are_the_true_ones_at_any_scale_and_sign(sign: float) -> None:
    weight = torch.tensor([10.0, 40.0, 90.0], dtype=torch.double)
    found = truth.inferred_costs(games(weight, torch.tensor([0.1, 1.0, 7.0]).double(), sign), torch.ones(3).long())
    torch.testing.assert_close(found["pair"], weight)
    torch.testing.assert_close(found["goal"], torch.full((3,), 300.0).double())
    torch.testing.assert_close(found["vel"], torch.full((3,), 30.0).double())
    assert truth.compare({"true": weight, **found}) == pytest.approx(
        {"pair_error": 0.0, "goal_error": 0.0, "vel_error": 0.0, "pair_rank": 1.0}, abs=1e-12
    )


def test_costs_of_agents_with_other_weights_are_their_geometric_mean() -> None:
    """A scale by which one agent's costs are multiplied and the other one's divided is none of the game."""
    game = games(torch.tensor([10.0]).double(), torch.ones(1).double())
    goal = torch.tensor([100.0, 900.0]).double().sqrt().expand(1, 2, 2)
    found = truth.inferred_costs(
        GameParameters({**game.own_weights, "goal": goal}, game.pair_weights, game.initial_controls),
        torch.zeros(1).long(),
    )
    assert found["goal"].tolist() == pytest.approx([300.0])


def test_scores_are_medians_of_relative_errors_and_a_rank_correlation() -> None:
    true = torch.tensor([10.0, 20.0, 40.0, 80.0]).double()
    wrong = {
        "pair": torch.tensor([80.0, 40.0, 20.0, 10.0]).double(),
        "goal": torch.tensor([150.0, 300, 600, 600]).double(),
    }
    scores = truth.compare({"true": true, **wrong})
    assert scores["pair_rank"] == pytest.approx(-1.0)
    assert scores["goal_error"] == pytest.approx(0.5)
    assert scores["pair_error"] == pytest.approx(0.875)  # torch's median is the lower one of 0.5, 0.875, 1.0, 7.0
    assert "vel_error" not in scores


def test_games_without_a_pair_term_have_no_pair_cost() -> None:
    game = games(torch.tensor([10.0]).double(), torch.ones(1).double())
    alone = GameParameters(game.own_weights, {}, game.initial_controls)
    costs = truth.inferred_costs(alone, torch.zeros(1).long())
    assert set(costs) == {"goal", "vel"}
    assert set(truth.compare({"true": torch.tensor([10.0]).double(), **costs})) == {"goal_error", "vel_error"}


def test_stored_errors_of_costs_are_completed_and_never_replaced(tmp_path: Path) -> None:
    run, checkpoint = RunFolder(tmp_path), tmp_path / "best.ckpt"
    checkpoint.write_bytes(b"weights")
    scored = {"split": "test", "data_digest": "a", "checkpoint": "best", "metrics": {"minSADE": 1.0}}
    assert keep(run, {**scored, "truth": {"pair_error": 0.1}}, checkpoint) == run.metrics_file()
    assert keep(run, {**scored, "truth": {"pair_error": 0.1, "goal_error": 0.2}}, checkpoint) == run.metrics_file()
    assert read_json(run.metrics_file())["truth"] == {"pair_error": 0.1, "goal_error": 0.2}
    other = keep(run, {**scored, "truth": {"pair_error": 0.9, "goal_error": 0.2}}, checkpoint)
    assert other != run.metrics_file()
    assert read_json(run.metrics_file())["truth"]["pair_error"] == 0.1
    write_json(run.metrics_file(), {**scored, "metrics": {"minSADE": None}})  # damaged: written again
    assert keep(run, {**scored, "truth": {"pair_error": 0.1}}, checkpoint) == run.metrics_file()
    assert read_json(run.metrics_file())["metrics"] == {"minSADE": 1.0}


def test_constant_costs_have_no_rank_correlation() -> None:
    one = torch.ones(3, dtype=torch.double)
    found = truth.compare({"true": torch.arange(1.0, 4.0).double(), "pair": one, "goal": 300 * one})
    assert "pair_rank" not in found
    assert found["goal_error"] == pytest.approx(0.0)


def test_only_equal_scores_of_the_same_data_share_a_file(tmp_path: Path) -> None:
    run, checkpoint = RunFolder(tmp_path), tmp_path / "best.ckpt"
    checkpoint.write_bytes(b"weights")
    scored = {"split": "test", "data_digest": "a", "checkpoint": "best"}
    metrics = {"minSADE": 1.0, "minFDE": 2.0, "nash_gap": math.nan}
    first = keep(run, {**scored, "metrics": metrics}, checkpoint)
    assert first == run.metrics_file()
    content = first.read_bytes()
    assert keep(run, {**scored, "metrics": {**metrics, "minSADE": 1.0 + 5e-6}}, checkpoint) == first, "the last digits"
    files = [
        keep(run, {**scored, **changes}, checkpoint)
        for changes in (
            {"metrics": {**metrics, "minSADE": 1.0 + 5e-5}},
            {"metrics": metrics, "data_digest": "b"},
            {"metrics": {name: value for name, value in metrics.items() if name != "minFDE"}},
            {"metrics": {**metrics, "nash_gap": 0.0}},
        )
    ]
    assert len({first, *files}) == 5
    assert first.read_bytes() == content
    write_json(first, {**scored, "metrics": metrics, "notes": ["of an earlier version"]})
    assert keep(run, {**scored, "metrics": metrics, "notes": []}, checkpoint) == first
    assert read_json(first)["notes"] == ["of an earlier version"]
    write_json(first, {**scored, "metrics": metrics, "truth": {"pair_error": None}})  # damaged: written again
    assert keep(run, {**scored, "metrics": metrics}, checkpoint) == first
    assert "truth" not in read_json(first)


def test_scores_of_another_checkpoint_are_not_those_of_the_run_also_if_it_has_none(tmp_path: Path) -> None:
    run, checkpoint = RunFolder(tmp_path), tmp_path / "last.ckpt"
    checkpoint.write_bytes(b"weights")
    file = keep(
        run, {"split": "test", "data_digest": "a", "checkpoint": "last", "metrics": {"minSADE": 1.0}}, checkpoint
    )
    assert file.name.startswith("scores-test-last-")
    assert not run.metrics_file().exists()


def test_every_record_counts_once_with_the_weight_of_its_own_game() -> None:
    """Scenes of an executed and an alternative future, in another order than the records of the split."""
    weights = torch.tensor([10.0, 40.0, 90.0, 160.0])
    records, subset = torch.tensor([3, 3, 0, 0, 2]), torch.tensor([0, 1, 1, 0, 0])
    inferred = torch.where(subset == 0, weights[records], 1000.0).double()
    forecast = JointForecast(
        states=torch.zeros(5, 2, 2, 4, 4),
        probabilities=torch.tensor([0.25, 0.75]).expand(5, 2),
        parameters=games(inferred, torch.ones(5).double()),
    )
    scene: Any = SimpleNamespace(id=records, subset=subset)
    collected = truth.TruthTest(weights)
    for part in (slice(0, 3), slice(3, 5)):
        batch: Any = SimpleNamespace(id=scene.id[part], subset=scene.subset[part])
        collected.on_test_batch_end(scene, scene, {"forecast": forecast[part]}, batch, 0)
    found = torch.cat([batch["true"] for batch in collected._batches])
    assert found.tolist() == [160.0, 10.0, 90.0]
    assert collected.scores()["pair_error"] == pytest.approx(0.0, abs=1e-12)
    assert collected.scores()["pair_rank"] == pytest.approx(1.0)
    assert truth.TruthTest(weights).scores() == {}
