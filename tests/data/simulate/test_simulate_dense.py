"""Dense traffic: drivers brake and give way; free traffic is what it was."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from epo_lightning.data.recorded.scenes import RecordedScenes
from epo_lightning.data.recorded.windows import WindowConfig, extract
from epo_lightning.data.simulate import recording, traffic
from epo_lightning.data.simulate.demand import STYLES, Style, write_demand
from epo_lightning.data.simulate.generate import map_path
from epo_lightning.data.simulate.lanelets import write_map
from epo_lightning.data.simulate.layout import LAYOUTS
from epo_lightning.data.simulate.motion import Motion, move
from epo_lightning.data.simulate.network import edges_of
from epo_lightning.data.simulate.traffic import simulate
from epo_lightning.registry import lookup

SEED, RATE = [5, 0], 10


class Vehicles:
    """The part of SUMO's interface that brakes vehicles; all of them drive at 20 m/s."""

    def __init__(self) -> None:
        self.braked: list[tuple[str, float, float]] = []
        self.vehicle = SimpleNamespace(getSpeed=lambda name: 20.0, slowDown=lambda *call: self.braked.append(call))


def test_drivers_brake_as_often_as_long_and_as_hard_as_the_style_says() -> None:
    style = Style(every=20.0, braking=(2.0, 4.0), lasting=(1.0, 2.5))
    sumo, random = Vehicles(), np.random.default_rng(0)
    names = [str(number) for number in range(100)]
    for _ in range(2000):  # 100 drivers for 200 s: 1000 times
        traffic.brake(sumo, names, style, RATE, random)  # type: ignore[arg-type]
    assert len(sumo.braked) == pytest.approx(1000, rel=0.1)
    seconds = np.array([lasting for _, _, lasting in sumo.braked])
    slower = np.array([20.0 - speed for _, speed, _ in sumo.braked])
    assert (seconds.min(), seconds.max()) == (pytest.approx(1.0, abs=0.02), pytest.approx(2.5, abs=0.02))
    assert ((slower / seconds).min(), (slower / seconds).max()) == (
        pytest.approx(2.0, abs=0.02),
        pytest.approx(4.0, abs=0.02),
    )
    assert {name for name, _, _ in sumo.braked} == {*names}


def test_no_vehicle_is_asked_to_drive_backwards() -> None:
    sumo = Vehicles()
    sumo.vehicle.getSpeed = lambda name: 0.5
    traffic.brake(sumo, ["a"], Style(every=1e-9), RATE, np.random.default_rng(0))  # type: ignore[arg-type]
    assert sumo.braked[0][1] == 0.0


def road(folder: Path, style: Style | None, monkeypatch: pytest.MonkeyPatch, seconds: float, warm_up: float) -> Motion:
    pytest.importorskip("libsumo", reason="SUMO cannot be loaded", exc_type=ImportError)
    monkeypatch.setattr(traffic, "WARM_UP", warm_up)
    folder.mkdir()
    options = {} if style is None else {"style": style}
    return move(simulate(LAYOUTS[0], SEED, seconds, folder, RATE, **options), LAYOUTS[0], seconds)


def test_drivers_brake_in_dense_traffic_and_free_traffic_is_the_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    default, free, dense = (
        road(tmp_path / name, style, monkeypatch, seconds=6.0, warm_up=40.0)
        for name, style in (("default", None), ("free", STYLES["free"]), ("dense", STYLES["dense"]))
    )
    for field in dataclasses.fields(Motion):
        one, other = getattr(default, field.name), getattr(free, field.name)
        assert np.array_equal(one, other) if isinstance(one, np.ndarray) else one == other, field.name
    hard = []
    for motion in (free, dense):
        speed, same = np.linalg.norm(motion.velocity, axis=1), np.diff(motion.vehicle) == 0
        hard.append((np.diff(speed)[same] * RATE < -1.5).mean())
    assert hard[1] > 0.02
    assert hard[1] > 3 * hard[0]


def test_a_style_multiplies_the_headways_that_drivers_want(tmp_path: Path) -> None:
    wanted = []
    for headway in (1.0, 0.8):
        random, path = np.random.default_rng(0), tmp_path / "routes.xml"
        rows = write_demand(LAYOUTS[0], edges_of(LAYOUTS[0]), random, 60.0, path, Style(headway=headway))
        wanted.append(np.array([row["tau"] for row in rows]))
    np.testing.assert_allclose(wanted[1], 0.8 * wanted[0], atol=1e-3)


@pytest.mark.slow
def test_a_fifth_of_dense_traffic_is_interactive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shares = []
    for name, style in STYLES.items():
        motion = road(tmp_path / name, style, monkeypatch, seconds=60.0, warm_up=90.0)
        assert sum(motion.dropped.values()) <= 0.05 * len(motion.size)
        recording.write(motion, LAYOUTS[0], 0, tmp_path / name / "set" / "data")
        write_map(LAYOUTS[0], tmp_path / name / "set" / map_path(LAYOUTS[0]))
        (source,) = lookup("format", "exid")(tmp_path / name / "set")
        found, _ = extract(source.read(), WindowConfig())
        assert found is not None
        columns = {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in found.columns().items()}
        scenes = RecordedScenes(columns, 0.2, "aligned", [source.name], "box")
        subset = scenes[torch.arange(len(scenes))].subset
        assert subset is not None
        shares.append(float(subset.double().mean()))
    assert shares[0] < 0.1 < 0.2 < shares[1]
