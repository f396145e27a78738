"""Records and status of sweeps, and the names of sweeps, runs, folders and titles."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from experiment.conftest import TINY, Epo
from experiment.sweeps.rpi_sweep import SRC, the_sweep

from epo_lightning.data.recorded.recordings import RecordedData
from epo_lightning.experiment.config.compose import compose, jobs
from epo_lightning.experiment.sweeps.sweep import Job, Sweep, label
from epo_lightning.experiment.sweeps.sweeping import _listed
from epo_lightning.experiment.sweeps.watch import _scoring, how_far, names_of, result
from epo_lightning.experiment.sweeps.work import job_of
from epo_lightning.files import write_json
from epo_lightning.identity import identity
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder


def test_records_of_older_versions_are_read(tmp_path: Path) -> None:
    sweep = Sweep(tmp_path / "runs" / "sweeps" / "old")
    job = {"overrides": [], "folder": "a", "identity": "0", "title": "a", "seed": 0}
    jobs = [{**job, "score": score} for score in ("test", None, "time")]
    write_json(sweep.folder / "sweep.json", {"name": "old", "jobs": jobs})
    assert [job.measures for job in sweep.jobs] == [("test",), (), ("time",)]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "is not JSON"),
        ("[1]", "holds no JSON object"),
        ('{"began": 5}', "its entry began must be a text, not 5"),
        ('{"jobs": 5}', "its entry jobs must be a list of objects, not 5"),
        ('{"jobs": [{}]}', "a run of the sweep, is damaged: it lacks the entry overrides"),
        ('{"jobs": [{"overrides": [], "folder": 5}]}', "its entry folder must be a text, not 5"),
    ],
)
def test_damaged_records_of_a_sweep_are_named(tmp_path: Path, content: str, message: str) -> None:
    file = tmp_path / "sweeps" / "rpi_main" / "sweep.json"
    file.parent.mkdir(parents=True)
    file.write_text(content)
    with pytest.raises(
        ConfigError, match=f"sweep.json.*{message}.*; delete the file and give the command of the sweep"
    ):
        _ = Sweep.find("rpi_main", [], tmp_path).jobs


@pytest.mark.parametrize("best", ['"x"', '{"val/minSADE": "x"}', "5"])
def test_a_damaged_record_of_a_run_is_said_in_its_line(tmp_path: Path, best: str) -> None:
    (tmp_path / "run.json").write_text(f'{{"status": "finished", "best": {best}}}')
    (tmp_path / "runtime.json").write_text("{}")
    for measures in ((), ("time",)):
        job = Job((), RunFolder(tmp_path), "0", "EPO", 0, measures)
        assert result(job).startswith(f"records in {tmp_path} are damaged (")


def test_the_time_that_is_left_is_that_at_the_pace_since_the_run_went_on() -> None:
    """Half of the steps after the resume are done, in two minutes."""
    progress = {"step": 150, "steps": 200, "from_step": 100, "seconds": 120.0}
    job = cast(Job, SimpleNamespace(run=SimpleNamespace(progress=progress, path="r", finished=False)))
    assert how_far(job) == "step 150 of 200, 2 min left"
    del progress["from_step"]
    assert how_far(job) == "step 150 of 200, 40 s left"
    progress["step"] = 0
    assert how_far(job) == "step 0 of 200"


def test_the_command_that_scores_a_run_names_the_split_that_it_lacks(tmp_path: Path) -> None:
    for measures, split in ((("val",), " split=val"), (("test", "val"), ""), (("test",), "")):
        job = Job((), RunFolder(tmp_path / "r"), "0", "EPO", 0, measures)
        assert _scoring(job) == f"epo evaluate run={tmp_path / 'r'}{split}"


def test_runs_of_one_title_and_seed_have_distinct_names(tmp_path: Path) -> None:
    places = ("rpi/a/paper-s0", "rpi/b/paper-s0", "rpi/c/short-s0")
    jobs = [Job((), RunFolder(tmp_path / place), "0", "EPO", 0, ()) for place in places]
    names = names_of([*jobs, Job((), RunFolder(tmp_path / "d"), "0", "EPO", 1, ())])
    assert list(names.values()) == [
        *("EPO, seed 0 (a/paper-s0)", "EPO, seed 0 (b/paper-s0)", "EPO, seed 0 (short-s0)", "EPO, seed 1"),
    ]


def test_runs_of_a_grid_are_named_by_their_settings() -> None:
    def names(*listed: str) -> list[str]:
        jobs = [
            Job(tuple(words.split()), RunFolder(Path(f"r/s0-{i}")), "", "EPO", int("seed=1" in words), ())
            for i, words in enumerate(listed)
        ]
        return list(names_of(jobs).values())

    both = "experiment=rpi/v_lstm_epo budget=short"
    assert names(
        f"{both} optimizer.lr=1e-3 solver.steps=2 seed=0", f"{both} optimizer.lr=3.7848e-4 solver.steps=4 seed=1"
    ) == [
        "EPO, lr=0.001, steps=2, seed 0",
        "EPO, lr=0.000378, steps=4, seed 1",
    ]
    assert names("experiment=a seed=0", "experiment=a +data.games_share=0.5 seed=0") == [
        "EPO, seed 0",
        "EPO, games_share=0.5, seed 0",
    ]
    assert names("data.test=[USA_US101-15_2_T-1,USA_US101-2_1_T-1]", "data.test=[x]")[0] == (
        "EPO, test=[USA_US101-15_2_T-1,USA…, seed 0"
    )
    assert names("optimizer.lr=0.00012345", "optimizer.lr=0.00012346")[0] == "EPO, lr=0.000123, seed 0 (s0-0)"
    assert names("a=1 b=1 c=1 d=1 e=1", "a=2 b=2 c=2 d=2 e=2")[1] == "EPO, seed 0 (s0-1)"


def test_damaged_runs_are_named_before_anything_runs(epo: Epo, refused: Callable[..., str]) -> None:
    words = ("sweep", "rpi_main", *TINY, "seed=0", "score=test", "experiment=rpi/v_lstm")
    assert epo(*words) == 0
    (job,) = the_sweep().jobs
    record = job.run.record_file.read_text()
    job.run.record_file.write_text(record[:40])
    assert "run.json is not JSON" in refused(*words)
    job.run.record_file.write_text(record)
    config = job.run.config_file.read_text()
    job.run.config_file.write_text(config.replace("lr: 0.001", "lr: 0.5"))
    assert "optimizer.lr: 0.5 there, 0.001 here" in refused(*words)
    job.run.config_file.write_text(config)
    job.run.update(data_digest="other", identity=identity(job.run.config(), "other"))
    assert "has changed since the run began (digest other" in refused(*words)


def test_invalid_sweeps_are_refused(refused: Callable[..., str]) -> None:
    assert "'rpi_main'" in refused("sweep", "rpi_mian")
    assert "rpi_main" in refused("sweep", "seed=1")
    assert "'seed'" in refused("sweep", "rpi_main", "sede=1")
    assert "set it by +data.games_share=<value>" in refused("sweep", "rpi_main", "data.games_share=0.1")
    nested = "data.windows.off_lane"
    assert f"set it by +{nested}=<value>" in refused("sweep", "us101_main", f"{nested}=agent")
    assert "none has" in refused("sweep", "status", "rpi_main")
    assert "run_dir" in refused("sweep", "rpi_main", "run_dir=x")
    assert "epo sweep generate <name>" in refused("sweep", "generate")
    assert "while it searches" in refused("sweep", "generate", "rpi_search")
    assert "epo generate" in refused("sweep", "rpi_main", "data.root=nowhere"), "said once, before any run begins"
    assert "belongs to epo sweep" in refused("train", "--stop-on-failure")


def test_sweeps_are_listed(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    assert epo("sweep") == 0
    listed = re.split(r"\n(?=  \w)", capsys.readouterr().out)
    told = {words[0]: " ".join(words[1:]) for words in map(str.split, listed)}
    assert told.keys() == {path.stem for path in (SRC / "sweeps").glob("*.yaml")}
    assert told["table1"].startswith("The paper's Table 1 as a table of results: five published methods")
    for name, text in told.items():
        counted = jobs("train", [f"sweeps={name}"])  # none for sweepers that choose as they go
        assert re.search(rf" {len(counted) or 30} runs\b", text), (name, text)
    assert epo("sweep", "--help") == 0
    assert "--stop-on-failure" in capsys.readouterr().out
    assert epo("sweep", "rpi_main", *TINY, "seed=0", "experiment=rpi/const_vel") == 0
    capsys.readouterr()
    assert epo("sweep", "status") == 0
    assert "1 run: 1 done" in capsys.readouterr().out


def test_the_latest_sweep_of_a_name_is_found(tmp_path: Path) -> None:
    for name, began in (("rpi_main-aaaaaa", "2026-01-01"), ("rpi_main-bbbbbb", "2026-02-01"), ("other", "2026-03-01")):
        write_json(tmp_path / "sweeps" / name / "sweep.json", {"name": name.partition("-")[0], "began": began})
    assert Sweep.find("rpi_main", [], tmp_path).label == "rpi_main-bbbbbb"
    assert Sweep.find("rpi_main-aaaaaa", [], tmp_path).label == "rpi_main-aaaaaa"
    with pytest.raises(ConfigError, match=r"rpi_main with these overrides.*rpi_main-bbbbbb"):
        Sweep.find("rpi_main", ["budget=short"], tmp_path)
    with pytest.raises(ConfigError, match="no sweep rpi_mai has begun"):
        Sweep.find("rpi_mai", [], tmp_path)


def test_runs_on_two_data_sets_are_named_by_their_data() -> None:
    def job(title: str, data: str, folder: str) -> Job:
        return Job((), RunFolder(Path(folder)), folder, title, 0, ("test",), data)

    named = [job("JFP", "rpi", "a/s0"), job("JFP", "highway_sim", "b/s0"), job("EPO", "rpi", "c/s0")]
    assert list(names_of(named).values()) == ["JFP (rpi), seed 0", "JFP (highway_sim), seed 0", "EPO, seed 0"]
    again = [*named, job("JFP", "rpi", "a/s0-abc")]
    assert list(names_of(again).values())[-1] == "JFP (rpi), seed 0 (s0-abc)"


def test_a_sweep_over_two_data_sets_records_their_names_and_seeds(tmp_path: Path) -> None:
    rows = ("table1/rpi_jfp", "table1/highway_jfp")
    words = [["data=drawn", "budget=smoke", f"experiment={row}", f"seed={3 + i}"] for i, row in enumerate(rows)]
    sweep = Sweep(tmp_path / "sweeps" / "table1")
    sweep.begin("table1", "epo sweep table1", [], [job_of(compose("train", word), word) for word in words], False)
    names = list(names_of(sweep.jobs).values())
    assert names == ["JFP (drawn (rpi)), seed 3", "JFP (drawn (highway)), seed 4"]


def test_labels_depend_on_the_settings_and_not_on_the_machine() -> None:
    assert label("steps", []) == label("steps", ["logger=[wandb]", "hydra/launcher=local", "runs=x"]) == "steps"
    assert label("steps", ["hydra.sweeper.params.seed=7"]) != "steps"
    assert label("steps", ["hydra.sweeper.n_trials=7", "hydra.launcher.n_jobs=2"]) == "steps"
    assert label("steps", ["seed=1"]) == label("steps", ["seed=1", "trainer.threads=2"]) != "steps"
    assert label("steps", ["a=1", "b=2"]) == label("steps", ["b=2", "a=1"])


def test_run_folders_are_named_by_their_settings() -> None:
    def variant(*words: str) -> str:
        return compose("train", ["experiment=rpi/v_lstm_epo", *words])["variant"]

    assert variant() == variant("solver.steps=2") == variant("seed=7") == variant("budget=short") == ""
    assert variant("solver.steps=3") == variant("solver.steps=3", "seed=4", "logger=[tensorboard]") != ""
    assert variant("solver.steps=3") != variant("solver.steps=4")
    assert variant("trainer.limit_train_batches=1") != variant("trainer.limit_train_batches=1.0") == ""
    assert variant("optimizer.clip=1") == variant("optimizer.clip=1.0") != ""


def test_titles_name_the_backbone_and_the_forecaster_that_differ_from_those_of_the_row() -> None:
    def title(*words: str) -> str:
        return compose("train", ["experiment=highway/v_lstm_epo", *words])["title"]

    assert title() == title("backbone=v_lstm", "solver=converging", "seed=7") == "V-LSTM + EPO"
    assert title("backbone=vibes") == "V-LSTM + EPO, backbone=vibes"
    assert title("backbone=vibes", "data=highway_sim", "budget=short") == "V-LSTM + EPO, backbone=vibes"
    assert title("forecaster=marginal", "backbone=hivt_m") == "V-LSTM + EPO, backbone=hivt_m, forecaster=marginal"
    assert title("backbone=vibes", "title=mine") == "mine"


def test_globs_find_experiments_in_folders() -> None:
    listed = jobs("train", ["experiment=glob('rpi/*')", "seed=1,2,3"])
    assert ["experiment=rpi/v_lstm_epo", "seed=2"] in listed
    assert len(listed) == 3 * len(list((SRC / "conf" / "experiment" / "rpi").glob("*.yaml")))


@pytest.mark.parametrize("word", ["experiment=glob('rpi/v_lstn*')", "seed=range(3,3)"])
@pytest.mark.parametrize("command", [("train", "-m"), ("sweep", "rpi_main")])
def test_globs_and_ranges_without_a_value_are_refused(
    refused: Callable[..., str], command: tuple[str, ...], word: str
) -> None:
    said = refused(*command, "data=drawn", "budget=smoke", word)
    assert f"{word} matches nothing, so that there is nothing to run" in said
    assert not Path("runs").exists()


@pytest.mark.parametrize(
    ("word", "key"),
    [
        ("callbacks.patience=1,2", "callbacks.patience"),
        ("trainer.max_epochs=1,2", "trainer.max_epochs"),
        ("data.scenes=32,64", "data.scenes"),
        ("budget=smoke,untrained", "budget"),
    ],
)
def test_runs_that_no_table_may_compare_are_refused_before_they_begin(
    refused: Callable[..., str], word: str, key: str
) -> None:
    words = ["experiment=rpi/v_lstm", "seed=0", "data=drawn", "data.like=rpi", "score=val"]
    said = refused("sweep", "rpi_main", *words, *(["budget=smoke"] if key != "budget" else []), word)
    assert f"the runs of this sweep on drawn (rpi) differ in {key}, which must be equal" in said


def test_rows_with_the_same_settings_are_refused(tmp_path: Path) -> None:
    """They would be trained twice, and the report could not tell their runs apart."""
    own = tmp_path / "own" / "experiment"
    own.mkdir(parents=True)
    row = "# @package _global_\ndefaults: [rpi/v_lstm_epo, _self_]\ntitle: {}\nsolver: {{damping: {}}}\n"
    for name, damping in (("usual", 10.0), ("less", 5.0)):
        (own / f"{name}.yaml").write_text(row.format(name, damping))

    def listed(*experiments: str, more: Sequence[str] = ()) -> int:
        words = [f"experiment={','.join(experiments)}", "seed=0,1", "data=drawn", "data.like=rpi", "budget=smoke"]
        sweep = Sweep(tmp_path / "runs" / "sweeps" / "a")
        return len(_listed(sweep, ["sweeps=rpi_main", "score=val", *words, *more], [str(own.parent)]))

    assert listed("rpi/v_lstm_epo", "less") == 4
    with pytest.raises(ConfigError, match=r"the rows 'a' and 'b' have the same settings, .* would be the same run"):
        listed("less", more=["title=a,b"])
    with pytest.raises(ConfigError, match=r"the rows 'V-LSTM \+ EPO' and 'usual' have the same settings, .* same run"):
        listed("rpi/v_lstm_epo", "usual")


def test_settings_that_a_table_compares_and_times_are_not_refused(tmp_path: Path) -> None:
    words = ["experiment=rpi/v_lstm", "seed=0", "data=drawn", "data.like=rpi", "budget=smoke"]
    for more in (["data.batch_size=8,16", "optimizer.lr=0.1,0.2"], ["score=time", "data.scenes=32,64"]):
        listed = _listed(Sweep(tmp_path / "runs" / "sweeps" / "a"), ["sweeps=rpi_main", "score=val", *words, *more], [])
        assert len(listed) == (4 if "score=time" not in more else 2)


def test_rows_that_learn_nothing_and_folds_need_not_share_the_conditions_of_trainings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = tmp_path / "own" / "experiment"
    own.mkdir(parents=True)
    files = {
        "still": "defaults: [rpi/const_vel, _self_]\ntrainer: {precision: 64-true}",
        "fold0": "defaults: [highway/v_lstm, _self_]\ndata: {test: ['0'], val_share: 0.2}",
        "fold1": "defaults: [highway/v_lstm, _self_]\ndata: {test: ['1'], val_share: 0.3}",
        "other": "defaults: [highway/v_lstm, _self_]\ndata: {test: ['1'], val_share: 0.4}",
    }
    for name, content in files.items():
        (own / f"{name}.yaml").write_text(f"# @package _global_\n{content}\n")
    monkeypatch.setattr(RecordedData, "setup", lambda self, stage: None)  # nothing is trained here

    def listed(*words: str) -> int:
        sweep, fixed = Sweep(tmp_path / "runs" / "sweeps" / "a"), ["sweeps=rpi_main", "score=test", "seed=0"]
        return len(_listed(sweep, [*fixed, "budget=smoke", *words], [str(own.parent)]))

    assert listed("experiment=still,rpi/v_lstm", "data=drawn", "data.like=rpi") == 2
    assert listed("experiment=fold0,fold1", "data=highway_sim") == 2
    with pytest.raises(ConfigError, match=r"on highway_sim, test 1 differ in data\.val_share"):
        listed("experiment=fold0,fold1,other", "data=highway_sim")
