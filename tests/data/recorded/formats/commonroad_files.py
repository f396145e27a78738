"""CommonRoad scenarios as text."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from epo_lightning.data.recorded.formats.commonroad import commonroad

RECTANGLE = "<rectangle><length>5</length><width>2</width></rectangle>"


def exact(value) -> str:
    return f"<exact>{value}</exact>"


def point(x, y) -> str:
    return f"<point><x>{x}</x><y>{y}</y></point>"


def state(time, position, orientation=0.0, velocity=10.0, tag="state") -> str:
    values = {"position": position, "orientation": orientation, "time": time, "velocity": velocity}
    values = {name: value if isinstance(value, str) else exact(value) for name, value in values.items()}
    return f"<{tag}>" + "".join(f"<{name}>{value}</{name}>" for name, value in values.items()) + f"</{tag}>"


def obstacle(identity, states, shape=RECTANGLE, kind="car", version="2020a") -> str:
    initial = states[0].replace("<state>", "<initialState>").replace("</state>", "</initialState>")
    trajectory = f"<trajectory>{''.join(states[1:])}</trajectory>" if len(states) > 1 else ""
    role, tag = ("", "dynamicObstacle") if version == "2020a" else ("<role>dynamic</role>", "obstacle")
    return f'<{tag} id="{identity}">{role}<type>{kind}</type><shape>{shape}</shape>{initial}{trajectory}</{tag}>'


def drive(identity, speeds, y=0.0, **options) -> str:
    """A vehicle along x, one step per speed."""
    x = np.cumsum(speeds) * 0.1
    return obstacle(identity, [state(k, point(x[k], y), velocity=v) for k, v in enumerate(speeds)], **options)


def bound(side: str, y: float, marking: str = "", start: float = 0.0) -> str:
    points = "".join(point(start + x, y) for x in (0.0, 50.0, 100.0))
    return f"<{side}Bound>{points}{marking and f'<lineMarking>{marking}</lineMarking>'}</{side}Bound>"


def lanelet(identity, y=0.0, start=0.0, left="", right="", rest="") -> str:
    bounds = bound("left", y + 2, left, start) + bound("right", y - 2, right, start)
    return f'<lanelet id="{identity}">{bounds}{rest}</lanelet>'


def beside(side, identity, direction="same") -> str:
    return f'<adjacent{side} ref="{identity}" drivingDir="{direction}"/>'


def scenario(*elements: str, version="2020a", step="0.1") -> str:
    head = f'<commonRoad commonRoadVersion="{version}" benchmarkID="USA_A-1_1_T-1" timeStepSize="{step}">'
    problem = '<planningProblem id="1"><initialState/></planningProblem>'
    return f'<?xml version="1.0"?>{head}{"".join(elements)}{problem}</commonRoad>'


ROAD = lanelet(10, 4.0, rest=beside("Right", 20)) + lanelet(20, rest=beside("Left", 10))


CAR = drive(7, [10.0, 11.0, 12.0])


def read(folder: Path, content: str | bytes):
    path = folder / "USA_A-1_1_T-1.xml"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    (source,) = commonroad(folder)
    assert (source.name, source.group, source.files) == (path.stem, path.stem, (path,))
    recording = source.read()
    assert (recording.name, recording.group) == (path.stem, path.stem)
    return recording


def speeds(seed: int, steps: int) -> list[float]:
    return np.round(20 + np.random.default_rng(seed).normal(size=steps).cumsum(), 4).tolist()
