"""Metric classes: values of the functional metrics, accumulated over batches, subsets and processes."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import jaxtyping
import pytest
import torch
import torch.distributed
from torch import Tensor

from epo_lightning.forecast import JointForecast
from epo_lightning.metrics import METRICS, ForecastMetrics
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene

from . import reference
from .cases import Case, make_case

SUBSETS = ("executed", "alternative", "never")


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


def probability_scores(case: Case, chosen: Tensor) -> dict[str, float]:
    """Scores of the probabilities of the chosen scenes, scene by scene."""
    brier = torch.tensor(reference.brier(case)).double()[chosen].nanmean().item()
    return {"brier_minSADE": brier, "ECE": reference.calibration_error(case, chosen.nonzero()[:, 0].tolist())}


def collapse_scores(case: Case, chosen: Tensor) -> dict[str, float]:
    """Share of the chosen scenes without a mode within 0.25 m, and the minSADE of the likeliest mode."""
    parts = [
        dataclasses.replace(case, **{k: v[[b]] for k, v in vars(case).items()}) for b in chosen.nonzero()[:, 0].tolist()
    ]
    best = [reference.displacements(part.states, part.future, part.mask)["minSADE"][0] for part in parts]
    known = [value for value in best if not math.isnan(value)]
    likeliest = torch.tensor([likely_scores(part)["minSADE_1"] for part in parts])
    return {"missed": sum(value > 0.25 for value in known) / len(known), "minSADE_1": likeliest.nanmean().item()}


@pytest.mark.parametrize("shape", ["disc", "box"])
def test_scores_equal_the_reference_for_all_scenes_and_every_subset(shape: str) -> None:
    case, subset = big_case()
    scores = filled(case, subset, [slice(0, 8), slice(8, 9), slice(9, 23)], shape=shape)
    expected = expected_scores(case, shape, subset >= 0) | likely_scores(case) | probability_scores(case, subset >= 0)
    for number, name in enumerate(SUBSETS[:2]):
        chosen = subset == number
        part = expected_scores(case, shape, chosen) | probability_scores(case, chosen) | collapse_scores(case, chosen)
        expected |= {f"{name}/{metric}": value for metric, value in part.items()}
    assert scores == pytest.approx(expected, abs=1e-6)
    assert scores["executed/minSADE"] != pytest.approx(scores["alternative/minSADE"], abs=1e-3)


def test_scores_do_not_depend_on_the_batch_size() -> None:
    case, subset = big_case()
    whole = filled(case, subset, [slice(0, 23)])
    assert filled(case, subset, [slice(b, b + 1) for b in range(23)]) == pytest.approx(whole, abs=1e-12)


def test_subsets_need_names_and_numbers() -> None:
    case, _ = big_case()
    scores = {*METRICS, "initial/minSADE", "initial/minSFDE", *likely_scores(case), "brier_minSADE", "ECE"}
    assert set(filled(case, None, [slice(0, 23)])) == scores
    beyond = filled(case, torch.full((23,), 7), [slice(0, 23)])
    assert not any(name.startswith(SUBSETS) for name in beyond)


def test_initial_scores_exist_only_with_initial_strategies() -> None:
    case, _ = big_case()
    metrics = ForecastMetrics()
    metrics.update(case.forecast(), case.scene())
    assert tuple(metrics.compute()) == (*METRICS, *likely_scores(case), "brier_minSADE", "ECE")


@pytest.mark.filterwarnings("ignore:.*was called before the ``update``.*")
def test_scores_without_scenes_are_nan() -> None:
    scores = ForecastMetrics(subsets=SUBSETS).compute()
    assert tuple(scores) == METRICS
    assert all(math.isnan(value) for value in scores.values())


def test_reset_clears_the_state() -> None:
    case, subset = big_case()
    metrics = ForecastMetrics(subsets=SUBSETS)
    metrics.update(case.forecast(), case.scene(subset))
    first = metrics.compute()
    metrics.reset()
    metrics.update(case.forecast(), case.scene(subset))
    assert metrics.compute() == first


def test_a_nan_forecast_has_infinite_scores() -> None:
    case = make_case(2, scenes=4)
    states = case.states.clone()
    states[:] = torch.nan
    metrics = ForecastMetrics()
    metrics.update(JointForecast(states, case.probabilities), case.scene())
    assert all(value.isposinf() for value in metrics.compute().values())


def test_broken_probabilities_do_not_enter_the_calibration() -> None:
    """A scene whose probabilities are not numbers makes no statement: the calibration error is that of the other scenes."""
    case, _ = big_case()
    broken = dataclasses.replace(case.forecast(), probabilities=case.probabilities.clone())
    broken.probabilities[3] = torch.nan
    broken.probabilities[8, 0] = torch.nan
    scores = []
    for forecast, scenes in ((broken, range(23)), (case.forecast(), [i for i in range(23) if i not in (3, 8)])):
        metrics = ForecastMetrics()
        for i in scenes:
            metrics.update(forecast[i : i + 1], case.scene()[i : i + 1])
        scores.append(float(metrics.compute()["ECE"]))
    assert scores[0] == pytest.approx(scores[1], abs=1e-12)


def test_absent_agents_do_not_count() -> None:
    """Absent agents are ignored for any values in the forecast, the future, its mask and the sizes."""
    case, subset = big_case()
    present, observed = torch.rand(case.agent_mask.shape) < 0.7, torch.ones_like(case.mask)
    case = dataclasses.replace(
        case, future=5.0 * torch.rand_like(case.future), states=5.0 * torch.rand_like(case.states)
    )
    scores = []
    for filling in (0.0, 1e6, math.nan):
        states, future, size = (tensor.clone() for tensor in (case.states, case.future, case.size))
        states.movedim(2, 1)[~present] = filling
        future[~present] = filling
        size[~present] = filling
        metrics = ForecastMetrics(subsets=SUBSETS)
        scene = Scene(case.future[:, :, :1], 0.1, future=future, future_mask=observed, size=size, agent_mask=present)
        metrics.update(JointForecast(states, case.probabilities), dataclasses.replace(scene, subset=subset))
        scores.append({name: value.item() for name, value in metrics.compute().items()})
    assert scores[1] == scores[0]
    assert scores[2] == scores[0]
    alone = dataclasses.replace(case, mask=observed & present[..., None], agent_mask=present)
    expected = expected_scores(alone, "disc", subset >= 0)
    assert {name: scores[0][name] for name in METRICS} == pytest.approx({n: expected[n] for n in METRICS}, abs=1e-6)


def test_missing_parts_are_named() -> None:
    case = make_case(0)
    history = torch.zeros(3, 3, 1, 4).double()
    with pytest.raises(ValueError, match=r"scene\.future .* is None"):
        ForecastMetrics().update(case.forecast(), Scene(history, 0.1, size=case.size))
    with pytest.raises(ValueError, match=r"scene\.size .* is None"):
        ForecastMetrics().update(case.forecast(), Scene(history, 0.1, future=case.future))
    with pytest.raises(ConfigError, match="did you mean 'disc'"):
        ForecastMetrics(shape="discs")


def test_positions_without_headings_and_probabilities_of_another_sum_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # the tests' own checks would come first
    case = make_case(0)
    forecast, metrics = case.forecast(), ForecastMetrics(shape="box")
    with pytest.raises(ValueError, match=r"forecast\.states has shape \[.*, 2\]; it takes \[B, M, N, K, 4\]"):
        metrics.update(dataclasses.replace(forecast, states=forecast.states[..., :2]), case.scene())
    below = torch.zeros_like(case.probabilities)
    below[:, :2] = torch.tensor([1.5, -0.5])
    for wrong in (2 * case.probabilities, below):
        with pytest.raises(ValueError, match=r"forecast\.probabilities .* must be 0 or more and sum to one"):
            metrics.update(dataclasses.replace(forecast, probabilities=wrong), case.scene())
    with pytest.raises(ValueError, match=r"forecast\.probabilities has shape \[3, 1\]; these states take \[3, 2\]"):
        metrics.update(dataclasses.replace(forecast, probabilities=case.probabilities[:, :1]), case.scene())


def test_long_float32_sums_keep_their_digits() -> None:
    """A float32 sum of 60 000 equal errors drifts away from 60 000 times the error."""
    metrics = ForecastMetrics()
    truth = torch.zeros(600, 1, 1, 4)
    scene = Scene(truth, 0.1, future=truth, size=torch.ones(600, 1, 2))
    states = truth[:, None].clone()
    states[..., 0] = 0.1
    for _ in range(100):
        metrics.update(JointForecast(states, torch.ones(600, 1)), scene)
    assert metrics.compute()["minADE"].item() == pytest.approx(float(torch.tensor(0.1)), abs=1e-12)


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
    # Forked processes need not import PyTorch again.
    torch.multiprocessing.start_processes(evaluate_on_one_of_two, (str(tmp_path),), nprocs=2, start_method="fork")
    case, subset = big_case()
    whole = filled(case, subset, [slice(0, 23)])
    for rank in range(2):
        assert torch.load(tmp_path / f"{rank}.pt") == pytest.approx(whole, abs=1e-12)
