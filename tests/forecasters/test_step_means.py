"""Means of the losses over an epoch, against Lightning's own log."""

from __future__ import annotations

import lightning
import torch
from torch import Tensor, nn

from epo_lightning.forecasters.step_means import StepMeans


class Both(lightning.LightningModule):
    """A module that logs the same values by Lightning, step by step, and by StepMeans."""

    def __init__(self, values: Tensor, sizes: list[int]) -> None:
        super().__init__()
        self.values, self.sizes, self.epochs = values, sizes, list[dict[str, Tensor]]()
        self.weight = nn.Parameter(torch.zeros(()))
        self.means = StepMeans()

    def training_step(self, batch: Tensor, _: int) -> Tensor:
        step = int(batch)
        value = self.values[step] + self.weight
        self.log("theirs", value, on_step=False, on_epoch=True, batch_size=self.sizes[step])
        self.means.add({"ours": value, "twice": 2 * value}, self.sizes[step])
        return value

    def on_train_epoch_start(self) -> None:
        self.means.reset()

    def on_train_epoch_end(self) -> None:
        self.epochs.append(self.means.means())
        self.log_dict(self.means.means())

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


def test_the_means_of_an_epoch_are_those_of_lightning() -> None:
    sizes = [4, 4, 4, 1]
    module = Both(torch.randn(4), sizes)
    trainer = lightning.Trainer(
        max_epochs=2, logger=False, enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False
    )
    trainer.fit(module, torch.utils.data.DataLoader(torch.arange(4), batch_size=None))  # type: ignore[arg-type]
    assert len(module.epochs) == 2
    assert module.epochs[0]["ours"] != module.epochs[1]["ours"], "the second epoch begins from zero"
    logged = trainer.callback_metrics
    torch.testing.assert_close(logged["ours"], logged["theirs"], rtol=1e-6, atol=0)
    torch.testing.assert_close(logged["twice"], 2 * logged["theirs"], rtol=1e-6, atol=0)


def test_no_step_has_no_mean() -> None:
    assert StepMeans().means() == {}


def test_values_that_change_in_place_are_those_of_their_step() -> None:
    means, value = StepMeans(), torch.tensor(1.0)
    for number in (1.0, 3.0):
        means.add({"loss": value.fill_(number)}, 2)
    assert means.means()["loss"] == 2.0


def test_steps_may_have_other_losses_in_another_order_and_of_one_element() -> None:
    means = StepMeans()
    means.add({"loss": torch.tensor(1.0), "goal": torch.tensor([10.0])}, 1)
    means.add({"goal": torch.tensor([20.0]), "loss": torch.tensor(2.0)}, 3)
    means.add({"loss": torch.tensor(6.0)}, 4)
    assert means.means() == {"loss": (1 + 6 + 24) / 8, "goal": (10 + 60) / 4}
    assert {name: scenes for name, (_, scenes) in means.totals().items()} == {"loss": 8, "goal": 4}
