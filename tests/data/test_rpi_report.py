"""The report about a data set, on records whose numbers are known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from epo_lightning.data.rpi import report
from epo_lightning.data.rpi.subgames import FUTURE, HISTORY, Records

DT = 0.1


def straight(count: int = 3) -> Records:
    """Records, one step after the other, of two agents with constant velocities; the alternative mode is 0.5 m aside."""
    time = DT * np.arange(-HISTORY, FUTURE + count)
    states = np.zeros((2, len(time), 4))
    for agent, (heading, speed, y) in enumerate(((0.0, 1.0, 0.0), (np.pi / 2, 2.0, -6.0))):
        way = speed * time
        states[agent] = np.stack(
            [way * np.cos(heading), way * np.sin(heading) + y, np.full_like(way, heading), np.full_like(way, speed)], -1
        )
    futures = np.stack([states[:, HISTORY + 1 + k : HISTORY + 1 + k + FUTURE] for k in range(count)])
    both = np.stack([futures, futures + np.array([0.5, 0.0, 0.0, 0.0])], 1)
    return {
        "history": np.stack([states[:, k : k + HISTORY + 1] for k in range(count)]),
        "states": both,
        "controls": np.zeros((count, 2, 2, FUTURE, 2)),
        "modes": np.array([2] * (count - 1) + [1]),
        "step": HISTORY + np.arange(count),
        **{name: np.zeros(count, dtype=int) for name in ("game", "placement")},
        "executed": np.ones(count, dtype=int),
        "weight": np.full(count, 50.0),
        "distance": np.full((count, 2), 1.5),
        "cost": np.tile([2.0, 3.0], (count, 1)),
        "gradient": np.tile([1e-5, 2e-5], (count, 1)),
        "gain": np.array([[0.0, 0.0], [1e-3, 0.0], [0.0, 1.0]])[:count],
    }


def test_constant_velocity_is_right_about_agents_that_keep_theirs():
    rows = straight()
    found = report._errors(report.constant_velocity(rows["history"]), rows)
    assert found["executed"] == pytest.approx({"ade": 0.0, "fde": 0.0}, abs=1e-9)
    assert found["alternative"] == pytest.approx({"ade": 0.5, "fde": 0.5})


def test_the_nearest_neighbour_is_the_record_with_the_nearest_history_and_goals():
    """Histories of the test are 0.3 m beside those of the training, and their goals are far from each other."""
    train = {**straight(), "goals": 100.0 * np.arange(3.0)[:, None, None] * np.ones((3, 2, 2))}
    test = {**train, "history": train["history"] + np.array([0.3, 0.0, 0.0, 0.0])}
    found = report._nearest({"train": train, "test": test})
    assert found["executed"] == pytest.approx({"ade": 0.0, "fde": 0.0})
    assert found["alternative"] == pytest.approx({"ade": 0.0, "fde": 0.0})
    assert found["rms_distance_per_step"]["0.5"] == pytest.approx(0.3)


@pytest.mark.parametrize(("starts", "share"), [(8, 0.75), (0, 0.0)])
def test_shares_of_starts_are_of_their_own_games(starts, share):
    counts = {"main_converged": 3, "main_kept": 2, "main_starts": 4, "main_both": 1, "main_games": 2, "sub_games": 5}
    found = report._solver(
        {**counts, "sub_converged": share * starts, "sub_kept": 2, "sub_starts": starts, "sub_dropped": 1}, "newton"
    )
    assert (found["main_converged"], found["main_kept"], found["main_two_modes"]) == (0.75, 0.5, 0.5)
    assert (found["sub_converged"], found["sub_kept"]) == (share, 2 / max(1, starts))


def test_errors_are_means_over_steps_and_those_of_the_last_step():
    rows = straight()
    late = rows["states"][:, 0, ..., :2] + 0.1 * np.arange(1, FUTURE + 1)[:, None] * np.array([0.6, 0.8])
    found = report._errors(late, rows)["executed"]
    assert found == pytest.approx({"ade": 0.1 * (FUTURE + 1) / 2, "fde": 0.1 * FUTURE})


def test_gains_costs_and_the_rest_of_the_mode_before():
    rows = straight()
    found = report._nash(rows)
    assert found["executed"]["gain_share"] == pytest.approx(1 / 3)
    assert found["alternative"]["gain_share"] == 0.0, "the last record has no alternative"
    assert found["alternative"]["gradient_max"]["1"] == 2e-5
    assert found["cost_ratio"]["0.5"] == 1.5
    assert found["bellman"] == {"pairs": 2, "max": pytest.approx(0.0, abs=1e-9)}
    rows["states"][1, 0, 1, 7, 2] += 0.3
    assert report._bellman(rows)["max"] == pytest.approx(0.3)
    rows["game"][:] = np.arange(3)
    assert report._bellman(rows) == {"pairs": 0, "max": 0.0}


def test_motion_is_measured_in_metres_and_seconds():
    rows = straight()
    rows["controls"][..., 0] = 0.1 * (-1.0) ** np.arange(FUTURE)
    found = report._motion(rows, np.array([50.0, 90.0]))
    assert found["acceleration_99"] == pytest.approx(0.1)
    assert found["jerk_99"] == pytest.approx(0.2 / DT)
    assert found["sade_between_modes"]["0.5"] == pytest.approx(0.5)
    assert found["median_distance_by_weight"] == [[50.0, 1.5]]
    assert found["euler_residual"] == pytest.approx(0.1 * DT), "these controls did not make these states"
    between = np.linalg.norm(rows["states"][:, 0, 0, :, :2] - rows["states"][:, 0, 1, :, :2], axis=-1)
    assert found["distance_executed"]["0"] == pytest.approx(between.min())
    assert found["disc_overlaps"] == 0


def splits() -> dict[str, Records]:
    """Three games that are perfect but for one gain of either mode, one state of the test and one pair of agents.

    The agents of the training and the test come as near to each other as 2.68 m, those of the validation as near as 0.4 m.
    """
    found = {}
    for game, (name, count) in enumerate((("train", 3), ("val", 1), ("test", 3))):
        rows = straight(count)
        goals = 100.0 * np.arange(count)[:, None, None] * np.ones((count, 2, 2))
        found[name] = {**rows, "goals": goals, "game": np.full(count, game), "gain": np.zeros((count, 2))}
    found["train"]["gain"][1, 0] = 1e-3
    found["test"]["gain"][0, 1] = 2e-3
    found["test"]["states"][0, 0, 1, -1, 0] += 0.1
    # The robot is at (t, 0) and the pedestrian at (0, 2 t - 6): they are nearest at t = 2.4 s, 2.4 m and 1.2 m apart.
    nearer = (1 - 0.4 / np.hypot(2.4, 1.2)) * np.array([2.4, 1.2, 0.0, 0.0])
    found["val"]["history"][:, 1] += nearer
    found["val"]["states"][:, :, 1] += nearer
    found["val"].update(weight=np.array([20.0]), distance=np.full((1, 2), 0.4), step=np.array([28]))
    return found


def described() -> dict[str, Any]:
    main = {"main_starts": 8, "main_converged": 6, "main_kept": 4, "main_games": 3, "main_both": 2}
    sub = {"sub_starts": 10, "sub_converged": 9, "sub_kept": 5, "sub_games": 8, "sub_dropped": 1}
    return report.describe(splits(), {**main, **sub}, np.array([50.0, 20.0]), {"solver": "newton"})


def test_what_is_not_perfect_is_in_the_report() -> None:
    """Seven records, four of which have an alternative mode."""
    found = described()
    nash, motion = found["nash"], found["motion"]
    assert nash["executed"]["gain_share"] == pytest.approx(1 / 7)
    assert nash["executed"]["gain"] == pytest.approx(
        {"0": 0.0, "0.5": 0.0, "0.9": 0.4e-3, "0.99": 0.94e-3, "1": 1e-3}  # between the sixth and the seventh
    )
    assert nash["alternative"]["gain_share"] == pytest.approx(1 / 4)
    assert nash["alternative"]["gain"]["1"] == pytest.approx(2e-3)
    assert nash["bellman"] == {"pairs": 4, "max": pytest.approx(0.1)}
    assert motion["euler_residual"] == pytest.approx(0.1)
    assert motion["disc_overlaps"] == 1, "0.4 m are less than the 0.5 m of two radii"
    assert motion["distance_executed"]["0"] == pytest.approx(0.4)
    assert motion["distance_alternative"]["0"] == pytest.approx(np.hypot(2.4, 1.2))
    assert motion["median_distance_by_weight"] == [[20.0, 0.4], [50.0, 1.5]]


def test_an_overlap_of_the_alternative_mode_counts_as_well() -> None:
    rows = straight()
    rows["states"][:2, 1, 1, 5, :2] = rows["states"][:2, 1, 0, 5, :2]
    assert report._motion(rows, np.array([50.0]))["disc_overlaps"] == 2
    rows["modes"][:] = 1
    rows["states"][:2, 1] = 0.0  # as records without an alternative have it
    rows["modes"][2] = 2
    assert report._motion(rows, np.array([50.0]))["disc_overlaps"] == 0


def test_sizes_and_shares_of_two_modes_are_those_of_the_splits() -> None:
    found = described()
    assert found["sizes"] == {
        "train": {"records": 3, "samples": 5, "games": 1},
        "val": {"records": 1, "samples": 1, "games": 1},
        "test": {"records": 3, "samples": 5, "games": 1},
    }
    assert found["weights"] == {"train": [50.0], "val": [20.0], "test": [50.0]}
    shares = {"all": 4 / 7, "1.8-2.7 s": 4 / 6, "2.8-3.7 s": 0.0}
    assert found["two_modes"] == pytest.approx(shares)
    assert found["solver"]["solver"] == "newton"
    assert (found["solver"]["sub_games"], found["solver"]["sub_games_dropped"]) == (8, 1)


def test_baselines_miss_the_test_by_what_is_not_straight_in_it() -> None:
    """One of 3 x 2 x 40 positions is 0.1 m aside, the last one of its agent; the alternative modes are 0.5 m aside."""
    found = described()["baselines"]
    aside = pytest.approx({"ade": 0.1 / 240, "fde": 0.1 / 6}, abs=1e-9)
    assert found["constant_velocity"]["executed"] == aside
    assert found["constant_velocity"]["alternative"] == pytest.approx({"ade": 0.5, "fde": 0.5})
    assert found["nearest_neighbour"]["executed"] == aside
    assert found["nearest_neighbour"]["alternative"] == pytest.approx({"ade": 0.0, "fde": 0.0})
