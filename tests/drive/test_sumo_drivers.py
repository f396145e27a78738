"""SUMO's drivers in dense traffic: they brake for reasons of their own, at the same moments whatever the planner does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from multiprocessing import Pipe
from types import SimpleNamespace
from typing import cast

import pytest

from epo_lightning.data.simulate.demand import STYLES
from epo_lightning.data.simulate.traffic import RunningSumo

pytest.importorskip("libsumo", reason="SUMO cannot be loaded", exc_type=ImportError)

from epo_lightning.drive.sumo import SumoSimulator
from epo_lightning.drive.sumo_process import END, OWN, Vehicles, _episode, _Hesitation, _stream

STEPS = 20
Braking = tuple[str, float, float]
"""Name of a vehicle, the speed that it brakes to, and in how many seconds."""


def brakings(names: Sequence[str], seconds: float, speed: float = 30.0, style: str = "dense") -> list[Braking]:
    """What drivers who always have one speed do, as they are asked ten times a second."""
    found: list[Braking] = []
    vehicle = SimpleNamespace(
        getSpeed=lambda name: speed,
        slowDown=lambda name, slower, lasting: found.append((name, slower, lasting)),
    )
    simulation = cast(RunningSumo, SimpleNamespace(libsumo=SimpleNamespace(vehicle=vehicle)))
    hesitate = _Hesitation(STYLES[style], (0, 1, 2))
    for step in range(round(10 * seconds)):
        hesitate(simulation, names, step / 10)
    return found


def test_drivers_brake_as_often_and_as_hard_as_the_style_says() -> None:
    """In dense traffic every 15 s on average, for 1 to 2.5 s, by 2 to 4 m/s^2."""
    names = [f"driver {number}" for number in range(40)]
    found = brakings(names, 600.0)
    assert {name for name, _, _ in found} == set(names)
    assert len(found) == pytest.approx(40 * 600 / 15, rel=0.1)
    assert all(1.0 <= lasting <= 2.5 and 2.0 <= (30.0 - slower) / lasting <= 4.0 for _, slower, lasting in found)
    assert {slower for _, slower, _ in brakings(names, 60.0, speed=1.0)} == {0.0}, "no vehicle drives backwards"
    assert not brakings(names, 600.0, style="free")


def test_a_driver_brakes_at_the_same_moments_whoever_else_is_there() -> None:
    alone, others = brakings(["a"], 300.0), brakings(["c", "a", "b"], 300.0)
    assert len(alone) > 5
    assert [each for each in others if each[0] == "a"] == alone


def test_an_episode_of_dense_traffic_is_driven(monkeypatch: pytest.MonkeyPatch) -> None:
    """The episode is simulated in this process instead of one of its own, after a short warm-up."""

    def end(status: int) -> None:
        raise SystemExit(status)

    monkeypatch.setattr("os._exit", end)
    monkeypatch.setattr("epo_lightning.drive.sumo_process.WARM_UP", 30.0)
    branch = SumoSimulator(1, 0, "dense").branch(0)
    here, there = Pipe()
    streaming = _stream(branch, there)
    road = next(streaming)
    vehicle, found = road.simulation.libsumo.vehicle, list[tuple[str, float, float, float]]()
    slow_down = vehicle.slowDown

    def slowed(name: str, speed: float, seconds: float) -> None:
        found.append((name, road.time, vehicle.getSpeed(name), (vehicle.getSpeed(name) - speed) / seconds))
        slow_down(name, speed, seconds)

    monkeypatch.setattr(vehicle, "slowDown", slowed)
    often = {"dense": replace(STYLES["dense"], every=3.0)}  # most of them in the 4 s of the episode
    monkeypatch.setattr("epo_lightning.drive.sumo_process.STYLES", often)
    begin = road.time
    for message in (*[OWN] * STEPS, END):
        here.send(message)
    with pytest.raises(SystemExit) as ended:
        _episode(there, road, branch)
    streaming.close()
    assert ended.value.code == 0
    taken, _ = here.recv()
    moments = []
    while here.poll():
        moments.append(here.recv())
    assert len(moments) == STEPS
    assert all(isinstance(moment, Vehicles) and taken in moment.names for moment in moments)
    assert taken not in {name for name, *_ in found}, "the planned vehicle is not told to brake"
    braked = 0
    for name, when, speed, rate in found:
        assert 2.0 <= rate <= 4.0 or speed < 10.0, "no vehicle is told to drive backwards"
        step = int((when - begin) / 0.2 + 1e-6)  # the first moment after it
        if step < STEPS and name in moments[step].names:
            assert moments[step].values[moments[step].names.index(name), 2] < speed
            braked += 1
    assert braked > 3
