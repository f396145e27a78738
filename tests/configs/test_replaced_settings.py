"""Settings of a file of one's own that the budget's file would replace are refused in one message."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from experiment.conftest import epo, refused  # noqa: F401 - fixtures

from epo_lightning.experiment.config.compose import compose, jobs


def test_settings_of_a_row_of_own_that_the_budget_replaces_are_refused(
    tmp_path: Path,
    refused: Callable[..., str],  # noqa: F811
) -> None:
    conf = tmp_path / "conf"
    params = "{experiment: rpi/mine, optimizer.lr: '1e-3,1e-4'}"
    own = "optimizer: {lr: 3.0e-4, clip: 1}\ndata: {batch_size: 8}"
    for folder, text in {
        "experiment/rpi/mine": f"defaults: [/experiment/rpi/v_lstm, _self_]\n{own}",
        "experiment/rpi/other": "defaults: [/experiment/rpi/mine, _self_]\ntitle: other",
        "budget/mine": "budget: {name: mine}\noptimizer: {lr: 3.0e-4}",
        "sweeps/mine": f"hydra: {{sweeper: {{params: {params}}}}}\ndata: {{batch_size: 32}}",
    }.items():
        (conf / folder).parent.mkdir(parents=True, exist_ok=True)
        (conf / f"{folder}.yaml").write_text(f"# @package _global_\n{text}\n")
    said = (
        r"/experiment/rpi/mine\.yaml sets optimizer\.lr: 0\.0003, data\.batch_size: 8 without effect: the budget's file "
        r".*conf/budget/short\.yaml is read later and sets optimizer\.lr: 0\.001, data\.batch_size: 32; with this budget, "
        r"move such settings to the command line \(optimizer\.lr=0\.0003 data\.batch_size=8\), to the file of a sweep"
    )
    words = (f"--config-dir={conf}", "data=tiny")
    for row in ("mine", "other"):
        for verb in (("train",), ("config", "check"), ("sweep", "rpi_main")):
            assert re.search(said, refused(*verb, *words, f"experiment=rpi/{row}", "budget=short"))

    def learning_rate(*words: str) -> float:
        return compose("train", ["experiment=rpi/other", *words], [str(conf)])["optimizer"]["lr"]

    assert learning_rate("budget=mine") == 3e-4
    assert learning_rate("budget=short", "optimizer.lr=1e-3", "data.batch_size=32") == 1e-3
    assert learning_rate("budget=smoke") == 1e-3, "a budget for trials is small whatever else is written"
    listed = jobs("train", ["sweeps=mine", "budget=short"], [str(conf)])
    assert [compose("train", job, [str(conf)])["optimizer"]["lr"] for job in listed] == [1e-3, 1e-4]


def test_settings_of_a_part_of_own_that_the_budget_replaces_are_refused(
    tmp_path: Path,
    refused: Callable[..., str],  # noqa: F811
) -> None:
    conf = tmp_path / "conf"
    for option, text in {
        "optimizer/mine": "name: adam\nlr: 3.0e-4",
        "optimizer/clipped": "defaults: [adam, _self_]\nclip: 1",
        "data/mine": "defaults: [drawn, _self_]\nlike: rpi\nbatch_size: 8",
        "trainer/mine": "defaults: [default, _self_]\nmax_epochs: 50",
        "callbacks/mine": "defaults: [default, _self_]\npatience: 3",
        "experiment/mine": "# @package _global_\ndefaults: [rpi/v_lstm, override /optimizer: mine, _self_]\ntitle: mine",
    }.items():
        (conf / option).parent.mkdir(parents=True, exist_ok=True)
        (conf / f"{option}.yaml").write_text(f"{text}\n")

    def checked(*words: str) -> tuple[str, ...]:
        data = () if any(word.startswith("data=") for word in words) else ("data=drawn", "data.like=rpi")
        row = () if "experiment=mine" in words else ("experiment=rpi/v_lstm",)
        return ("config", "check", f"--config-dir={conf}", *row, *data, *words)

    for word, lost in {
        "optimizer=mine": "optimizer/mine.yaml sets optimizer.lr: 0.0003",
        "experiment=mine": "optimizer/mine.yaml sets optimizer.lr: 0.0003",
        "data=mine": "data/mine.yaml sets data.batch_size: 8",
        "trainer=mine": "trainer/mine.yaml sets trainer.max_epochs: 50",
        "callbacks=mine": "callbacks/mine.yaml sets callbacks.patience: 3",
    }.items():
        for budget in ("paper", "long"):
            said = refused(*checked(word, f"budget={budget}"))
            assert f"{conf}/{lost} without effect: the budget's file " in said
            assert f"conf/budget/{budget}.yaml is read later" in said
        compose("train", checked(word, "budget=smoke")[3:], [str(conf)])
    for words in (("optimizer=mine", "optimizer.lr=3e-4"), ("optimizer=clipped", "budget=short")):
        compose("train", checked(*words)[3:], [str(conf)])
