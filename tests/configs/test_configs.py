"""Every experiment and sweep composes and can be built, and rows of one's own can be based on any of them."""

from __future__ import annotations

import itertools
import os
import re
import shlex
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from experiment import tiny
from experiment.conftest import Epo, epo  # noqa: F401 - fixtures
from hydra.types import RunMode
from omegaconf import OmegaConf
from suites import untrained

from epo_lightning.data.datamodule import SceneDataModule
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.compose import compose, hydra, jobs, tree
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.experiment.config.sources import options_of
from epo_lightning.files import read_json
from epo_lightning.forecasters import build_forecaster
from epo_lightning.identity import identity, row_identity
from epo_lightning.schema import read
from epo_lightning.task import Task

CONF = tree() / "conf"


def names(folder: Path) -> list[str]:
    return sorted(str(file.relative_to(folder).with_suffix("")) for file in folder.rglob("*.yaml"))


@cache
def of_experiment(name: str) -> dict[str, Any]:
    """The configuration of an experiment, composed once; not to be changed."""
    return compose("train", [f"experiment={name}"])


def given(config: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The configuration; if its forecaster refines another one, with a V-LSTM that was not trained."""
    if config["forecaster"]["name"] != "refined":
        return config
    settings = read(Settings, compose("train", ["experiment=highway/v_lstm"]))
    model = assembly.describe_model(settings, assembly.build_data(config["data"]))
    frozen = str(untrained(model, folder / "frozen.ckpt"))
    return {**config, "forecaster": {**config["forecaster"], "frozen": frozen}}


@pytest.mark.parametrize("experiment", names(CONF / "experiment"))
def test_experiments_can_be_built(experiment: str, tmp_path: Path) -> None:
    settings = read(Settings, given(of_experiment(experiment), tmp_path))
    assembly.check_buildable(settings)
    assert settings.title != "untitled"
    assert settings.experiment == experiment.replace("highway/", "exid/")  # recorded with the data that it names


@pytest.mark.parametrize("data", sorted(folder.name for folder in (CONF / "experiment").iterdir()))
def test_titles_are_unique(data: str) -> None:
    rows = [name for name in names(CONF / "experiment") if name.startswith(f"{data}/")]
    configs = [of_experiment(name) for name in rows]
    titles = [(config["title"], config["data"]["name"]) for config in configs]
    assert len(set(titles)) == len(titles)


def test_the_papers_settings() -> None:
    config = compose("train", ["experiment=rpi/v_lstm_epo"])
    assert config["data"]["batch_size"] == 32
    assert config["optimizer"]["name"] == "adam"
    assert config["optimizer"]["lr"] == 5e-5
    assert {key: config["solver"][key] for key in ("steps", "step_size", "damping")} == {
        "steps": 2,
        "step_size": 0.3,
        "damping": 10.0,
    }
    assert config["backward"] == {"name": "unrolled"}
    weights = config["objective"]["weights"]
    assert {name: weights[name] for name in ("imitation", "goal", "probability")} == {
        "imitation": 1.0,
        "goal": 0.1,
        "probability": 0.1,
    }
    assert config["forecaster"]["modes"] == 2
    assert config["goal"] == "energy"


@pytest.mark.parametrize("row", ["v_lstm", "v_lstm_sc", "v_lstm_epo"])
def test_fair_twins_differ_in_the_goal_only(row: str) -> None:
    one, twin = (compose("train", [f"experiment=rpi/{row}{suffix}"]) for suffix in ("", "_goal"))
    differing = {key for key in one if one[key] != twin[key]}
    assert differing == {"goal", "title", "experiment"}
    assert twin["goal"] == "all"


@pytest.mark.parametrize("budget", names(CONF / "budget"))
@pytest.mark.parametrize("debug", [None, *names(CONF / "debug")])
def test_budgets_and_debugging_compose(budget: str, debug: str | None) -> None:
    words = ["experiment=rpi/v_lstm_epo", f"budget={budget}", *([f"debug='{debug}'"] if debug else [])]
    settings = read(Settings, compose("train", words))
    assert settings.budget.name == (f"debug_{debug}" if debug else budget)


@pytest.mark.parametrize("data", names(CONF / "data"))
def test_data_sets_can_be_built_from_their_configuration(data: str) -> None:
    built = assembly.build_data(compose("generate", [f"data={data}"])["data"])
    assert isinstance(built, SceneDataModule)


@pytest.mark.parametrize("backbone", names(CONF / "backbone"))
@pytest.mark.parametrize("forecaster", [name for name in names(CONF / "forecaster") if name != "refined"])
def test_backbones_and_forecasters_can_be_built_for_highways(backbone: str, forecaster: str) -> None:
    words = ["experiment=rpi/v_lstm", f"backbone={backbone}", f"forecaster={forecaster}"]
    words += ["energy=exid"] if forecaster.startswith("epo") else []
    words += (
        ["solver=both_sides", "backward=implicit", "forecaster.calibration=null"] if forecaster == "epo_game" else []
    )
    settings = read(Settings, compose("train", words))
    data = SimpleNamespace(task=Task(20, 0.2, shape="box", candidates=60, map=True))
    built = build_forecaster(assembly.describe_model(settings, data))
    assert (built.task.candidates, built.task.map) == (60, True)
    learned = [name for name, _ in built.named_parameters()]
    assert any(name.startswith("backbone.lanes") for name in learned) == (forecaster != "constant_velocity")
    assert any(name.startswith("goals") for name in learned) == forecaster.startswith("epo")


def test_runs_of_a_row_may_refine_different_runs() -> None:
    one, other = (
        compose("train", ["experiment=highway/v_lstm_refined", f"seed={seed}", f"forecaster.frozen=run{seed}"])
        for seed in (0, 1)
    )
    assert one["variant"] == other["variant"] == ""
    assert row_identity(one, "data") == row_identity(other, "data")
    assert identity({**one, "seed": 1}, "data") != identity(other, "data")


def representatives(listed: list[list[str]]) -> list[list[str]]:
    """Jobs of a sweep that together hold every pair of their words; of the seeds, every one once."""
    chosen, seen = [], set()
    for job in listed:
        words = [word for word in job if not word.startswith("seed=")]
        found = {*itertools.combinations(words, 2), *((word,) for word in job)}
        if not found <= seen:
            chosen.append(job)
            seen |= found
    return chosen


def test_representatives_hold_every_pair() -> None:
    grid = [[f"a={a}", f"b={b}", f"c={c}", f"seed={s}"] for a in "12" for b in "123" for c in "12" for s in "12"]
    few = representatives(grid)
    for one, other in itertools.combinations("abc", 2):
        pairs = {(job["abc".index(one)], job["abc".index(other)]) for job in grid}
        assert pairs == {(job["abc".index(one)], job["abc".index(other)]) for job in few}
    assert {job[-1] for job in few} == {"seed=1", "seed=2"}
    assert len(few) < len(grid) / 2


@cache
def counted_in_docs() -> dict[str, int]:
    """The numbers of runs in the table of docs/sweeps.md, by sweep."""
    rows = re.findall(
        r"^\| (`.+?`) \| .* \| ([\d, ]+?)(?: each)? \|$", (tree() / "docs/sweeps.md").read_text(), flags=re.MULTILINE
    )
    found: dict[str, int] = {}
    for cell, numbers in rows:
        sweeps, counts = re.findall(r"`(\w+)`", cell), [int(number) for number in numbers.split(",")]
        found.update(zip(sweeps, counts * len(sweeps) if len(counts) == 1 else counts, strict=True))
    return found


@pytest.mark.parametrize("sweep", names(tree() / "sweeps"))
@pytest.mark.parametrize("every_pair", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["ends", "pairs"])
def test_sweeps_list_their_runs(sweep: str, every_pair: bool) -> None:
    listed = jobs("train", [f"sweeps={sweep}"])
    # A search chooses its runs while it runs.
    assert len(listed) > 1 or sweep.endswith("_search")
    assert counted_in_docs()[sweep] == len(listed) or sweep.endswith("_search")
    with hydra() as instance:
        known = options_of(instance, "experiment")
    named = {word.partition("=")[2] for job in listed for word in job if word.startswith("experiment=")}
    assert named <= set(known)
    chosen = representatives(listed) if every_pair else listed[:1] + listed[-1:]
    for job in chosen or [[f"sweeps={sweep}"]]:
        settings = read(Settings, compose("train", job))
        assert settings.measures
        assert "test" not in settings.measures or not sweep.startswith("grid")


def test_the_first_table_is_small_hard_and_shows_the_remedy_first() -> None:
    configs = [compose("train", job) for job in jobs("train", ["sweeps=first_table"])]
    remedies = [
        config["objective" if config["forecaster"]["name"] == "epo" else "forecaster"].get("relaxation")
        for config in configs
    ]
    assert [config["experiment"] for config in configs][2] == "rpi/v_lstm_epo_relaxed"
    assert [bool(remedy) for remedy in remedies] == [True, True, True, False, False]
    assert all(config["data"]["split"] == "hard" and config["data"]["placements"] == 4 for config in configs)


def test_searches_learn_from_scores_and_keep_what_they_learned() -> None:
    with hydra() as instance:
        config = instance.compose_config("train", ["sweeps=rpi_search"], run_mode=RunMode.MULTIRUN)
        sweeper = config.hydra.sweeper
        assert sweeper["_target_"].endswith("OptunaSweeper")
        assert sweeper.storage == f"sqlite:///{config.hydra.sweep.dir}/study.db"
        read(Settings, compose("train", [f"experiment={sweeper.params.experiment}"]))


def test_a_budget_in_the_command_line_wins_over_the_experiment() -> None:
    config = compose("train", ["experiment=rpi/v_lstm", "budget=reduced", "optimizer.lr=0.5"])
    assert config["budget"]["name"] == "reduced"
    assert (config["optimizer"]["lr"], config["optimizer"]["schedule"]) == (0.5, "cosine")


def test_help_and_configurations_are_printed(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:  # noqa: F811
    for words, expected in (
        (["--help"], "epo train"),
        ([], "epo generate"),
        (["train", "--help"], "rpi/v_lstm_epo"),
        (["evaluate", "--help"], "split"),
        (["config", "--help"], "check"),
        (["--version"], "epo_lightning"),
        (["config", "experiment=rpi/v_lstm_epo"], "step_size: 0.3"),
        (["config", "evaluate", "run=x"], "checkpoint: best"),
        (["config", "check", "experiment=rpi/v_lstm_epo"], "is valid"),
    ):
        assert epo(*words) == 0
        assert expected in capsys.readouterr().out
    assert not list(Path.cwd().iterdir())


def test_user_configuration_folders_take_precedence() -> None:
    assert compose("train", ["data=tiny"], [str(tiny.CONF)])["data"]["name"] == "tiny"


def test_other_folders_beside_the_tree_are_not_groups() -> None:
    with hydra() as instance:
        groups = instance.config_loader.list_groups("")
        known = {folder.name for folder in CONF.iterdir() if folder.is_dir()} | {"sweeps", "hydra"}
        assert set(groups) <= known
        assert set(options_of(instance, "sweeps")) == set(names(tree() / "sweeps"))


@pytest.mark.parametrize("base", ["rpi/v_lstm_sc_relaxed", "us101/vibes_epo"])
def test_rows_of_own_can_be_based_on_any_row(base: str, tmp_path: Path) -> None:
    """Rows name their bases from the root of the tree: a relative name would be looked up beside the row of one's own."""
    for file in (CONF / "experiment").rglob("*.yaml"):
        bases = [entry for entry in OmegaConf.load(file).get("defaults", []) if isinstance(entry, str)]
        assert all(entry == "_self_" or entry.startswith("/experiment/") for entry in bases), file
    mine = tmp_path / "experiment" / "rpi" / "mine.yaml"
    mine.parent.mkdir(parents=True)
    mine.write_text(f"# @package _global_\ndefaults: [/experiment/{base}, _self_]\ntitle: mine\n")
    config = compose("train", ["experiment=rpi/mine"], [str(tmp_path)])
    assert config["title"] == "mine"
    assert row_identity({**config, "title": ""}, "") == row_identity({**of_experiment(base), "title": ""}, "")


def test_a_file_of_the_tree_is_read_again_when_it_has_changed(tmp_path: Path) -> None:
    file = tmp_path / "conf" / "experiment" / "mine.yaml"
    file.parent.mkdir(parents=True)
    for time, title in enumerate(("one", "two")):
        file.write_text(f"# @package _global_\ndefaults: [rpi/v_lstm, _self_]\ntitle: {title}\n")
        os.utime(file, (time, time))
        for seed in (1, 2):
            config = compose("train", ["experiment=mine", f"seed={seed}"], [str(tmp_path / "conf")])
            assert (config["title"], config["seed"]) == (title, seed)


def test_defaults_of_parts_may_be_replaced_by_every_budget() -> None:
    for budget in names(CONF / "budget"):
        assert compose("train", [f"budget={budget}"])["budget"]["name"] == budget


def test_the_working_folder_can_have_the_configurations(epo: Epo, tmp_path: Path) -> None:  # noqa: F811
    file = tmp_path / "sweeps" / "mine.yaml"
    file.parent.mkdir()
    file.write_text("# @package _global_\nhydra: {sweeper: {params: {experiment: rpi/const_vel}}}\n")
    data = ("data=drawn", "data.like=rpi", "data.scenes=16")
    words = ("sweep", "mine", "--config-dir=.", *data, "budget=smoke", "score=test")
    assert epo(*words) == 0
    assert (tmp_path / "runs").is_dir()
    assert epo(*words, "runs=runs") == 0
    (record,) = (tmp_path / "runs" / "sweeps").glob("mine-*/sweep.json")
    assert read_json(record)["command"].endswith("--config-dir=."), "the same command can be given again"
    row = tmp_path / "experiment" / "own.yaml"
    row.parent.mkdir()
    row.write_text("# @package _global_\ndefaults: [/experiment/rpi/const_vel@_here_]\ntitle: Own\n")
    file.write_text(file.read_text().replace("rpi/const_vel", "own"))
    assert epo(*words, "runs=own_runs") == 0
    (run,) = (tmp_path / "own_runs").rglob("run.json")
    command = shlex.split(read_json(run)["command"])
    assert command[-1] == "--config-dir=.", "the command of each of its runs as well"
    assert epo(*command[1:], "run_dir=again") == 0
    assert read_json(tmp_path / "again" / "run.json")["identity"] == read_json(run)["identity"]
    (tmp_path / "results").mkdir()
    assert epo("report", "--config-dir=.", "scenes=false", "runs=runs", "save=results/mine.json") == 0
    assert epo("report", "--config-dir=.", "results=results/mine.json") == 0
