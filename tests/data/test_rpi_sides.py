"""The side on which the agents pass each other, which the history of a record shows when the forecast is made.

If it did not, no forecaster could give the executed mode a higher probability than the alternative one, and its most
likely mode would be the wrong one in half of the scenes. A record's history shows 1.8 s of the executed mode.
"""

from __future__ import annotations

import numpy as np
import pytest
from safetensors.numpy import load_file

from epo_lightning.data.rpi.scenes import RPIData


def shown_by_history(records) -> dict[str, float]:
    """Share of the records with two modes whose executed side the history shows, by two rules; NaN without such records.

    - ``rotation``: the line of sight between the agents has turned, over the history, in the direction in which it turns in
      the executed mode. This rule reads nothing but the history.
    - ``continuation``: the executed mode continues the last observed changes of heading and speed more closely than the
      alternative mode does. A forecaster that has both modes can choose one by this rule.
    """
    two = records["modes"] == 2
    if not two.any():
        return {"rotation": float("nan"), "continuation": float("nan")}
    history, states = (records[name][two].astype(np.float64) for name in ("history", "states"))
    now = history[:, :, -1]
    seen = _rotation(history)
    to_come = _rotation(np.concatenate((now[:, :, None], states[:, 0]), axis=2))
    last = (now - history[:, :, -2])[..., 2:]
    jumps = [np.abs(states[:, mode, :, 0, 2:] - now[..., 2:] - last).sum((1, 2)) for mode in (0, 1)]
    return {
        "rotation": float((np.sign(seen) == np.sign(to_come)).mean()),
        "continuation": float((jumps[0] < jumps[1]).mean()),
    }


def _rotation(states):
    """Total rotation [rad] of the line of sight from agent 0 to agent 1, [B], of states [B, 2, K, 4]."""
    sight = states[:, 1, :, :2] - states[:, 0, :, :2]
    angle = np.unwrap(np.arctan2(sight[..., 1], sight[..., 0]), axis=-1)
    return angle[:, -1] - angle[:, 0]


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    made = RPIData(root=str(tmp_path_factory.mktemp("rpi")), games=3, placements=2, seed=1, recipe=2)
    made.generate(workers=1, progress=False)
    return {split: load_file(made.folder / f"{split}.safetensors") for split in ("train", "val", "test")}


def test_the_history_shows_the_executed_side_of_every_record(records):
    """So the most likely mode of a forecast can be the executed one. Exchanging the modes makes both rules wrong."""
    for split in records.values():
        assert shown_by_history(split) == {"rotation": 1.0, "continuation": 1.0}
        exchanged = {**split, "states": split["states"][:, ::-1]}
        assert shown_by_history(exchanged) == {"rotation": 0.0, "continuation": 0.0}


def test_the_share_is_that_of_the_records_with_two_modes(records):
    train = records["train"]
    two = {name: values[train["modes"] == 2] for name, values in train.items()}
    assert 5 < len(two["modes"]) < len(train["modes"])
    mixed = {**two, "states": two["states"].copy()}
    mixed["states"][:5] = two["states"][:5, ::-1]
    share = 1 - 5 / len(two["modes"])
    assert shown_by_history(mixed) == pytest.approx({"rotation": share, "continuation": share})
    alone = {**two, "modes": np.ones_like(two["modes"])}
    assert all(np.isnan(value) for value in shown_by_history(alone).values())
