"""Batches: complete, in an order that depends only on (seed, epoch), and never from the test split during training."""

from __future__ import annotations

import pytest
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint

from epo_lightning.data import cache
from epo_lightning.data.datamodule import BatchSampler, Share
from epo_lightning.data.drawn import DrawnData
from epo_lightning.data.rpi.scenes import RPIData, RPIDataset
from epo_lightning.registry import ConfigError, build


def records(count=50):
    generator = torch.Generator().manual_seed(count)
    made = {
        "history": torch.rand(count, 2, 19, 4, generator=generator),
        "goals": torch.rand(count, 2, 2, generator=generator),
        "states": torch.rand(count, 2, 2, 40, 4, generator=generator),
        "modes": torch.randint(1, 3, (count,), generator=generator),
        "phi": torch.rand(count, generator=generator),
        "step": torch.randint(18, 61, (count,), generator=generator),
        "game": torch.arange(count) % 5,
        "placement": torch.arange(count) % 4,
    }
    headings = torch.stack((torch.zeros(count), made["phi"]), -1)
    return {**made, "goal_headings": headings, "game_steps": 100 - made["step"]}


@pytest.fixture
def data(tmp_path):
    """A data module over random records, in the folder where its own would be."""

    def make(**settings):
        module = RPIData(root=str(tmp_path), batch_size=8, **settings)
        if not module.folder.exists():
            splits = {name: records(count) for name, count in (("train", 50), ("val", 21), ("test", 22))}
            cache.write(module.folder, splits, module.config, {"size": 50})
        return module

    return make


def order(loader, epoch):
    loader.sampler.set_epoch(epoch)
    return [batch.id.tolist() for batch in loader]


def test_scenes_have_the_documented_fields(data):
    module = data()
    module.setup("fit")
    scene = next(iter(module.train_dataloader()))
    assert scene.history.shape == (8, 2, 19, 4)
    assert scene.future.shape == (8, 2, 40, 4)
    assert scene.goal_candidates.shape == (8, 2, 1, 2)
    assert (scene.size == 0.5).all()
    assert scene.dt == module.task.dt == 0.1
    assert scene.history.dtype == torch.float32
    rows = records(50)
    for i in range(8):
        assert torch.equal(scene.history[i], rows["history"][scene.id[i]])
        assert scene.goal_headings[i, :, 0].tolist() == [0.0, rows["phi"][scene.id[i]].item()]
        assert scene.game_steps[i] == 100 - rows["step"][scene.id[i]]
        assert torch.equal(scene.future[i], rows["states"][scene.id[i], scene.subset[i]])


@pytest.mark.parametrize("targets", ["executed", "sampled", "both"])
def test_targets_are_both_modes_the_executed_or_a_sampled_one(targets):
    rows = records(200)
    dataset = RPIDataset(rows, targets, seed=3)
    seen = dataset[torch.arange(len(dataset))]
    if targets == "executed":
        assert len(dataset) == 200
        assert (seen.subset == 0).all()
    if targets == "both":
        assert len(dataset) == rows["modes"].sum()
        pairs = set(zip(seen.id.tolist(), seen.subset.tolist(), strict=True))
        assert pairs == {(i, m) for i in range(200) for m in range(int(rows["modes"][i]))}
    if targets == "sampled":
        assert len(dataset) == 200
        assert (seen.subset < rows["modes"]).all()
        share = seen.subset[rows["modes"] == 2].float().mean()
        assert 0.3 < share < 0.7
        dataset.set_epoch(1)
        again = dataset[torch.arange(200)]
        assert not torch.equal(again.subset, seen.subset)
        dataset.set_epoch(0)
        assert torch.equal(dataset[torch.arange(200)].subset, seen.subset)


def test_a_share_of_the_games_has_whole_games_within_larger_shares_and_only_in_training(data):
    rows, chosen = records(50), []
    game = (rows["game"] * 10 + rows["placement"]).tolist()  # 20 games of two or three records
    for share in (0.01, 0.1, 0.5):
        module = data(targets="executed", games_share=share)
        module.setup("fit")
        train = module.dataset("train")
        index = [(rows["history"] == history).flatten(1).all(1).nonzero().item() for history in train.history]
        assert train[torch.arange(len(train))].id.tolist() == index, "the numbers of the whole data set"
        games = {game[i] for i in index}
        assert len(games) == max(1, 20 * share)
        assert sorted(index) == [i for i in range(50) if game[i] in games]
        assert len(module.dataset("val")) == 21
        chosen.append(games)
    assert chosen[0] <= chosen[1] <= chosen[2]
    assert len({data(games_share=share).digest for share in (0.01, 0.1, 1.0)}) == 3
    assert data(games_share=1.0).digest == data().digest


@pytest.mark.parametrize("share", [0.0, 1.5, "a", None])
def test_a_share_of_the_games_outside_of_0_and_1_is_refused(data, share):
    with pytest.raises(ConfigError, match=f"data.games_share is {share!r}"):
        data(games_share=share)


def test_sampled_targets_follow_the_seed_of_the_data(data):
    drawn = []
    for seed in (0, 1):
        module = data(targets="sampled", seed=seed)
        module.setup("fit")
        drawn.append(module.dataset("train").mode)
    assert not torch.equal(*drawn)


def test_training_is_shuffled_by_seed_and_epoch_and_drops_the_rest(data):
    module = data(targets="executed")
    module.setup("fit")
    loader = module.train_dataloader()
    first, second = order(loader, 0), order(loader, 1)
    assert len(loader) == len(first) == 6
    assert all(len(batch) == 8 for batch in first)
    assert first != second
    assert order(module.train_dataloader(), 1) == second
    other = data(targets="executed", seed=1)
    other.setup("fit")
    assert order(other.train_dataloader(), 0) != first
    module.order_seed = 1  # a run's seed: the same data in another order
    assert order(module.train_dataloader(), 0) != first


def test_validation_keeps_everything_in_order_and_does_not_change(data):
    module = data(targets="sampled")
    module.setup("fit")
    loader = module.val_dataloader()
    assert [index for batch in order(loader, 0) for index in batch] == list(range(21))
    before = [batch.subset.tolist() for batch in loader]
    loader.sampler.set_epoch(5)
    assert [batch.subset.tolist() for batch in loader] == before


def test_the_test_split_is_loaded_only_in_its_stage(data):
    module = data()
    (module.folder / "test.safetensors").unlink()
    module.setup("fit")
    module.setup("validate")
    with pytest.raises(RuntimeError, match="'test' is not open"):
        module.test_dataloader()
    with pytest.raises(cache.CacheError, match=r"test\.safetensors is missing"):
        module.setup("test")


class Recorder(LightningModule):
    """Notes which records it was given."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen = []

    def training_step(self, scene, _):
        self.seen.append((self.current_epoch, scene.id.tolist(), scene.subset.tolist()))
        return self.weight * scene.history.mean()

    def validation_step(self, scene, _):
        pass

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


def fit(module, folder, epochs, checkpoint=None):
    keep = ModelCheckpoint(folder, filename="{epoch}", save_top_k=-1)
    model = Recorder()
    trainer = Trainer(
        max_epochs=epochs,
        logger=False,
        callbacks=[keep],
        enable_progress_bar=False,
        enable_model_summary=False,
        accelerator="cpu",
        default_root_dir=folder,
    )
    trainer.fit(model, module, ckpt_path=checkpoint)
    return model.seen


@pytest.mark.filterwarnings("ignore:.*dirpath has changed.*")
@pytest.mark.parametrize("targets", ["both", "sampled"])
def test_a_resumed_run_gets_the_same_batches(data, tmp_path, targets):
    whole = fit(data(targets=targets), tmp_path / "a", 4)
    begun = fit(data(targets=targets), tmp_path / "b", 2)
    rest = fit(data(targets=targets), tmp_path / "c", 4, tmp_path / "b" / "epoch=1.ckpt")
    assert begun + rest == whole
    assert len({tuple(ids) for _, ids, _ in whole}) > len(whole) // 2


def pretend_rank(monkeypatch, rank, world):
    """Let this process appear as one of several that train together."""
    for name, value in {"is_initialized": True, "get_rank": rank, "get_world_size": world}.items():
        monkeypatch.setattr(torch.distributed, name, lambda value=value: value)


@pytest.mark.parametrize("world", [2, 4])
@pytest.mark.parametrize("shuffle", [True, False])
def test_the_shares_of_ranks_are_the_batches_of_one_process(monkeypatch, shuffle, world):
    sampler = BatchSampler(RPIDataset(records(51), "executed"), 8, shuffle, 0)
    whole = [batch.tolist() for batch in sampler]
    assert len(whole) == len(sampler) == (6 if shuffle else 7)
    shares = []
    for rank in range(world):
        pretend_rank(monkeypatch, rank, world)
        assert len(sampler) == len(whole)
        shares.append([batch.tolist() for batch in sampler])
        assert all(len(batch) == 8 // world for batch in shares[-1][:6])
        assert all(shares[-1]), "a rank is given an empty batch"
    for number, batch in enumerate(whole):
        parts = [index for share in shares if number < len(share) for index in share[number]]
        assert sorted(batch) == sorted(parts)


def test_a_batch_that_ranks_cannot_share_evenly_is_refused(monkeypatch):
    pretend_rank(monkeypatch, 0, 3)
    with pytest.raises(ConfigError, match=r"data\.batch_size is 8, which trainer\.devices=3 do not divide evenly"):
        next(iter(BatchSampler(RPIDataset(records(51), "executed"), 8, shuffle=True, seed=0)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"batch_size": 1}, r"data\.batch_size is 1, expected a whole number of 2 or more, for batch normalisation"),
        ({"games": 2}, r"data\.games must be a whole number, 3 or more, not 2"),
        ({"placements": 0}, r"data\.placements must be a whole number, 1 or more, not 0"),
        ({"placements": -4}, r"data\.placements .* not -4"),
        ({"placements": 2.5}, r"data\.placements .* not 2\.5"),
        ({"sizes": [10, 0, 10]}, r"data\.sizes .* not 0"),
        ({"sizes": [10, 10]}, "expected three numbers"),
        ({"seed": -1}, "seed is -1"),
        ({"split": "papr"}, r"unknown data\.split 'papr': did you mean 'paper'"),
        ({"targets": "sample"}, "did you mean 'sampled'"),
        ({"solver": "potentail"}, "did you mean 'potential'"),
        ({"plcements": 3}, r"unknown key data\.plcements"),
        ({"recipe": 3}, r"data\.recipe is 3, expected 2, or 1 for data of earlier versions"),
        ({"recipe": 2.0}, r"data\.recipe must be a whole number, 1 or more, not 2\.0"),
        ({"recipe": True}, r"data\.recipe must be a whole number, 1 or more, not True"),
    ],
)
def test_invalid_settings_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        build("data", {"name": "rpi", **settings})


def test_data_of_earlier_versions_keep_their_digest_and_command():
    earlier = RPIData(split="hard", placements=8)
    assert earlier.digest == "a90b8d2bfafc6f96"
    assert earlier.command == "epo generate data=rpi data.recipe=1 data.placements=8 data.split=hard"
    today = RPIData(split="hard", placements=8, recipe=2)
    assert today.command == "epo generate data=rpi data.placements=8 data.split=hard"


def test_the_command_that_makes_a_data_set_has_the_words_of_the_users_command():
    data = RPIData(split="hard")
    data.words = ["data=own", "+data.split=hard", "data.batch_size=8", "--config-dir=a", "--config-dir=b"]
    own = "data=own data.recipe=1 +data.split=hard data.batch_size=8 --config-dir=a --config-dir=b"
    assert data.command == f"epo generate {own}"
    data.words = ["seed=3", "data.seed=${seed}"]
    assert data.command == "epo generate data=rpi data.recipe=1 data.split=hard", (
        "a reference is no word of this command"
    )


def test_the_digest_follows_what_a_run_depends_on(tmp_path):
    base = RPIData(root=str(tmp_path)).digest
    assert RPIData(batch_size=64).digest == base
    for change in (
        {"seed": 1},
        {"games": 5},
        {"split": "hard"},
        {"targets": "executed"},
        {"sizes": None},
        {"recipe": 2},
    ):
        assert RPIData(**change).digest != base
    folders = {RPIData(targets=targets).folder for targets in ("executed", "sampled", "both")}
    assert len(folders) == 1


def test_a_set_that_is_too_small_for_a_batch_is_refused(data):
    module = data()
    module.batch_size = 1000
    module.setup("fit")
    with pytest.raises(ConfigError, match="not one full batch"):
        module.train_dataloader()


def test_a_share_of_every_split_is_the_same_whatever_the_seed(tmp_path):
    whole, part, other = (DrawnData("rpi", scenes=64, **words) for words in ({}, {}, {}))
    for module in (whole, part, other):
        module.setup("fit")
    some = Share(whole.dataset("train"), 0.25)
    assert len(some) == 16
    ids = some[torch.arange(16)].id
    assert torch.equal(ids, Share(part.dataset("train"), 0.25)[torch.arange(16)].id)
    assert len(set(ids.tolist())) > 8
    assert some.chosen[:6].tolist() == [2, 3, 6, 11, 17, 19], "another draw would change tables"
    assert torch.equal(some[torch.tensor([3])].history, whole.dataset("train")[some.chosen[[3]]].history)
    assert len(Share(whole.dataset("train"), 1e-9)) == 1


@pytest.mark.parametrize("share", [0.0, -0.5, 1.5, "a", True])
def test_invalid_shares_are_refused(share):
    with pytest.raises(ConfigError, match=rf"data\.share is {share!r}, expected a number"):
        RPIData(share=share)
