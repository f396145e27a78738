"""Whether the side on which the agents will pass each other can be known when the forecast is made.

If it could not, no forecaster could give the executed mode a higher probability than the alternative one, and its most
likely mode would be the wrong one in half of the scenes. It can: a record's history shows 1.8 s of the executed mode.
"""

from __future__ import annotations

import numpy as np

from epo_lightning.data.rpi.game import Array
from epo_lightning.data.rpi.subgames import Records


def shown_by_history(records: Records) -> dict[str, float]:
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


def _rotation(states: Array) -> Array:
    """Total rotation [rad] of the line of sight from agent 0 to agent 1, [B], of states [B, 2, K, 4]."""
    sight = states[:, 1, :, :2] - states[:, 0, :, :2]
    angle = np.unwrap(np.arctan2(sight[..., 1], sight[..., 0]), axis=-1)
    return angle[:, -1] - angle[:, 0]
