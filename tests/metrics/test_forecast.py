"""Metric classes: what the functions say, added up over batches, subsets and processes."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
import torch.distributed
from torch import Tensor

from epo_lightning.metrics import METRICS, ForecastMetrics, MinADE, MinFDE, MinSADE, MinSFDE, OverlapRate
from epo_lightning.metrics.functional import min_ade, min_fde, min_sade, min_sfde, overlap_rate
from epo_lightning.registry import ConfigError
from epo_lightning.scene import JointForecast, Scene

from . import reference
from .cases import Case, make_case

SUBSETS = ("executed", "alternative", "never")
DISPLACEMENTS = [(MinADE, min_ade), (MinFDE, min_fde), (MinSADE, min_sade), (MinSFDE, min_sfde)]


def big_case() -> tuple[Case, Tensor]:
    return make_case(11, scenes=23), torch.arange(23) % 2


def filled(case: Case, subset: Tensor | None, parts: list[slice], **options: object) -> dict[str, float]:
    metrics = ForecastMetrics(subsets=SUBSETS, **options)  # type: ignore[arg-type]
    for part in parts:
        metrics.update(case.forecast(initial=True)[part], case.scene(subset)[part])
    return {name: value.item() for name, value in metrics.compute().items()}


def expected_scores(case: Case, shape: str, chosen: Tensor) -> dict[str, float]:
    """Means over the chosen scenes of the slow reference."""
    values = reference.displacements(case.states, case.future, case.mask)
    overlaps = reference.overlaps(case.states, case.probabilities, case.size, case.agent_mask, shape)
    values |= {f"overlap_{name}": value for name, value in overlaps.items()}
    initial = reference.displacements(case.states + 0.1, case.future, case.mask)
    values |= {f"initial/{name}": initial[name] for name in ("minSADE", "minSFDE")}
    return {name: torch.tensor(value).double()[chosen].nanmean().item() for name, value in values.items()}


def likely_scores(case: Case) -> dict[str, float]:
    """The minSADE of the likeliest modes of all scenes, scene by scene."""
    scores: dict[str, list[float]] = {}
    for b in range(len(case.states)):
        order = sorted(range(case.states.shape[1]), key=lambda m: -case.probabilities[b, m].item())
        for k in range(1, len(order) + 1):
            states = case.states[b : b + 1, order[:k]]
            value = reference.displacements(states, case.future[b : b + 1], case.mask[b : b + 1])["minSADE"]
            scores.setdefault(f"minSADE_{k}", []).append(float(value[0]))
    return {name: torch.tensor(values).double().nanmean().item() for name, values in scores.items()}


@pytest.mark.parametrize("shape", ["disc", "box"])
def test_scores_equal_the_reference_for_all_scenes_and_every_subset(shape: str) -> None:
    case, subset = big_case()
    scores = filled(case, subset, [slice(0, 8), slice(8, 9), slice(9, 23)], shape=shape)
    expected = expected_scores(case, shape, subset >= 0) | likely_scores(case)
    for number, name in enumerate(SUBSETS[:2]):
        part = expected_scores(case, shape, subset == number)
        expected |= {f"{name}/{metric}": value for metric, value in part.items()}
    assert scores == pytest.approx(expected, abs=1e-6)
    assert scores["executed/minSADE"] != pytest.approx(scores["alternative/minSADE"], abs=1e-3)


def test_batches_do_not_matter() -> None:
    case, subset = big_case()
    whole = filled(case, subset, [slice(0, 23)])
    assert filled(case, subset, [slice(b, b + 1) for b in range(23)]) == pytest.approx(whole, abs=1e-12)


def test_subsets_need_names_and_numbers() -> None:
    case, _ = big_case()
    scores = {*METRICS, "initial/minSADE", "initial/minSFDE", *likely_scores(case)}
    assert set(filled(case, None, [slice(0, 23)])) == scores
    beyond = filled(case, torch.full((23,), 7), [slice(0, 23)])
    assert not any(name.startswith(SUBSETS) for name in beyond)


def test_initial_scores_only_where_there_are_initial_strategies() -> None:
    case, _ = big_case()
    metrics = ForecastMetrics()
    metrics.update(case.forecast(), case.scene())
    assert tuple(metrics.compute()) == (*METRICS, *likely_scores(case))


@pytest.mark.filterwarnings("ignore:.*was called before the ``update``.*")
def test_nothing_seen_is_nan() -> None:
    scores = ForecastMetrics(subsets=SUBSETS).compute()
    assert tuple(scores) == METRICS
    assert all(math.isnan(value) for value in scores.values())


def test_reset_forgets() -> None:
    case, subset = big_case()
    metrics = ForecastMetrics(subsets=SUBSETS)
    metrics.update(case.forecast(), case.scene(subset))
    first = metrics.compute()
    metrics.reset()
    metrics.update(case.forecast(), case.scene(subset))
    assert metrics.compute() == first


def test_broken_forecast_is_loud() -> None:
    case = make_case(2, scenes=4)
    states = case.states.clone()
    states[:] = torch.nan
    metrics = ForecastMetrics()
    metrics.update(JointForecast(states, case.probabilities), case.scene())
    assert all(value.isposinf() for value in metrics.compute().values())


@pytest.mark.parametrize(("metric_class", "function"), DISPLACEMENTS)
def test_displacement_class_adds_up_its_function(metric_class: type, function: object) -> None:
    case, _ = big_case()
    metric = metric_class()
    for part in (slice(0, 5), slice(5, 23)):
        metric.update(case.states[part], case.future[part], case.mask[part])
    expected = function(case.states, case.future, case.mask).nanmean()  # type: ignore[operator]
    torch.testing.assert_close(metric.compute(), expected)


@pytest.mark.parametrize("shape", ["disc", "box"])
@pytest.mark.parametrize("definition", ["jfp", "authors"])
def test_overlap_class_adds_up_its_function(definition: str, shape: str) -> None:
    case, _ = big_case()
    metric = OverlapRate(definition, shape)
    arguments = case.states, case.probabilities, case.size, case.agent_mask
    for part in (slice(0, 5), slice(5, 23)):
        metric.update(*(tensor[part] for tensor in arguments))
    torch.testing.assert_close(metric.compute(), overlap_rate(*arguments, definition, shape).nanmean())


def test_missing_parts_are_named() -> None:
    case = make_case(0)
    history = torch.zeros(3, 3, 1, 4).double()
    with pytest.raises(ValueError, match=r"Scene\.future is missing"):
        ForecastMetrics().update(case.forecast(), Scene(history, 0.1, size=case.size))
    with pytest.raises(ValueError, match=r"Scene\.size is missing"):
        ForecastMetrics().update(case.forecast(), Scene(history, 0.1, future=case.future))
    with pytest.raises(ConfigError, match="did you mean 'disc'"):
        ForecastMetrics(shape="discs")


def test_long_float32_sums_keep_their_digits() -> None:
    metric = MinADE()
    states, future = torch.full((1000, 1, 1, 1, 2), 0.1), torch.zeros(1000, 1, 1, 2)
    for _ in range(100):
        metric.update(states, future, torch.ones(1000, 1, 1, dtype=torch.bool))
    assert metric.compute().item() == pytest.approx(min_ade(states[:1], future[:1], torch.ones(1, 1, 1).bool()).item())


def evaluate_on_one_of_two(rank: int, folder: str) -> None:
    """A process that sees every other scene, and in the first one another number of batches."""
    torch.set_num_threads(1)
    torch.distributed.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=2)
    case, subset = big_case()
    metrics = ForecastMetrics(subsets=SUBSETS)
    for part in [slice(0, 4), slice(4, 10)] if rank == 0 else [slice(10, 23)]:
        metrics.update(case.forecast(initial=True)[part], case.scene(subset)[part])
    scores = {name: value.item() for name, value in metrics.compute().items()}
    torch.save(scores, Path(folder) / f"{rank}.pt")
    torch.distributed.destroy_process_group()


def test_two_processes_agree_with_one(tmp_path: Path) -> None:
    torch.multiprocessing.spawn(evaluate_on_one_of_two, (str(tmp_path),), nprocs=2)
    case, subset = big_case()
    whole = filled(case, subset, [slice(0, 23)])
    for rank in range(2):
        assert torch.load(tmp_path / f"{rank}.pt") == pytest.approx(whole, abs=1e-12)
