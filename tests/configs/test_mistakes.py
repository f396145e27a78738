"""Every mistake in a command line or in a file of the tree is refused in one message that names the right word."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from experiment import tiny
from experiment.conftest import Epo, epo, refused  # noqa: F401 - fixtures

from epo_lightning.experiment.config.compose import compose, jobs
from epo_lightning.registry import ConfigError

MISTAKES = {
    "trian": "'train'",
    "train sede=1": "'seed'",
    "train +sede=1": "'seed'",
    "train data.batch=1": "'batch_size'",
    "config check train data=exid data.history=12": "in data: it is data.windows.history",
    "train +data.foo=1": "data.foo",
    "train solver.step=3": "'steps'",
    "train objective.weights={imitation:2.0,probabilty:1}": (
        "unknown key 'objective.weights.probabilty' in objective.weights: did you mean 'probability'?"
    ),
    "config check train data=exid data.windows={dt:0.2,histori:12}": "in data.windows: did you mean 'history'?",
    "train +objective.power=2": "objective.power has a value, so leave out the plus: objective.power=2",
    "config check train data=eth data.options.video_rat=10": "'data.options.video_rat': did you mean 'video_rate'?",
    "config check train data=eth data.options.video_rate=10": "set it by +data.options.video_rate=<value>",
    "config check train data=dut data.options.rate=fast": "data.options.rate must be a number, not 'fast'",
    "train trainer.max_epoch=3": "'max_epochs'",
    "train +callbacks.patient=3": "'patience'",
    "train experiment=rpi/v_lst": "'rpi/v_lstm'",
    "train forecaster=epos": "'epo'",
    "train forecaster.name=epos": "'epo'",
    "train logger=[wand]": "'wandb'",
    "train energy.own=[gaol]": "'goal'",
    "train experiment=rpi/v_lstm_epo_game energy.own=[goal,accb] energy.bounds.vel=[0,1]": (
        "energy.bounds.vel is read by the feature velb, which energy.own (goal, accb) does not have: add it, or leave the"
    ),
    "train experiment=dut/v_lstm_epo energy=crowd_limits energy.bounds.vel=[0,1.2]": (
        "energy.bounds.vel is a dictionary, not the list [0,1.2]: set one of its entries by energy.bounds.vel.<name>=<value>"
    ),
    "train energy.bounds.vel={a:1}": "energy.bounds.vel is a list, not the dictionary {a:1}: set it by",
    "train ++energy.own={a:1}": "energy.own is a list, not the dictionary {a:1}: set it by energy.own=[...]",
    "train experiment=rpi/v_lstm optimizer=3": "optimizer=3 chooses an option that is no name: known: adam",
    "train experiment=rpi/v_lstm_epo solver.steps.max=2": "solver.steps is 2, a value without keys: set it by solver.steps=",
    "train experiment=rpi/v_lstm logger=[csv,tensorboard] backbone=3": "backbone=3 chooses an option that is no name",
    "predict run=x foo=3": "unknown key 'foo': known: animate, checkpoint",
    "config check train experiment=rpi/v_lstm_epo_game_s2 forecaster.calibration.steps=3": (
        "forecaster.calibration is null, so set all of it: forecaster.calibration={steps: <value>, ...}"
    ),
    "train lr=3e-4": "unknown key 'lr': it is optimizer.lr",
    "train energy.own.goal=1": "energy.own.goal=1 names an entry of a list, whose entries have numbers: set the whole list",
    "train callbacks.monitor=val/nash_gap": "unknown callbacks.monitor 'val/nash_gap'",
    "train energy.bounds.vel=1.2": "energy.bounds must be a mapping of names to a list of numbers or a mapping",
    "train seed=one": "seed must be a whole number",
    "train optimizer.lr=fast": "optimizer.lr must be a number",
    "train forecaster.modes=1.5": "forecaster.modes must be a whole number",
    "train goal=some": "goal must be one of energy, all",
    "train seed=${nope}": "nope",
    "train ~energy": "energy",
    "train foo": "key=value",
    "train forecaster=scene_consistent objective.power=2": "write +forecaster.power=2",
    "train forecaster=marginal objective.weights.imitation=2": "write forecaster.loss_weights.imitation=2",
    "train forecaster=scene_consistent objective=laplace": "takes no objective: leave it out",
    "train forecaster=constant_velocity objective.power=2": "takes no objective: leave it out",
    "train forecaster=marginal energy=exid": "energy=exid has no effect on forecaster=marginal, which takes no energy",
    "train forecaster=scene_consistent solver.steps=4": "which takes no solver: leave it out",
    "train -m forecaster=epo,scene_consistent backward=implicit": "takes no backward: leave it out",
    "train experiment=rpi/v_lstm_epo +energy=exid": "leave out the plus: energy=exid",
    "train forecaster=marginal ~solver.steps": "~solver.steps has no effect on forecaster=marginal",
    "train -m forecaster=epo,scene_consistent objective.relaxation=0.1": "write forecaster.relaxation=0.1",
    "train objective.power=2 +objective.annealing=0.3": "exclude each other",
    "train forecaster=scene_consistent +forecaster.power=2 +forecaster.annealing=0.3": "exclude each other",
    "train forecaster=constant_velocity goal=all": "has no network of its own: use goal=energy",
    "train backbone.width=0": "backbone.width=0",
    "train optimizer.lr=-1": "optimizer.lr",
    "train seed=0,1": "seed=0,1 has several values: for a run of each, add -m, or use a sweep",
    "train experiment=rpi/v_lstm,rpi/v_lstm_sc": "epo: experiment=rpi/v_lstm,rpi/v_lstm_sc has several values: for a run of",
    "train seed=-1": "seed",
    "train trainer.max_epochs=null": "would never end",
    "train -m sweeps=rpi_mein": "'rpi_main'",
    "train experiment=": "experiment= chooses nothing: known: argoverse2/..., dut/...",
    "train seed=[0,1]": "for a run of each, write 0,1 without brackets, in a sweep or with the option -m",
    "train -m optimizer.lr=[1e-3,1e-4]": "optimizer.lr must be a number, not [0.001, 0.0001]: for a run of each, write",
    "train -m solver.steps=1,x": "solver.steps must be a whole number",
    "train --multrun": "'--multirun'",
    "train experimnt=rpi/v_lstm": "did you mean 'experiment'?",
    "train hydra/launcher=loca": "unknown option hydra/launcher=loca: did you mean 'local'? known: basic, ",
    "train debug.foo=1": "needs a choice of debug",
    "predict solver=game": "solver is a choice of epo train, and a run keeps it",
    "report dat=x": "unknown key 'dat'",
    "train seed = 1": "without blanks",
    "train resume=nowhere": "does not exist",
    "config chekc": "'check'",
    "config check solver.step=3": "'steps'",
    "config check generate workers=0": "workers",
    "evaluate": "run=<run folder>",
    "evaluate run=nowhere": "does not exist",
    "evaluate runs=.": "no finished run",
    "evaluate runs=nowhere": "no folder nowhere of runs: it does not exist",
    "report rpi_mainn": "none has, `epo sweep` lists those that can be begun",
    "evaluate run=a split=tset": "split must be one of test, val, train, all, or null",
    "evaluate run=a split=train": "split=train needs data=<data set>",
    "predict": "run=<run folder>",
    "report runs=nowhere": "nowhere",
    "report -m runs=a,b": "has no option -m",
    "generate worker=3": "'workers'",
    "generate -m data.solver=potential,feedback hydra/sweeper=optuna": "takes lists of values",
}


@pytest.mark.parametrize("words", MISTAKES)
def test_invalid_configurations_are_refused_in_one_message(words: str, refused: Callable[..., str]) -> None:  # noqa: F811
    verb, *rest = words.split()
    data = ["data=tiny"] if verb == "train" and "resume" not in words else []
    assert MISTAKES[words] in refused(verb, *data, *rest)


def test_a_training_of_nothing_in_particular_is_refused(refused: Callable[..., str]) -> None:  # noqa: F811
    assert "choose what to train: experiment=<row>" in refused("train")


@pytest.mark.parametrize(
    ("row", "hint"),
    [
        ("us101/v_lstm_ep", "did you mean 'us101/v_lstm_epo'? known: us101/const_vel, us101/hivt_m, "),
        ("v_lstm_ep", "known: argoverse2/..., dut/..., exid/..., "),
        ("v_lstm_epo", "did you mean argoverse2/v_lstm_epo, dut/v_lstm_epo, exid/v_lstm_epo, "),
        ("v_lstm_epo_game", "did you mean rpi/v_lstm_epo_game?"),
    ],
)
def test_a_mistyped_row_is_answered_by_the_rows_beside_it(row: str, hint: str, refused: Callable[..., str]) -> None:  # noqa: F811
    message = refused("train", f"experiment={row}")
    assert hint in message
    assert "did you mean" in message
    assert len(message) < 800


def test_missing_data_is_reported_before_a_folder_is_made(refused: Callable[..., str]) -> None:  # noqa: F811
    said = refused("train", "experiment=rpi/v_lstm", "data.root=nowhere", "data.batch_size=8")
    assert f"`epo generate data=rpi data.root=nowhere data.batch_size=8 --config-dir={tiny.CONF}`" in said


def test_an_option_of_a_folder_that_is_not_on_the_search_path_is_looked_for(
    tmp_path: Path,
    refused: Callable[..., str],  # noqa: F811
) -> None:
    file = tmp_path / "conf" / "data" / "own.yaml"
    file.parent.mkdir(parents=True)
    file.write_text("defaults: [ucy, _self_]\n")
    said = "unknown option data=own: conf/data/own.yaml is found with the option --config-dir conf"
    assert said in refused("generate", "data=own")


def test_file_system_errors_give_one_message(epo: Epo, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:  # noqa: F811
    (tmp_path / "file").touch()
    assert epo("generate", "data=rpi_reduced", "data.root=file/cache", "progress=false") == 1
    message = capsys.readouterr().err.strip()
    assert message.startswith("epo: cannot write (Not a directory)"), message
    assert message.endswith("file/cache"), message


def test_a_check_without_the_data_says_in_one_line_what_is_missing(
    epo: Epo,  # noqa: F811
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert epo("config", "check", "experiment=exid/v_lstm_epo", "data.root=empty") == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith(
        "epo: V-LSTM + EPO: the settings fit together, but the data cannot be used: no folder"
    )
    assert "data/exid with exid recordings" in printed.err
    assert printed.err.endswith("point data.folder at the recordings, or unpack them there\n")


@pytest.mark.parametrize(
    ("file", "content", "words", "message"),
    [
        (
            "experiment/mine.yaml",
            "defaults: [rpi/v_lstm, _self_]",
            "experiment=mine",
            "mine.yaml must begin with the line `# @",
        ),
        (
            "experiment/mine.yaml",
            "# @package _global_\ndefaults: [rpi/v_lstm, {/backbone: hivt_m}]",
            "experiment=mine",
            r"in the defaults list of /.*experiment/mine\.yaml.*`- override /backbone: hivt_m`, with the slash",
        ),
        (
            "experiment/mine.yaml",
            "# @package _global_\ndefaults: [rpi/v_lstm, {backbone: hivt_m}]",
            "experiment=mine",
            r"if it stands in the defaults list of an experiment, write `- override /backbone: hivt_m`",
        ),
        (
            "experiment/mine.yaml",
            "# @package _global_\ndefaults: [rpi/v_lstm, {backbone: hivt}]",
            "experiment=mine",
            r"write `- override /backbone: hivt`; did you mean 'hivt_m'",
        ),
        (
            "experiment/mine.yaml",
            "# @package _global_\ndefaults: [rpi/v_lstm, {hydra/launcher: joblib}]",
            "experiment=mine",
            r"write `- override /hydra/launcher: joblib`",
        ),
        (
            "experiment/mine.yaml",
            "# @package _global_\ndefaults: [rpi/v_lstn, _self_]",
            "experiment=mine",
            r"in the defaults list of /.*experiment/mine\.yaml, .*: unknown option experiment=rpi/v_lstn: .* 'rpi/v_lstm'",
        ),
        (
            "experiment/mine.yaml",
            "# @package _global_\ndefaults: [rpi/v_lstm, {override /optimizer: adan}]",
            "experiment=mine",
            r"in the defaults list of /.*experiment/mine\.yaml, .*: unknown option optimizer=adan",
        ),
        (
            "budget/mine.yaml",
            "# @package _global_\ndefaults: [smoke, {override /optimizer: adan}]",
            "experiment=rpi/v_lstm budget=mine",
            r"in the defaults list of /.*budget/mine\.yaml, .*: unknown option optimizer=adan",
        ),
        (
            "sweeps/mine.yaml",
            "# @package _global_\ndefaults: [{override /hydra/launcher: lokal}]",
            "sweeps=mine experiment=rpi/v_lstm",
            r"in the defaults list of /.*sweeps/mine\.yaml, .*: unknown option hydra/launcher=lokal",
        ),
        (
            "data/mine.yaml",
            "defaults: [rpj, _self_]",
            "experiment=rpi/v_lstm data='mine'",
            r"in the defaults list of /.*data/mine\.yaml, .*: unknown option data=rpj",
        ),
        (
            "data/mine.yaml",
            "defaults: [exid, _self_]\nformat: my_csv",
            "experiment=highway/v_lstm data='mine'",
            r"data/mine\.yaml sets `format` without `dataset`, .* such as `dataset: mine`",
        ),
        (
            "experiment/mine.yaml",
            "# @package _global_\ndefaults: [rpi/v_lstm, _self_]\ntitle: mine",
            "experiment=mine backbone=v_lstn",
            r"^unknown option backbone=v_lstn",
        ),
        (
            "experiment/rpi/mine.yaml",
            "# @package _global_\ndefaults: [/experiment/rpi/v_lstm, {override backbone: hivt_m}]",
            "experiment=rpi/mine",
            r"in the defaults list of /.*experiment/rpi/mine\.yaml.*`- override /backbone: <option>`, with the slash",
        ),
        (
            "experiment/mine.yaml",
            "# @package _global_\ndefaults: [_self_, rpi/v_lstm]\ntitle: mine",
            "experiment=mine",
            r"in the defaults list of /.*experiment/mine\.yaml, `- _self_` stands before `- rpi/v_lstm`, .* `- _self_` last",
        ),
        (
            "experiment/mine.yaml",
            "# @package _global_\ndefaults: [_self_, {/experiment/rpi: v_lstm}]\ntitle: mine",
            "experiment=mine",
            r"`- _self_` stands before `- /experiment/rpi`",
        ),
        (
            "experiment/mine.yaml",
            "# @package _global_\ndefaults: [rpi/v_lstm, override /backbone hivt_m, _self_]",
            "experiment=mine",
            r"experiment/mine\.yaml, `- override /backbone hivt_m` lacks a colon",
        ),
        (
            "experiment/mine.yaml",
            "# @package _global_\ndefaults: [rpi/v_lstm, _self_]\nsolver: {step_size 0.3}",
            "experiment=mine",
            r"^in /.*experiment/mine\.yaml, `step_size 0\.3` lacks a colon: write `step_size: 0\.3`$",
        ),
        (
            "experiment/mine.yaml",
            "title: mine",
            "experiment=mine",
            "mine.yaml must begin with the line `# @package _glo",
        ),
        ("experiment/mine.yaml", b"\xe9: 1", "experiment=mine", r"experiment/mine\.yaml is not YAML: 'utf-8' codec"),
        (
            "sweeps/mine.yaml",
            "# @package _global_\nhydra: {sweeper: {parms: {seed: '0,1'}}}",
            "sweeps=mine",
            r"sweeps/mine\.yaml has an unknown key 'parms' under hydra: a sweep's values stand in hydra\.sweeper\.params",
        ),
        (
            "sweeps/mine.yaml",
            "hydra: {sweeper: {params: {seed: '0,1'}}}",
            "sweeps=mine",
            r"sweeps/mine\.yaml must begin with the line `# @package _global_`, as every file in sweeps/ does",
        ),
        ("sweeps/mine.yaml", "", "sweeps=mine", r"sweeps/mine\.yaml must begin with the line `# @package _global_`"),
        (
            "budget/mine.yaml",
            "budget: {name: mine}",
            "budget=mine",
            r"budget/mine\.yaml must begin with the line `# @pack",
        ),
        (
            "backbone/mine.yaml",
            "name: v_lstm\n  width: 3",
            "backbone=mine",
            r"backbone/mine\.yaml:2 is not YAML: mapping",
        ),
    ],
)
def test_mistakes_in_files_of_the_tree_are_named(
    tmp_path: Path, file: str, content: str | bytes, words: str, message: str
) -> None:
    (tmp_path / file).parent.mkdir(parents=True)
    (tmp_path / file).write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(ConfigError, match=message):
        compose("train", words.split(), [str(tmp_path)])


@pytest.mark.parametrize(
    ("params", "message"),
    [
        (
            "experiment: [rpi/v_lstm_sc, rpi/v_lstm_epo]",
            r"params: experiment=\['rpi/v_lstm_sc', 'rpi/v_lstm_epo'\] is a list.* write rpi/v_lstm_sc,rpi/v_lstm_epo with",
        ),
        ("seed: 0;1", r"params: cannot read `seed: 0;1`, expected a value, or several with commas .*: `seed: a,b`"),
        (
            "optimizer: {lr: '1e-3,1e-4'}",
            r"params: optimizer is a section, expected dotted keys .*: write `optimizer\.lr: 1e-3,1e-4`",
        ),
        ("energy: 0;1", r"params: cannot read `energy: 0;1`"),
        ("seed: [0, 1]", r"seed must be a whole number, not \[0, 1\]: for a run of each, write 0,1 without brackets"),
        ("", r"has no runs: hydra\.sweeper\.params lists nothing, and the command chooses no experiment"),
    ],
)
def test_mistakes_in_the_values_of_a_sweep_are_named(
    tmp_path: Path,
    refused: Callable[..., str],  # noqa: F811
    params: str,
    message: str,
) -> None:
    file = tmp_path / "conf" / "sweeps" / "mine.yaml"
    file.parent.mkdir(parents=True)
    file.write_text(f"# @package _global_\nhydra:\n  sweeper:\n    params:\n      {params}\n")
    said = refused("sweep", "mine", f"--config-dir={tmp_path / 'conf'}", "data=tiny", "budget=smoke")
    assert re.search(message, said)
    assert said.startswith(("epo: seed must", f"epo: {file}"))


def test_a_sweep_without_values_takes_those_of_the_command(tmp_path: Path) -> None:
    (tmp_path / "sweeps").mkdir()
    (tmp_path / "sweeps" / "mine.yaml").write_text("# @package _global_\nscore: test\n")
    listed = jobs("train", ["sweeps=mine", "experiment=rpi/v_lstm,rpi/v_lstm_sc"], [str(tmp_path)])
    assert [job[-1] for job in listed] == ["experiment=rpi/v_lstm", "experiment=rpi/v_lstm_sc"]


def test_a_list_of_options_is_no_mixture_of_them(refused: Callable[..., str]) -> None:  # noqa: F811
    several = "experiment=[rpi/v_lstm_sc,rpi/v_lstm_epo]"
    for words in (("train",), ("config", "check"), ("train", "-m"), ("sweep", "rpi_main")):
        said = refused(*words, several, "data=tiny", "budget=smoke")
        assert "write rpi/v_lstm_sc,rpi/v_lstm_epo without brackets" in said
    assert "without brackets" in refused("evaluate", "run=x", "data=[tiny,drawn]")
    compose("train", ["experiment=rpi/v_lstm_sc", "logger=[csv,tensorboard]"])


def test_a_sweep_that_is_not_found_is_looked_for(tmp_path: Path, refused: Callable[..., str]) -> None:  # noqa: F811
    for folder, name in (("sweeps", "mine"), ("conf/sweeps", "other")):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / f"{name}.yaml").write_text("# @package _global_\n")
    for word in ("mine", "sweeps/mine.yaml"):
        assert "sweeps/mine.yaml is found by `epo sweep mine --config-dir=.`" in refused("sweep", word)
    assert "conf/sweeps/other.yaml is found by `epo sweep other --config-dir=conf`" in refused("sweep", "other")
    assert "did you mean 'rpi_main'?" in refused("sweep", "rpi_mein")
    assert "did you mean 'mine'?" in refused("sweep", "sweeps/mine.yaml", "--config-dir=.")
    assert "--config-dir sweeps has no configurations: expected" in refused("sweep", "mine", "--config-dir=sweeps")
