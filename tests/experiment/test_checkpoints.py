"""Checkpoints: the best epoch, the state that resuming restores, and refusal of damaged files."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from experiment.conftest import TINY, Epo
from experiment.test_resume import WORSENING, begin_and_stop

from epo_lightning.files import write_json
from epo_lightning.forecasters.checkpoint import read_checkpoint
from epo_lightning.identity import DIGEST, digest_of
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder, read_log

ROW = "experiment=rpi/v_lstm_sc"


def checkpoint(path: Path, weight: float = 1.0) -> bytes:
    torch.save({"state_dict": {"w": torch.full((50, 20), weight)}, "configuration": {"a": 1}}, path)
    return path.read_bytes()


def test_a_flipped_bit_in_any_weight_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "some.ckpt"
    whole = checkpoint(path)
    assert read_checkpoint(path)["state_dict"]["w"].shape == (50, 20)
    start = whole.index(torch.full((50,), 1.0).numpy().tobytes())
    for place in (start, start + 1999, start + 3999, len(whole) // 20):
        damaged = bytearray(whole)
        damaged[place] ^= 4
        path.write_bytes(damaged)
        with pytest.raises(ConfigError, match="not a checkpoint that epo_lightning wrote, or is damaged"):
            read_checkpoint(path)


def test_weights_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    for number in (float("nan"), float("inf")):
        checkpoint(tmp_path / "some.ckpt", number)
        with pytest.raises(ConfigError, match=r"weights that are not finite \(w\)"):
            read_checkpoint(tmp_path / "some.ckpt")


@pytest.mark.parametrize("content", [torch.zeros(3), [1], {"state_dict": 1, "configuration": {}}, {"state_dict": {}}])
def test_torch_files_that_are_no_checkpoints_are_refused(tmp_path: Path, content: object) -> None:
    torch.save(content, tmp_path / "some.ckpt")
    with pytest.raises(ConfigError, match="not a checkpoint that epo_lightning wrote"):
        read_checkpoint(tmp_path / "some.ckpt")


def test_the_best_epoch_has_the_smallest_score_and_resuming_restores_the_schedule(epo: Epo) -> None:
    cosine = "optimizer.schedule=cosine"
    assert epo(*WORSENING, cosine, "run_dir=whole") == 0
    scores = [float(row["val/minSADE"]) for row in read_log(Path("whole/logs/metrics.csv")) if row.get("val/minSADE")]
    assert len(set(scores)) == 4
    best, last = (read_checkpoint(f"whole/checkpoints/{which}.ckpt") for which in ("best", "last"))
    assert best["epoch"] == scores.index(min(scores))
    assert RunFolder(Path("whole")).record["best"]["val/minSADE"] == pytest.approx(min(scores))

    begin_and_stop(epo, "parts", 3, cosine)
    assert epo("train", "resume=parts") == 0
    resumed = read_checkpoint("parts/checkpoints/last.ckpt")
    assert resumed["lr_schedulers"] == last["lr_schedulers"]
    assert resumed["lr_schedulers"][0]["last_epoch"] == resumed["global_step"]
    rates = [each["optimizer_states"][0]["param_groups"][0]["lr"] for each in (last, resumed)]
    assert rates[0] == rates[1] < 0.05, "the learning rate has been lowered"
    assert all(torch.equal(weight, resumed["state_dict"][name]) for name, weight in last["state_dict"].items())


def test_scores_of_subsets_that_older_versions_did_not_know_are_added(epo: Epo) -> None:
    run = RunFolder(Path("run"))
    assert epo("train", ROW, *TINY, "run_dir=run", "score=test") == 0
    first = json.loads(run.metrics_file().read_text())
    old = {**first, "metrics": {name: value for name, value in first["metrics"].items() if "executed" not in name}}
    assert old != first
    del old[DIGEST]  # older versions wrote none
    weights = torch.load(run.checkpoint("best"), weights_only=True)
    weights["configuration"]["subsets"] = []
    torch.save(weights, run.checkpoint("best"))
    write_json(run.metrics_file(), old)
    assert epo("evaluate", "run=run") == 0
    assert json.loads(run.metrics_file().read_text()) == first

    wrong = {**old, "metrics": {**old["metrics"], "minADE": 2 * old["metrics"]["minADE"]}}
    write_json(run.metrics_file(), wrong)
    assert epo("evaluate", "run=run") == 0
    assert json.loads(run.metrics_file().read_text()) == wrong, "other scores stay as they are"


def test_scores_are_never_replaced(epo: Epo, refused: Callable[..., str], capsys: pytest.CaptureFixture[str]) -> None:
    run = RunFolder(Path("run"))
    assert epo("train", ROW, *TINY, "optimizer.lr=0.05", "run_dir=run", "score=test") == 0
    first = run.metrics_file().read_bytes()
    assert epo("evaluate", "run=run") == 0
    assert epo("evaluate", "run=run", "batch_size=8") == 0
    assert sorted(path.name for path in run.path.glob("*.json")) == ["metrics.json", "run.json"]

    capsys.readouterr()
    assert epo("evaluate", "run=run", "checkpoint=last") == 0
    (other,) = run.path.glob("scores-test-last-*.json")
    assert str(other) in capsys.readouterr().out
    content = json.loads(other.read_text())
    assert content["checkpoint"] == "last"
    assert content["data_digest"] == run.record["data_digest"]
    assert other.stem.endswith(content["checkpoint_digest"][:8])
    shutil.copy(run.checkpoint("last"), "kept.ckpt")
    assert epo("evaluate", "run=run", f"checkpoint={Path('kept.ckpt').resolve()}") == 0
    (kept,) = run.path.glob("scores-test-kept-*.json")
    assert json.loads(kept.read_text())["checkpoint"] == "kept.ckpt", "no folder of this machine"

    # Another file in the place of the best checkpoint.
    weights = torch.load(run.checkpoint("best"), weights_only=True)
    for value in weights["state_dict"].values():
        value.mul_(0.5) if value.is_floating_point() else None
    torch.save(weights, run.checkpoint("best"))
    assert epo("evaluate", "run=run") == 0
    (second,) = run.path.glob("scores-test-best-*.json")
    assert epo("evaluate", "run=run") == 0
    assert list(run.path.glob("scores-test-best-*.json")) == [second]

    # Scores that differ from those in both files.
    found = json.loads(second.read_text())
    others = {**found, "metrics": {name: value + 1 for name, value in found["metrics"].items()}}
    second.write_text(json.dumps({**others, DIGEST: digest_of(others)}))
    assert epo("evaluate", "run=run") == 0
    third = second.with_stem(f"{second.stem}-2")
    assert json.loads(third.read_text()) == found
    assert str(third) in capsys.readouterr().out
    assert run.metrics_file().read_bytes() == first
