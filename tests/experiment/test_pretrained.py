"""The forecasters that ship with the package, and how they are packed."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
import torch
from docs.pages import ROOT
from experiment import tiny
from experiment.conftest import TINY, Epo
from safetensors.torch import load_file

import epo_lightning
from epo_lightning import pretrained
from epo_lightning.data.cache import file_digest
from epo_lightning.experiment import ship as shipping
from epo_lightning.experiment.card import SCORES, Recipe, card, recipe_of, recipes
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.ship import PLACES, SCENES, score_examples, ship, shrunk
from epo_lightning.files import read_json
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder

NAMES = pretrained.names()
ROW = "rpi/v_lstm_epo"
EXAMPLE = Recipe(train="data=tiny experiment=rpi/v_lstm_sc", about="A method.", data="Some data.", limits=["None."])


def test_every_recipe_has_a_forecaster() -> None:
    assert sorted(recipes()) == NAMES
    assert {ROW, "rpi/v_lstm_sc", "rpi/v_lstm_epo_game_refined", "highway_sim/hivt_m_epo"} <= set(NAMES)


def test_a_name_that_does_not_ship_is_answered_by_those_that_do() -> None:
    for read in (pretrained.card, pretrained.examples):
        with pytest.raises(ConfigError, match=r"did you mean 'rpi/v_lstm_epo'\? known: highway_sim/"):
            read("rpi/v_lstm_ep")


@pytest.mark.parametrize("name", NAMES)
def test_it_loads_by_name_and_has_the_scores_of_its_card(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    stored = read_json(pretrained.HOME / name / "metrics.json")
    found = score_examples(name)
    # Other processors round the steps of the solver differently.
    assert found == pytest.approx(stored["examples"], rel=1e-3, abs=1e-4)
    row = " | ".join(f"{stored['examples'][score]:.4f}" for score in SCORES)
    assert f"| the {SCENES} test scenes that ship with it | {row} |" in pretrained.card(name)

    forecaster, scenes = epo_lightning.load(name), pretrained.examples(name)
    assert all(value.dtype == torch.float32 for value in forecaster.parameters())
    with torch.no_grad():
        for value in forecaster.parameters():
            value.mul_(1.05)
    assert scenes.future is not None
    errors = (forecaster.predict(scenes).states - scenes.future[:, None])[..., :2].norm(dim=-1)  # [B, M, N, K]
    assert float(errors.mean((2, 3)).amin(1).mean()) != pytest.approx(stored["examples"]["minSADE"], rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_its_record_gives_its_provenance(name: str) -> None:
    folder = pretrained.HOME / name
    run, scores = RunFolder(folder), read_json(folder / "metrics.json")
    record, config = run.record, run.config()
    assert hashlib.sha256(run.checkpoint("best").read_bytes()).hexdigest() == record["sha256"]
    assert all(file.stat().st_size < 1_000_000 for file in folder.rglob("*"))
    assert {"git_commit", "seed", "data_digest", "versions"} <= {
        key for key, value in record.items() if value is not None
    }
    assert not record["git_commit"].endswith("+"), "the code was changed since that commit"
    assert scores["data_digest"] == record["data_digest"]
    assert [config[key] for key in ("sweep", "run_dir", "resume")] == [None] * 3
    assert config["data"]["root"] is None


@pytest.mark.parametrize("name", NAMES)
def test_its_card_is_that_of_the_stored_run(name: str) -> None:
    run, text = RunFolder(pretrained.HOME / name), pretrained.card(name)
    assert text == card(name, recipe_of(name), run), "pack it again after a change of its recipe"
    for needed in (
        "Data: ",
        "| budget | ",
        "| command | `epo train ",
        "| commit | ",
        "| seed | ",
        "## Scores",
        "## Limits\n\n- ",
    ):
        assert needed in text
    assert run.record["git_commit"] in text


@pytest.mark.parametrize("name", NAMES)
def test_its_recipe_trains_the_row_that_ships(name: str) -> None:
    config, made = RunFolder(pretrained.HOME / name).config(), compose("train", recipe_of(name).words)
    for key in ("experiment", "title", "seed", "budget"):
        assert config[key] == made[key], key
    assert config["data"] == made["data"]


@pytest.mark.parametrize("name", NAMES)
def test_the_documentation_has_its_scores(name: str) -> None:
    scores = read_json(pretrained.HOME / name / "metrics.json")["metrics"]
    size = (pretrained.HOME / name / "checkpoints" / "best.ckpt").stat().st_size
    (row,) = (
        line for line in (ROOT / "docs" / "pretrained.md").read_text().splitlines() if line.startswith(f"| `{name}` |")
    )
    shown = " / ".join(f"{scores[score]:.4f}" for score in ("minSADE", "minSFDE", "overlap_jfp"))
    assert f"| {shown} | {size / 1e6:.2f} MB |" in row


def test_predict_takes_its_name_and_example_scenes(
    epo: Epo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("EPO_CACHE", str(tmp_path / "cache"))  # without the data set
    before = {path: path.stat().st_mtime_ns for path in (pretrained.HOME / ROW).rglob("*")}
    assert epo("predict", f"run={ROW}", "figures=1", "scenes=8") == 0
    said = capsys.readouterr().out
    assert "epo generate data=rpi" in said
    assert f"{SCENES} example scenes that ship with {ROW}" in said
    written = load_file(tmp_path / "predictions" / "forecasts.safetensors")
    assert written["states"].shape[:3] == (8, 2, 2)
    assert list((tmp_path / "predictions" / "figures").iterdir())
    assert {path: path.stat().st_mtime_ns for path in (pretrained.HOME / ROW).rglob("*")} == before


def test_a_run_folder_takes_precedence_and_unknown_names_are_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    for unknown in ("rpi", "rpi/v_lstm_ego"):
        for opened in (epo_lightning.load, RunFolder.open):
            with pytest.raises(ConfigError, match=f"highway_sim/hivt_m_epo, {ROW}, "):
                opened(unknown)
    with pytest.raises(ConfigError, match=f"did you mean '{ROW}'"):
        epo_lightning.load("rpi/v_lstm_ego")
    assert RunFolder.open(ROW).path == pretrained.HOME / ROW
    (tmp_path / ROW).mkdir(parents=True)
    with pytest.raises(ConfigError, match="is not a run folder"):
        RunFolder.open(ROW)
    with pytest.raises(ConfigError, match=f"; its run is {pretrained.HOME / ROW}$"):
        RunFolder.open(pretrained.HOME / ROW / "checkpoints")


def test_scores_of_a_shipped_forecaster_on_other_data_name_the_data(
    epo: Epo, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted((pretrained.HOME / "rpi/v_lstm_sc").iterdir())
    assert epo("evaluate", "run=rpi/v_lstm_sc", "data=drawn", "data.like=rpi", "data.scenes=8") == 0
    assert "v_lstm_sc (drawn, not stored: nothing is written beside a forecaster of the package): minADE" in (
        capsys.readouterr().out
    )
    assert sorted((pretrained.HOME / "rpi/v_lstm_sc").iterdir()) == before


def test_a_packed_run_forecasts_like_the_run(
    epo: Epo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert epo("train", "experiment=rpi/v_lstm_sc", *TINY, "run_dir=one") == 0
    assert epo("evaluate", "run=one") == 0

    def fail(_: tiny.Tiny) -> None:
        raise AssertionError("scores and examples are those of the test split")

    monkeypatch.setattr(tiny.Tiny, "val_dataloader", fail)
    folder = ship(RunFolder.open("one"), "tiny/sc", EXAMPLE, tmp_path / "packed")
    scenes = pretrained.examples(folder)
    assert len(scenes.history) <= SCENES
    one = epo_lightning.load(tmp_path / "one" / "checkpoints" / "best.ckpt")
    packed = epo_lightning.load(folder / "checkpoints" / "best.ckpt")
    torch.testing.assert_close(packed.predict(scenes).states, one.predict(scenes).states, rtol=0, atol=0)
    assert (folder / "checkpoints" / "best.ckpt").stat().st_size * 2 < (
        tmp_path / "one/checkpoints/best.ckpt"
    ).stat().st_size
    config = RunFolder(folder).config()
    assert {key: config[key] for key in PLACES} == PLACES, "folders of the machine on which the run was made"
    shipped = pretrained.HOME / ROW
    assert sorted(path.name for path in folder.iterdir()) == sorted(path.name for path in shipped.iterdir())
    scores = [read_json(path / "metrics.json")["metrics"]["minSADE"] for path in (tmp_path / "one", folder)]
    assert scores[0] == scores[1]

    # Larger weights are stored in half precision, and the scores are those of the stored weights.
    monkeypatch.setattr(shipping, "LARGEST", 1000)
    folder = ship(RunFolder.open("one"), "tiny/sc", EXAMPLE, tmp_path / "packed")
    assert not list(tmp_path.glob(".packed*")), "nothing is left of the forecaster that was replaced"
    assert read_json(folder / "run.json")["sha256"] == file_digest(folder / "checkpoints" / "best.ckpt")
    assert "stored as float16" in pretrained.card(folder)
    half = epo_lightning.load(folder / "checkpoints" / "best.ckpt").predict(scenes).states
    assert 0 < float((half - one.predict(scenes).states).abs().max()) < 0.05
    assert read_json(folder / "metrics.json")["metrics"]["minSADE"] != scores[0]


def test_numbers_that_count_keep_their_type_where_weights_are_stored_in_half_precision() -> None:
    weights = {"w": torch.rand(4), "batches": torch.tensor(70_001), "mask": torch.tensor([True])}
    assert shrunk(weights) == weights
    large = {**weights, "w": torch.rand(shipping.LARGEST)}
    types = {name: value.dtype for name, value in shrunk(large).items()}
    assert types == {"w": torch.float16, "batches": torch.int64, "mask": torch.bool}
    assert shrunk(large)["batches"] == 70_001


def test_a_forecaster_that_cannot_be_replaced_is_kept(
    epo: Epo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert epo("train", "experiment=rpi/v_lstm_sc", *TINY, "run_dir=one") == 0
    (tmp_path / "packed").mkdir()
    (tmp_path / "packed" / "card.md").write_text("the earlier one")
    rename = Path.rename

    def stop(self: Path, target: Path) -> Path:
        if self.name == ".packed-new":
            raise KeyboardInterrupt
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", stop)
    with pytest.raises(KeyboardInterrupt):
        ship(RunFolder.open("one"), "tiny/sc", EXAMPLE, tmp_path / "packed")
    (kept,) = tmp_path.glob(".packed-old/card.md")
    assert kept.read_text() == "the earlier one"


def test_an_unfinished_run_is_not_packed(tmp_path: Path) -> None:
    unfinished = RunFolder(tmp_path / "run")
    unfinished.begin({"seed": 0}, {})
    with pytest.raises(ConfigError, match="is not finished"):
        ship(unfinished, "tiny/sc", EXAMPLE, tmp_path / "packed")
    with pytest.raises(ConfigError, match=r"no recipe 'rpi/x' .*known: highway_sim/hivt_m_epo"):
        recipe_of("rpi/x")


def test_make_generates_trains_and_replaces(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    words = "experiment=rpi/v_lstm_sc data=drawn data.like=rpi data.scenes=64 budget=smoke callbacks.progress=none"
    recipe, generated = Recipe(words, "A method.", "Drawn scenes.", ["None."]), []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pretrained, "HOME", tmp_path / "package")
    monkeypatch.setattr(shipping, "recipe_of", lambda name: recipe)
    monkeypatch.setattr(shipping, "generate_and_print", lambda config, words: generated.append(words))
    old = tmp_path / "package" / "rpi" / "mine" / "old"
    old.mkdir(parents=True)
    train, replaced = shipping.train, []
    monkeypatch.setattr(shipping, "train", lambda *values: (replaced.append(not old.exists()), train(*values))[1])
    folder, second = shipping.make(["rpi/mine", "rpi/second"])
    assert generated == 2 * [["data=drawn", "data.like=rpi", "data.scenes=64"]]
    assert replaced == [False, False], "the second run must find the working tree as the first one did"
    assert pretrained.names() == ["rpi/mine", "rpi/second"]
    assert not old.exists()
    assert score_examples("rpi/mine") == pytest.approx(read_json(folder / "metrics.json")["examples"], rel=1e-3)
    # The finished run is packed again, not trained again.
    trained = RunFolder.open("runs/pretrained/rpi/mine").checkpoint("last").stat().st_mtime_ns
    assert shipping.make(["rpi/mine", "rpi/second"]) == [folder, second]
    assert RunFolder.open("runs/pretrained/rpi/mine").checkpoint("last").stat().st_mtime_ns == trained
