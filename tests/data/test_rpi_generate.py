"""Generation: equal bytes for any number of workers and interruptions, and records that are consistent."""

from __future__ import annotations

import multiprocessing
import re
import shutil
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks import true_game
from epo_lightning.data import cache
from epo_lightning.data.rpi import generate
from epo_lightning.data.rpi.scenes import RPIData
from epo_lightning.data.rpi.solve import SETTINGS
from epo_lightning.data.rpi.splits import PAPER_SIZES, assign, games_of

SMALL = {"games": 3, "placements": 2, "seed": 1, "recipe": 2}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    made = RPIData(root=str(tmp_path_factory.mktemp("rpi")), **SMALL)
    made.generate(workers=1, progress=False)
    return made


@pytest.fixture(scope="module")
def records(data):
    return {split: load_file(data.folder / f"{split}.safetensors") for split in ("train", "val", "test")}


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_the_bytes_depend_neither_on_a_kill_nor_on_the_workers(data, tmp_path):
    other = RPIData(root=str(tmp_path), **SMALL)
    # A forked process need not import and compile everything again.
    process = multiprocessing.get_context("fork").Process(
        target=other.generate, kwargs={"workers": 1, "progress": False}
    )
    process.start()
    deadline = time.time() + 60
    while not list(tmp_path.glob("rpi-pool-*/game-*.safetensors")):
        assert process.is_alive(), "it ended before it could be killed"
        assert time.time() < deadline
        time.sleep(0.02)
    process.kill()
    process.join()
    parts = {path: path.stat().st_mtime_ns for path in tmp_path.glob("rpi-pool-*/game-*.safetensors")}
    assert not other.folder.exists()
    other.generate(workers=2, progress=False)
    assert contents(other.folder) == contents(data.folder)
    assert all(path.stat().st_mtime_ns == when for path, when in parts.items()), "a finished main game was solved again"


def test_a_broken_part_is_solved_again_and_a_made_set_is_left_alone(data, tmp_path, capfd):
    other = RPIData(root=str(tmp_path), **SMALL)
    pool = next(data.root.glob("rpi-pool-*"))
    (tmp_path / pool.name).mkdir()
    for path in pool.iterdir():
        (tmp_path / pool.name / path.name).write_bytes(path.read_bytes())
    broken = tmp_path / pool.name / "game-0001.safetensors"
    broken.write_bytes(broken.read_bytes()[:-100])
    (broken.parent / ".game-0002.safetensors-0099abcd").write_bytes(b"half")  # of a process killed while it wrote
    other.generate(workers=1, progress=True)
    assert contents(other.folder) == contents(data.folder)
    assert re.fullmatch(r"solving games, 1 to do\ngame 3 of 3 solved, \d+ s\n", capfd.readouterr().err)
    assert not list(broken.parent.glob(".*"))
    before = {path: path.stat().st_mtime_ns for path in other.folder.iterdir()}
    other.generate(workers=1, progress=False)
    assert {path: path.stat().st_mtime_ns for path in other.folder.iterdir()} == before


def test_records_are_in_the_order_of_games_and_placements_whichever_are_solved_first(tmp_path, monkeypatch):
    asked: list[tuple[int, int]] = []

    def in_reverse(function, tasks, *_, **__):
        for _, game, placement, *_ in reversed(tasks):
            asked.append((game, placement))
            values = {"game": np.full(2, game), "placement": np.full(2, placement)}
            yield (0, game, placement), (values, {"solved": 1 + placement})

    monkeypatch.setattr(generate, "finished", in_reverse)
    config = generate.pool_config(0, 3, 2, next(iter(SETTINGS)), 2)
    for _ in range(2):
        records, counts = generate.make_pool(tmp_path, config, 1, False)
        assert records["game"].tolist() == [0] * 4 + [1] * 4 + [2] * 4
        assert records["placement"].tolist() == [0, 0, 1, 1] * 3
        assert counts == {"solved": 3 * (1 + 2)}
    assert asked == [(game, placement) for game in (2, 1, 0) for placement in (1, 0)], "nothing is solved twice"
    asked.clear()
    (file,) = tmp_path.glob("*/game-0001.safetensors")
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    generate.make_pool(tmp_path, config, 1, False)
    assert asked == [(1, 1), (1, 0)], "a number was changed on the disk"


def test_the_data_set_of_another_seed_is_refused(data, tmp_path):
    other = RPIData(root=str(tmp_path), **{**SMALL, "seed": 2})
    shutil.copytree(data.folder, other.folder)
    for use in (lambda: other.setup("fit"), lambda: other.generate(progress=False), other.report):
        with pytest.raises(
            cache.CacheError, match=r"another configuration: it differs in pool\.seed \(1 instead of 2\)"
        ):
            use()


@pytest.mark.parametrize("busy", ["set", "pool"])
def test_generation_waits_for_another_process(data, tmp_path, capsys, busy):
    """A set or pool that another process completes in the meantime is not made again."""
    other = RPIData(root=str(tmp_path), **SMALL)
    pool = next(data.root.glob("rpi-pool-*"))
    making = {"set": data.folder, "pool": pool}[busy]
    with ThreadPoolExecutor(1) as thread:
        with cache.locked(tmp_path / making.name):
            generated = thread.submit(other.generate, workers=1, progress=False)
            said = ""
            while "waiting for it" not in said:
                assert not generated.done(), "it did not wait"
                said += capsys.readouterr().err
                time.sleep(0.01)
            shutil.copytree(making, tmp_path / making.name)
        assert contents(generated.result()) == contents(data.folder)
    assert (tmp_path / pool.name).exists() == (busy == "pool")


def test_splits_share_the_pool(data, monkeypatch):
    def refuse(*_):
        raise AssertionError("solved again")

    monkeypatch.setattr("epo_lightning.data.rpi.generate._play", refuse)
    hard = RPIData(root=str(data.root), split="hard", **SMALL)
    assert hard.generate(workers=1, progress=False) != data.folder


def test_tables_have_documented_shapes_and_are_finite(records):
    for rows in records.values():
        count = len(rows["step"])
        assert rows["history"].shape == (count, 2, 19, 4)
        assert rows["states"].shape == (count, 2, 2, 40, 4)
        assert rows["controls"].shape == (count, 2, 2, 40, 2)
        assert rows["history"].dtype == np.float32
        assert all(np.isfinite(values).all() for values in rows.values())
        assert set(np.unique(rows["modes"])) <= {1, 2}


def test_splits_have_games_of_their_own(records):
    games = [set(rows["game"]) for rows in records.values()]
    assert all(games)
    assert sum(map(len, games)) == len(set.union(*games)) == SMALL["games"]


def test_states_follow_from_controls_by_euler(records):
    rows = records["train"]
    for mode in range(2):
        chosen = rows["modes"] > mode
        states, controls = rows["states"][chosen, mode].astype(float), rows["controls"][chosen, mode].astype(float)
        before = np.concatenate([rows["history"][chosen][:, :, -1:].astype(float), states[:, :, :-1]], 2)
        v, t = before[..., 3], before[..., 2]
        rate = np.stack([v * np.cos(t), v * np.sin(t), controls[..., 1], controls[..., 0]], -1)
        assert np.abs(before + 0.1 * rate - states).max() < 1e-6


def test_executed_modes_satisfy_bellman_and_futures_become_history(records):
    """An executed mode is the rest of the one before, and what was a future becomes history."""
    rows = records["train"]
    pairs = 0
    for i in range(len(rows["step"]) - 1):
        j = i + 1
        if any(rows[name][i] != rows[name][j] for name in ("placement", "executed")):
            continue
        assert rows["step"][j] == rows["step"][i] + 1
        np.testing.assert_allclose(rows["states"][j, 0, :, :-1], rows["states"][i, 0, :, 1:], atol=1e-6)
        np.testing.assert_allclose(rows["history"][j, :, -1], rows["states"][i, 0, :, 0], atol=1e-6)
        np.testing.assert_allclose(rows["history"][j, :, :-1], rows["history"][i, :, 1:], atol=0)
        pairs += 1
    assert pairs > 100


def test_records_end_where_the_agents_pass_each_other(records):
    """Up to the step of the smallest distance, beyond which nothing is left to decide."""
    for rows in records.values():
        position = rows["history"].astype(float)[..., :2]
        distance = np.linalg.norm(position[:, 1] - position[:, 0], axis=-1)
        assert (distance[:, -1] <= distance.min(1) + 1e-9).all()
        assert rows["step"].min() == 18
        assert rows["step"].max() <= 100 - 40


def test_modes_pass_on_different_sides_and_without_contact(records):
    rows = records["train"]
    two = rows["modes"] == 2
    assert 0.2 < two.mean() < 0.7
    assert rows["distance"][:, 0].min() > 0.5
    assert rows["distance"][two, 1].min() > 0.5
    apart = np.linalg.norm(rows["states"][two, 0, ..., :2] - rows["states"][two, 1, ..., :2], axis=-1)
    assert apart.mean((1, 2)).min() > 0.1
    assert (rows["states"][~two, 1] == 0).all()


def test_the_report_covers_the_set(data, records):
    report = data.report()
    assert report["sizes"]["train"]["records"] == len(records["train"]["step"])
    assert report["solver"]["main_converged"] == 1.0
    assert report["nash"]["executed"]["gain_share"] == 0.0
    gains = np.concatenate([rows["gain"][:, 0] for rows in records.values()])
    assert report["nash"]["executed"]["gain"]["1"] == pytest.approx(gains.max())
    keys = ("game", "placement", "executed", "step")
    places = {place for rows in records.values() for place in zip(*(rows[key].tolist() for key in keys), strict=True)}
    followed = [place for place in places if (*place[:-1], place[-1] + 1) in places]
    assert report["nash"]["bellman"] == {"pairs": len(followed), "max": pytest.approx(0.0, abs=1e-6)}
    assert report["motion"]["disc_overlaps"] == 0
    assert 0 < report["motion"]["euler_residual"] < 1e-6, "single precision leaves a residual"
    assert 0.05 < report["baselines"]["constant_velocity"]["executed"]["ade"] < 0.3
    *lines, place = data.summary()
    assert lines[1].split()[:3] == [
        "train",
        str(report["sizes"]["train"]["records"]),
        str(report["sizes"]["train"]["samples"]),
    ]
    assert f"{report['two_modes']['all']:.0%} of the records" in "\n".join(lines)
    assert Path(place.removeprefix("  all statistics: ")).is_file()


def test_paper_sizes_and_disjoint_hard_split():
    random = np.random.default_rng(0)
    game = np.repeat(np.arange(20), 3200)
    phi = random.uniform(-np.pi, np.pi, len(game))
    weights = random.uniform(10, 100, 20)
    paper = assign("paper", 0, weights, game, phi, PAPER_SIZES)
    assert tuple(map(len, paper.values())) == PAPER_SIZES
    assert [len(np.unique(game[index])) for index in paper.values()] == [16, 2, 2]
    hard = assign("hard", 0, weights, game, phi, None)
    assert len(np.unique(np.concatenate(list(hard.values())))) == sum(map(len, hard.values()))
    extreme = games_of("hard", weights)["test"]
    assert set(extreme) == {weights.argmin(), weights.argmax()}
    learned = np.concatenate([hard["train"], hard["val"]])
    angle = np.abs(np.degrees(phi[learned]))
    assert not np.isin(game[learned], extreme).any()
    assert not ((angle > 75) & (angle < 105)).any()


def test_a_missing_set_names_the_command(tmp_path):
    data = RPIData(root=str(tmp_path), **SMALL)
    with pytest.raises(cache.CacheError, match=r"no rpi data at .*`epo generate data=rpi data.seed=1 data.games=3"):
        data.setup("fit")


def test_the_layer_with_the_true_game_reproduces_the_modes(data: RPIData) -> None:
    """From zero controls, with nothing learned, the layer finds the executed mode and the alternative one."""
    _, solver, energy, calibration = true_game.parts([])
    games = true_game.TrueGames.draw(data, "train", 60)
    assert games.both.sum() > 10
    executed, alternative = games.missed(solver, energy, games.game())
    assert executed.max() < 1e-5
    assert alternative.median() < 1e-5
    assert alternative.max() < 0.01
    wrong = games.game(2.0)
    assert games.missed(solver, energy, wrong)[0].mean() > 1e-3
    found = calibration(solver, energy, games.scene, wrong).pair_weights["clearance"][:, 0, 0].square() / 2
    assert (found / games.weight - 1).abs().max() < 0.01, "the history tells the weight"
