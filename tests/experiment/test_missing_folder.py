"""A folder of recordings that the command names and that does not exist: refused, whatever lies in the cache."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from experiment import pedestrians
from experiment.conftest import Epo

ROW = ("experiment=ucy/const_vel", "budget=smoke", "callbacks.progress=none")
DATA = ("data=ucy", "data.val_share=0.3", "data.windows.every=3")


@pytest.fixture(autouse=True)
def extracted(epo: Epo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A data set in the cache, of recordings that are gone."""
    monkeypatch.delenv("EPO_CACHE", raising=False)
    for place in range(3):
        pedestrians.square(tmp_path / "recorded", f"square{place}", seed=place)
    assert epo("generate", *DATA, "data.folder=recorded", "workers=1") == 0
    shutil.rmtree(tmp_path / "recorded")


@pytest.mark.parametrize(
    "words",
    [
        ("generate", *DATA),
        ("train", *ROW, *DATA),
        ("train", "-m", *ROW, *DATA, "seed=0,1"),
        ("config", "check", "train", *ROW, *DATA),
        ("evaluate", "run=rpi/v_lstm_sc", *DATA),
        ("predict", "run=rpi/v_lstm_sc", "out=pictures", *DATA),
    ],
    ids=" ".join,
)
def test_a_missing_folder_is_refused_although_a_data_set_fits(
    words: tuple[str, ...], refused: Callable[..., str]
) -> None:
    said = refused(*words, "data.folder=recrded")
    assert said.startswith("epo: data.folder=recrded: there is no such folder; correct it, or leave data.folder out")


def test_a_sweep_is_refused_before_its_first_run(refused: Callable[..., str], tmp_path: Path) -> None:
    file = tmp_path / "conf" / "sweeps" / "squares.yaml"
    file.parent.mkdir(parents=True)
    file.write_text(
        "# @package _global_\n# Squares.\n"
        "hydra: {sweeper: {params: {experiment: 'ucy/const_vel', data: ucy, seed: '0,1', data.folder: recrded}}}\n"
    )
    for words in (("sweep", "squares"), ("sweep", "generate", "squares")):
        assert "data.folder=recrded: there is no such folder" in refused(*words, f"--config-dir={tmp_path / 'conf'}")


def test_without_the_key_the_data_set_is_used_with_a_warning(epo: Epo) -> None:
    said = r"^there is no folder data/ucy: the data set cache/ucy-\w+ is used, .* correct data.folder if"
    with pytest.warns(UserWarning, match=said):
        assert epo("train", *ROW, *DATA, "run_dir=run") == 0
    assert (Path("run") / "run.json").is_file()


def test_a_run_that_is_scored_from_another_folder_says_where_its_data_are(
    epo: Epo,
    refused: Callable[..., str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.warns(UserWarning, match="there is no folder data/ucy"):
        assert epo("train", *ROW, *DATA, "run_dir=run") == 0
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    said = refused("evaluate", f"run={tmp_path / 'run'}")
    shutil.copytree(tmp_path / "run", tmp_path / "runs" / "first")
    assert refused("evaluate", f"runs={tmp_path / 'runs'}").startswith("epo: no run in or below")
    shutil.copytree(tmp_path / "run", tmp_path / "runs" / "second")
    first = tmp_path / "runs" / "first" / "run.json"
    first.write_text(first.read_text().replace('"data_digest": "', '"data_digest": "0'))
    assert (
        f"The run is in another folder, {tmp_path / 'run'}, and its data are searched from this one: give the" in said
    )
    shutil.copytree(tmp_path / "run", tmp_path / "runs" / "third")
    (tmp_path / "runs" / "third" / "run.json").write_text('{"status": "fin')
    shutil.copytree(tmp_path / "run", tmp_path / "runs" / "fourth")
    (tmp_path / "runs" / "fourth" / "run.json").write_text('{"status": "failed"}')
    monkeypatch.setenv("EPO_CACHE", str(tmp_path / "cache"))
    with pytest.warns(UserWarning, match="there is no folder data/ucy"):
        assert epo("evaluate", f"run={tmp_path / 'run'}") == 0
    capsys.readouterr()
    with pytest.warns(UserWarning, match="there is no folder data/ucy"):
        assert epo("evaluate", f"runs={tmp_path / 'runs'}") == 0, "a run that cannot be scored does not stop the others"
    printed = capsys.readouterr().out
    assert f"{tmp_path / 'runs' / 'first'}: left out, " in printed
    assert f"{tmp_path / 'runs' / 'second'} (test): minADE" in printed
    assert f"{tmp_path / 'runs' / 'third'}: left out, " in printed
    assert f"{tmp_path / 'runs' / 'fourth'}: left out, failed: None" in printed
    assert "run.json" in printed.partition("third: left out, ")[2].partition("\n")[0]
