"""The objective, the solver and the metric of docs/extend.md, unchanged; its other examples have tests of their own."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from docs.pages import ROOT
from metrics.cases import Case, make_case
from suites import ObjectiveSuite, SolverSuite

from epo_lightning import registry
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config import compose
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.metrics import ForecastMetrics
from epo_lightning.objectives.imitation import Imitation
from epo_lightning.registry import ConfigError, parts
from epo_lightning.schema import read
from epo_lightning.solvers.base import Minimiser

PAGE = ROOT / "docs" / "extend.md"
ADDED = ("objective", "imitation_speed"), ("solver", "fixed_step"), ("metric", "heading_error")


def section(title: str) -> str:
    return PAGE.read_text().split(f"## {title}\n")[1].split("\n## ")[0]


def documented(title: str, language: str = "python") -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", section(title), re.DOTALL)


@pytest.fixture
def defined(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    """Names that the blocks define; their parts are registered as long as the test runs."""
    names: dict[str, Any] = {}
    known = {kind: set(parts(kind)) for kind, _ in ADDED}
    for title in ("An objective", "A solver", "A metric"):
        for block in documented(title):
            assert len(block.splitlines()) <= 30
            exec(compile(block, title, "exec"), names)
    new = {(kind, name) for kind in known for name in set(parts(kind)) - known[kind]}
    assert new == set(ADDED)
    yield names
    for kind, name in new:
        registry._PARTS[kind].pop(name, None)


def files(folder: Path) -> str:
    """A folder of configurations with the page's files, and that of the solver, which the page describes."""
    (objective,) = documented("An objective", "yaml")
    texts = {"objective/imitation_speed": objective, "solver/fixed_step": "# A solver.\nname: fixed_step\nsteps: 10\n"}
    for name, text in texts.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / f"{name}.yaml").write_text(text)
    return str(folder)


def build(folder: str, *words: str) -> None:
    row = ["experiment=rpi/v_lstm_epo", "data=drawn", "budget=smoke"]
    assembly.check_buildable(read(Settings, compose.compose("train", [*row, *words], [folder])))


@pytest.mark.usefixtures("defined")
class TestDocumentedObjective(ObjectiveSuite):
    weights = {"imitation": 1.0, "goal": 0.1, "probability": 0.1, "initial": 1.0}
    config = {
        "name": "imitation_speed",
        "weights": {**weights, **yaml.safe_load(documented("An objective", "yaml")[0])["weights"]},
    }


@pytest.mark.usefixtures("defined")
class TestDocumentedSolver(SolverSuite):
    config = {"name": "fixed_step"}


def test_the_documented_parts_train_a_row(defined: dict[str, Any], tmp_path: Path) -> None:
    assert issubclass(defined["ImitationSpeed"], Imitation)
    build(files(tmp_path), "objective=imitation_speed", "solver=fixed_step")


def test_a_square_before_the_mask_has_no_gradient() -> None:
    speed, future = torch.tensor([1.0, 2.0], requires_grad=True), torch.tensor([0.0, math.nan])
    for masked_first in (True, False):
        speed.grad = None
        error, observed = speed - future, torch.tensor([True, False])
        if masked_first:
            loss = torch.where(observed, error, 0.0).square().sum()
        else:
            loss = torch.where(observed, error.square(), 0.0).sum()
        loss.backward()
        assert loss.item() == 1.0
        assert speed.grad is not None
        assert speed.grad.isnan().any() == (not masked_first)


def test_a_solver_that_provides_nothing_goes_with_no_objective(
    defined: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = files(tmp_path)
    monkeypatch.setattr(defined["FixedStep"], "provides", Minimiser.provides)
    for objective in ("imitation", "contrastive", "laplace"):
        with pytest.raises(ConfigError, match="With this instead it works"):
            build(folder, "solver=fixed_step", "backward=detached", f"objective={objective}")


def slow_heading_error(case: Case) -> list[float]:
    found = []
    for states, probabilities, future, mask in zip(
        case.states, case.probabilities.tolist(), case.future.tolist(), case.mask.tolist(), strict=True
    ):
        likely = states[max(range(len(probabilities)), key=probabilities.__getitem__)].tolist()
        turns = [
            math.remainder(likely[i][k][2] - future[i][k][2], 2 * math.pi)
            for i in range(len(future))
            for k in range(len(future[i]))
            if mask[i][k]
        ]
        found.append(sum(map(abs, turns)) / len(turns) if turns else math.nan)
    return found


@pytest.mark.parametrize("seed", range(5))
def test_the_documented_metric_equals_a_slow_reference(defined: dict[str, Any], seed: int) -> None:
    case = make_case(seed, scenes=20, agents=2, steps=2)
    found = defined["heading_error"](case.forecast(), case.scene(None))
    expected = torch.tensor(slow_heading_error(case), dtype=torch.float64)
    torch.testing.assert_close(found.double(), expected, rtol=1e-6, atol=1e-6, equal_nan=True)
    broken = dataclasses.replace(case.forecast(), states=case.forecast().states * math.nan)
    assert torch.equal(defined["heading_error"](broken, case.scene(None)).isposinf(), expected.isfinite())


def test_the_documented_metric_is_computed_with_the_others(defined: dict[str, Any]) -> None:
    case, subset = make_case(3, scenes=8), torch.arange(8) % 2
    metrics = ForecastMetrics(("executed", "alternative"))
    metrics.update(case.forecast(), case.scene(subset))
    scores, expected = metrics.compute(), torch.tensor(slow_heading_error(case)).double()
    for name, chosen in (("", subset >= 0), ("executed/", subset == 0)):
        shown = f"{name}own/heading_error"
        assert f"`{shown}`" in section("A metric")
        torch.testing.assert_close(scores[shown], expected[chosen].nanmean(), rtol=1e-6, atol=1e-6)
