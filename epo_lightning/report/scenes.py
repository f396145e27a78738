"""Traffic scenes: joint forecasts on their lanes, as in the paper's Figs. 4, 10 and 11, as pictures and short animations.

A picture is turned so that the road runs to the right, and everything in it is drawn to scale: both axes are in metres, and
agents have their size.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Bool, Float
from matplotlib.animation import FFMpegWriter
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch, Polygon
from matplotlib.path import Path as Outline
from matplotlib.ticker import MaxNLocator

from epo_lightning.registry import ConfigError
from epo_lightning.report.style import HISTORY, LANE, ROAD, TRUTH, VEHICLES, save, style
from epo_lightning.run_folder import whole_file
from epo_lightning.scene import HEADING, KINDS, SPEED, JointForecast, Scene

Color = str | tuple[float, float, float]

LONGEST = 250.0
"""Length of the piece of road that a picture shows at most [m], as in the paper."""
MOST_MODES = 6
"""Panels that a picture of one forecaster has at most."""
MOST_NAMED = len(VEHICLES)
"""Agents that the legend names at most: beyond, colours repeat."""
LANE_WIDTH = 3.1
"""Width of the band that stands for a lane [m]: a little less than lanes have, so that lanes side by side stay apart."""
CAR = (4.5, 1.8)
"""Length and width of an agent of unknown size [m]."""
WIDTH, LEFT, TITLE, AXIS, ROW = 8.6, 0.5, 0.27, 0.42, 0.2
"""Width of a picture, margins left of, above and below a panel, height of a line of the legend [inch]."""
FRAME, HOLD = 0.1, 1.2
"""Longest time between two frames of an animation, and how long its last one stays [s]."""
PALE = 0.3
"""Strength of the colour with which a forecast begins."""
ANIMATION_DPI = 100
COLORS = 128
"""Palette size of a GIF."""


def highway_scene(scene: Scene, forecast: JointForecast, path: str | Path, title: str = "") -> Path:
    """One scene and all joint modes, one panel each, the most likely one first (Figs. 10 and 11).

    An agent has one colour, which grows stronger with the predicted steps; the ground truth goes from grey to black. Full
    vehicles stand at t0, light ones where the forecast ends, outlined ones where the ground truth ends.

    Args:
        scene: one scene (B = 1); the future, the map, sizes and kinds are drawn where they are known.
        forecast: of this scene; where the game has goals, those are stars. What is not finite is said in its panel.
        path: of the PNG.
        title: of the picture.

    Raises:
        ValueError: not exactly one scene, or a scene without agents.
    """
    order = _by_probability(forecast)
    futures = [_future(forecast, m, f"mode {m + 1}") for m in order[:MOST_MODES]]
    if len(order) > MOST_MODES:
        title = ": ".join(filter(None, (title, f"the {MOST_MODES} most likely of {len(order)} modes")))
    return _picture(scene, futures, path, title)


def highway_comparison(scene: Scene, forecasts: Mapping[str, JointForecast], path: str | Path, title: str = "") -> Path:
    """The most likely joint mode of several forecasters on one scene, one panel each (Fig. 4).

    Args:
        scene, path, title: as for :func:`highway_scene`.
        forecasts: of this scene, by the name of the row in the tables.

    Raises:
        ValueError: as for :func:`highway_scene`, or there is no forecast.
    """
    if not forecasts:
        raise ValueError("a comparison without a forecast: nothing to draw")
    futures = [_future(forecast, _by_probability(forecast)[0], name) for name, forecast in forecasts.items()]
    return _picture(scene, futures, path, title)


def animate(scene: Scene, forecast: JointForecast, path: str | Path, title: str = "") -> Path:
    """The history and then the most likely joint mode, moving in real time, with the ground truth as outlines.

    Args:
        scene, forecast, title: as for :func:`highway_scene`.
        path: of the animation, by its ending a GIF (the same scene gives the same bytes) or an MP4.

    Raises:
        ConfigError: another ending, or an MP4 where there is no ffmpeg.
        ValueError: as for :func:`highway_scene`.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in (".gif", ".mp4"):
        raise ConfigError(f"{path}: an animation is a .gif or, where ffmpeg is installed, an .mp4")
    if ending == ".mp4" and not FFMpegWriter.isAvailable():
        raise ConfigError(f"{path}: an .mp4 needs the program ffmpeg, which is not installed; choose a .gif instead")
    ground = _Ground.of(scene)
    future = ground.turned(_future(forecast, _by_probability(forecast)[0], title))
    parts = max(1, round(ground.dt / FRAME))
    with style():
        figure, (axes,) = _layout(ground, [future], "", moving=True)
        _draw_road(axes, ground)
        frames = _moving(axes, ground, future, parts)
        with whole_file(path, ending) as temporary:
            write = _write_gif if ending == ".gif" else _write_mp4
            write(figure, frames, ground.dt / parts, temporary)
    return path


@dataclass(frozen=True)
class _Future:
    """One joint mode of one scene."""

    title: str
    states: Float[np.ndarray, "N K 4"]
    goals: Float[np.ndarray, "N 2"] | None


@dataclass(frozen=True)
class _Ground:
    """One scene in the frame of its picture: the main direction to the right, the agents around zero.

    Agents that do not exist are left out. The history and the future are one sequence of T steps, in which ``now`` is t0.
    """

    states: Float[np.ndarray, "N T 4"]
    seen: Bool[np.ndarray, "N T"]
    now: int
    dt: float
    present: Bool[np.ndarray, " A"]
    names: Sequence[str]
    size: Float[np.ndarray, "N 2"] | None
    disc: Bool[np.ndarray, " N"]
    road: Float[np.ndarray, "S 2 2"] | None
    origin: Float[np.ndarray, " 2"]
    angle: float

    @classmethod
    def of(cls, scene: Scene) -> _Ground:
        if len(scene.history) != 1:
            raise ValueError(f"a picture shows one scene, not {len(scene.history)}: choose one with scene[index]")
        present = _array(scene.agent_mask)
        states, seen = _array(scene.history)[present], _array(scene.history_mask)[present]
        now = states.shape[1] - 1
        if scene.future is not None:
            states = np.concatenate([states, _array(scene.future)[present]], axis=1)
            seen = np.concatenate([seen, _array(scene.future_mask)[present]], axis=1)
        seen = seen & np.isfinite(states).all(-1)
        if not seen[:, now].any():
            raise ValueError("a picture of a scene without an agent at t0: there is nothing to draw")

        size = None if scene.size is None else _array(scene.size)[present]
        kinds = None if scene.kind is None else [KINDS[kind] for kind in _array(scene.kind)[present]]
        if kinds is not None:
            disc = np.array([kind == "pedestrian" for kind in kinds])
        else:
            disc = np.zeros(len(states), bool) if size is None else size[:, 0] == size[:, 1]
        numbers = [i + 1 for i in np.flatnonzero(present)]
        names = (
            [f"agent {n}" for n in numbers]
            if kinds is None
            else [f"{n} {k}" for n, k in zip(numbers, kinds, strict=True)]
        )

        road = None
        if scene.lanes is not None:
            road = _array(scene.lanes)[_array(scene.lane_mask)]
            road = road[np.isfinite(road).all(-1)].reshape(-1, 2, 2)
        origin, angle = np.zeros(2), 0.0
        if road is not None or not disc.all():
            current = states[seen[:, now], now]
            origin, angle = current[:, :2].mean(0), _direction(current[:, HEADING], current[:, SPEED])
            states = _turned(states, origin, angle)
            road = None if road is None else _rotated(road, origin, angle)
        return cls(states, seen, now, scene.dt, present, names, size, disc, road, origin, angle)

    @property
    def is_road(self) -> bool:
        return self.road is not None or not self.disc.all()

    def turned(self, future: _Future) -> _Future:
        """A forecast of this scene, in the frame of the picture."""
        states = _turned(future.states[self.present], self.origin, self.angle)
        goals = None if future.goals is None else _rotated(future.goals[self.present], self.origin, self.angle)
        return _Future(future.title, states, goals)

    def region(self, futures: Sequence[_Future]) -> tuple[np.ndarray, np.ndarray]:
        """Corners of what is shown: all that was observed and, within reason, all that was forecast."""
        margin, least, beyond = (5.0, (80.0, 18.0), (LONGEST, 12.0)) if self.is_road else (1.0, (8.0, 6.0), (8.0, 5.0))
        reach = 0.0 if self.size is None else float(np.nanmax(self.size[:, 0])) / 2
        known = self.states[..., :2][self.seen]
        low, high = known.min(0), known.max(0)
        points = [f.states[..., :2].reshape(-1, 2) for f in futures] + [f.goals for f in futures if f.goals is not None]
        forecast = np.concatenate(points)
        forecast = forecast[np.isfinite(forecast).all(-1)].clip(low - beyond, high + beyond)
        everything = np.concatenate([known, forecast])
        around = np.array([margin + reach, margin])
        low, high = everything.min(0) - around, everything.max(0) + around
        missing = np.maximum(least - (high - low), 0) / 2
        low, high = low - missing, high + missing
        now = np.median(self.states[self.seen[:, self.now], self.now, :2], axis=0)
        for axis, behind in ((0, 1 / 3), (1, 1 / 2)):  # keep t0 in sight, and more of what comes than of what was
            if high[axis] - low[axis] > LONGEST:
                low[axis] = np.clip(now[axis] - behind * LONGEST, low[axis], high[axis] - LONGEST)
                high[axis] = low[axis] + LONGEST
        return low, high


def _array(values: Any) -> np.ndarray:
    """The first scene of a tensor, as an array in double precision if it has a fraction."""
    values = values[0].detach().cpu()
    return (values.double() if values.is_floating_point() else values).numpy()


def _by_probability(forecast: JointForecast) -> list[int]:
    return [int(m) for m in np.argsort(-_array(forecast.probabilities), kind="stable")]


def _future(forecast: JointForecast, mode: int, name: str) -> _Future:
    goals = None if forecast.parameters is None else forecast.parameters.goals
    title = f"p = {_array(forecast.probabilities)[mode]:.2f}"
    return _Future(
        f"{name},  {title}" if name else title,
        _array(forecast.states)[mode],
        None if goals is None else _array(goals)[mode],
    )


def _direction(heading: Float[np.ndarray, " N"], speed: Float[np.ndarray, " N"]) -> float:
    """The direction in which most of the traffic flows: oncoming traffic is on the same road."""
    weight = np.abs(speed) + 0.1
    angle = float(np.angle((weight * np.exp(2j * heading)).sum())) / 2
    return angle if (weight * np.cos(heading - angle)).sum() >= 0 else angle + np.pi


def _rotated(points: Float[np.ndarray, "*S 2"], origin: np.ndarray, angle: float) -> Float[np.ndarray, "*S 2"]:
    x, y = np.moveaxis(points - origin, -1, 0)
    with np.errstate(invalid="ignore"):  # infinity times zero: what is not finite is left out later
        return np.stack([np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x], axis=-1)


def _turned(states: Float[np.ndarray, "*S 4"], origin: np.ndarray, angle: float) -> Float[np.ndarray, "*S 4"]:
    heading = states[..., HEADING, None] - angle
    return np.concatenate([_rotated(states[..., :2], origin, angle), heading, states[..., SPEED, None]], axis=-1)


def _picture(scene: Scene, futures: Sequence[_Future], path: str | Path, title: str) -> Path:
    ground = _Ground.of(scene)
    futures = [ground.turned(future) for future in futures]
    with style():
        figure, panels = _layout(ground, futures, title)
        for axes, future in zip(panels, futures, strict=True):
            _draw_road(axes, ground)
            _draw_known(axes, ground)
            _draw_future(axes, ground, future)
        return save(figure, path)


def _layout(
    ground: _Ground, futures: Sequence[_Future], title: str, moving: bool = False
) -> tuple[Figure, Sequence[Axes]]:
    """Panels in which a metre is a metre in both directions, one below the other if they are long and flat."""
    low, high = ground.region(futures)
    shape = float((high - low)[1] / (high - low)[0])
    columns = min(len(futures), 1 if shape < 0.3 else 2 if shape < 0.7 else 3)
    rows = -(-len(futures) // columns)
    panel = min(WIDTH / columns, 4.5) if shape >= 0.7 else WIDTH / columns
    wide = panel - LEFT - 0.1
    tall = wide * shape
    width = panel * columns
    entries = int(width / 1.05)
    legends = [handles for handles in (_named(ground), _explained(ground, futures, moving)) if handles]
    lines = [-(-len(handles) // entries) for handles in legends]
    legend = ROW * sum(lines) + 0.05
    top = 0.22 if title else 0.0
    # Whole pixels in both directions, and an even number of them: films ask for it.
    height = round((rows * (tall + TITLE) + AXIS + legend + top) * 50) / 50
    figure = Figure(figsize=(round(width * 50) / 50, height))
    panels = []
    for index in range(len(futures)):
        row, column = divmod(index, columns)
        bottom = height - top - (row + 1) * (tall + TITLE)
        box = ((column * panel + LEFT) / width, bottom / height, wide / width, tall / height)
        axes = figure.add_axes(box)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.grid(visible=False)
        axes.yaxis.set_major_locator(MaxNLocator(max(2, int(tall / 0.3)), steps=[1, 2, 5, 10]))
        axes.set_ylabel("[m]" if ground.is_road else "y [m]" if column == 0 else "", labelpad=2)
        if index + columns < len(futures):
            axes.tick_params(labelbottom=False)
        else:
            axes.set_xlabel("along the road [m]" if ground.is_road else "x [m]", labelpad=2)
        panels.append(axes)
    if title:
        figure.text(LEFT / width, 1 - 0.06 / height, title, va="top", weight="bold", fontsize=10)
    for place, handles in enumerate(legends):
        figure.legend(
            handles=handles,
            loc="lower center",
            bbox_to_anchor=(0.5, ROW * sum(lines[:place]) / height),
            ncols=min(entries, len(handles)),
            fontsize=8,
            handlelength=1.6,
            columnspacing=1.4,
            borderaxespad=0,
            borderpad=0.2,
        )
    return figure, panels


def _draw_road(axes: Axes, ground: _Ground) -> None:
    """Lanes as light bands with a line in the middle, as far as they are in the picture."""
    if ground.road is None:
        return
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    segments = shapely.linestrings(ground.road[(ground.road[:, 0] != ground.road[:, 1]).any(-1)])
    region = shapely.box(left, bottom, right, top).buffer(LANE_WIDTH)
    lines = shapely.line_merge(shapely.union_all(segments[shapely.intersects(segments, region)]))
    surface = shapely.intersection(lines.buffer(LANE_WIDTH / 2, cap_style="square"), region)
    for piece in shapely.get_parts(surface):
        rings = [np.asarray(ring.coords) for ring in (piece.exterior, *piece.interiors)]
        outline = Outline.make_compound_path(*(Outline(ring, closed=True) for ring in rings))
        axes.add_patch(PathPatch(outline, fc=ROAD, ec="none", zorder=0))
    middle = [np.asarray(line.coords) for line in shapely.get_parts(lines)]
    axes.add_collection(LineCollection(middle, colors=LANE, lw=0.6, ls=(0, (6, 4)), zorder=0.5), autolim=False)


def _draw_known(axes: Axes, ground: _Ground) -> None:
    """Agents at t0, where they had been, where they went and how they stood in the end."""
    for i in range(len(ground.states)):
        states, seen = ground.states[i], ground.seen[i]
        _fading(axes, states[:, :2], seen, HISTORY, TRUTH, width=1.0, zorder=4)
        after = np.flatnonzero(seen[ground.now + 1 :])
        if len(after):
            _agent(axes, ground, i, states[ground.now + 1 + after[-1]], fc="none", ec=TRUTH, lw=0.8, zorder=5)
        if seen[ground.now]:
            _agent(axes, ground, i, states[ground.now], fc=_color(i), ec="#222222", lw=0.6, zorder=6)


def _draw_future(axes: Axes, ground: _Ground, future: _Future) -> None:
    """A joint mode, and what cannot be drawn of it."""
    axes.set_title(future.title, loc="left", fontsize=9, pad=3)
    positions, finite = _with_start(ground, future)
    for i in range(len(positions)):
        _fading(axes, positions[i, :, :2], finite[i], _mixed("white", _color(i), PALE), _color(i), width=3.0, zorder=2)
        if finite[i, -1]:
            _agent(axes, ground, i, positions[i, -1], fc=(*to_rgb(_color(i)), 0.3), ec=_color(i), lw=0.7, zorder=3)
        if future.goals is not None and np.isfinite(future.goals[i]).all():
            axes.plot(*future.goals[i], "*", ms=7, mfc=_color(i), mec="#222222", mew=0.5, zorder=7)
    if note := _note(axes, ground, future):
        axes.set_title(note, loc="right", fontsize=8, pad=3, color="#B00020")


def _note(axes: Axes, ground: _Ground, future: _Future) -> str:
    """Note on what a panel does not show."""
    broken = [i for i in range(len(future.states)) if not np.isfinite(future.states[i]).all()]
    now = ground.states[ground.seen[:, ground.now], ground.now, :2]
    low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
    outside = int(((now < low) | (now > high)).any(1).sum())
    notes = []
    if len(broken) == len(future.states):
        notes.append("the forecast is not finite")
    elif broken:
        notes.append(f"not finite: {', '.join(ground.names[i] for i in broken[:3])}{' ...' if broken[3:] else ''}")
    if outside:
        notes.append(f"{outside} agent{'s' if outside > 1 else ''} farther away")
    return "; ".join(notes)


def _with_start(ground: _Ground, future: _Future) -> tuple[Float[np.ndarray, "N K+1 4"], Bool[np.ndarray, "N K+1"]]:
    """A joint mode from t0 on, and which of its states can be drawn."""
    states = np.concatenate([ground.states[:, ground.now, None], future.states], axis=1)
    finite = np.isfinite(future.states).all(-1)
    return states, np.concatenate([ground.seen[:, ground.now, None], finite], axis=1)


def _fading(
    axes: Axes,
    positions: Float[np.ndarray, "T 2"],
    mask: Bool[np.ndarray, " T"],
    start: Color,
    end: Color,
    width: float,
    zorder: float,
) -> LineCollection:
    """A trajectory whose colour goes from ``start`` to ``end`` with time, with gaps where the mask has them."""
    share = np.linspace(0, 1, max(len(positions) - 1, 1))[:, None]
    colors = (1 - share) * np.array(to_rgb(start)) + share * np.array(to_rgb(end))
    drawn = mask[:-1] & mask[1:]
    segments = np.stack([positions[:-1], positions[1:]], axis=1)[drawn]
    lines = LineCollection(
        list(segments), colors=colors[: len(drawn)][drawn], lw=width, zorder=zorder, capstyle="round"
    )
    axes.add_collection(lines, autolim=False)
    return lines


def _agent(axes: Axes, ground: _Ground, i: int, state: Float[np.ndarray, " 4"], **look: Any) -> list[Artist]:
    """An agent to scale: a disc, or a box (a car's where no size is known); a full one has a triangle that points ahead."""
    x, y, heading, _ = state
    length, width = CAR if ground.size is None else ground.size[i]
    if ground.disc[i]:
        ring = np.linspace(0, 2 * np.pi, 25)[:-1]
        return [
            axes.add_patch(Polygon(np.stack([x + length / 2 * np.cos(ring), y + length / 2 * np.sin(ring)], 1), **look))
        ]
    forward = np.array([np.cos(heading), np.sin(heading)])
    left = np.array([-forward[1], forward[0]])

    def at(points: Sequence[tuple[float, float]]) -> np.ndarray:
        return np.array([x, y]) + np.array([a * forward + b * left for a, b in points])

    a, b = length / 2, width / 2
    box = Polygon(at([(a, b), (-a, b), (-a, -b), (a, -b)]), **look)
    tip, reach = a - 0.12 * width, 0.75 * width
    front = Polygon(
        at([(tip, 0), (tip - reach, 0.6 * b), (tip - reach, -0.6 * b)]), fc="white", ec="none", zorder=look["zorder"]
    )
    return [axes.add_patch(box), *([] if look["fc"] == "none" else [axes.add_patch(front)])]


def _moving(axes: Axes, ground: _Ground, future: _Future, parts: int) -> Iterator[float]:
    """Draw one moment after another, ``parts`` per time step; yields its time [s]."""
    note = _note(axes, ground, future)
    axes.set_title(f"{future.title}{note and f' ({note})'}", loc="left", fontsize=9, pad=3)
    clock = axes.set_title("", loc="right", fontsize=9, pad=3)
    predicted, finite = _with_start(ground, future)
    now, last = ground.now, max(ground.states.shape[1] - 1, ground.now + predicted.shape[1] - 1)
    for t in np.arange(last * parts + 1) / parts:
        clock.set_text(f"t = {(t - now) * ground.dt:+.1f} s")
        drawn: list[Artist] = []
        for i in range(len(ground.states)):
            path, seen = _until(ground.states[i], ground.seen[i], t)
            latest = _mixed(HISTORY, TRUTH, t / last)
            drawn.append(_fading(axes, path[:, :2], seen, HISTORY, latest, width=1.0, zorder=4))
            if t > now:
                if seen[-1]:
                    drawn += _agent(axes, ground, i, path[-1], fc="none", ec=TRUTH, lw=0.9, zorder=7)
                path, seen = _until(predicted[i], finite[i], t - now)
                pale = _mixed("white", _color(i), PALE)
                strong = _mixed(pale, _color(i), min(1.0, (t - now) / (predicted.shape[1] - 1)))
                drawn.append(_fading(axes, path[:, :2], seen, pale, strong, width=3.0, zorder=2))
            if seen[-1]:
                drawn += _agent(axes, ground, i, path[-1], fc=_color(i), ec="#222222", lw=0.6, zorder=6)
        yield float((t - now) * ground.dt)
        for artist in drawn:
            artist.remove()


def _until(
    states: Float[np.ndarray, "T 4"], seen: Bool[np.ndarray, " T"], t: float
) -> tuple[Float[np.ndarray, "S 4"], Bool[np.ndarray, " S"]]:
    """The part of a track until step ``t``, which may lie between two steps; it is not seen after the track's end."""
    step = int(t)
    path, mask = states[: step + 1], seen[: step + 1]
    if t > len(states) - 1:
        return np.concatenate([path, path[-1:]]), np.append(mask, False)
    if t == step:
        return path, mask
    change = states[step + 1] - states[step]
    change[HEADING] = (change[HEADING] + np.pi) % (2 * np.pi) - np.pi
    return np.concatenate([path, (states[step] + (t - step) * change)[None]]), np.append(
        mask, seen[step] & seen[step + 1]
    )


def _write_gif(figure: Figure, frames: Iterator[float], seconds: float, path: Path) -> None:
    from PIL import Image

    figure.set_dpi(ANIMATION_DPI)
    canvas = FigureCanvasAgg(figure)
    images = []
    for _ in frames:
        canvas.draw()
        images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
    # One set of colours for all frames, that of the fullest ones: what stands still then stays the same to the bit.
    sample = Image.new("RGB", (images[0].width, 3 * images[0].height))
    for row, image in enumerate((images[0], images[len(images) // 2], images[-1])):
        sample.paste(image, (0, row * image.height))
    palette = sample.quantize(COLORS, method=Image.Quantize.FASTOCTREE)
    first, *rest = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    durations = [round(1000 * seconds)] * len(images)
    durations[-1] = round(1000 * HOLD)
    animation = io.BytesIO()  # a full disk would be an encoder's error without a file's name
    first.save(animation, format="GIF", save_all=True, append_images=rest, duration=durations, loop=0, optimize=True)
    path.write_bytes(animation.getbuffer())


def _write_mp4(figure: Figure, frames: Iterator[float], seconds: float, path: Path) -> None:
    writer = FFMpegWriter(fps=round(1 / seconds))
    with writer.saving(figure, str(path), ANIMATION_DPI):
        for _ in frames:
            writer.grab_frame()
        for _ in range(round(HOLD / seconds)):
            writer.grab_frame()


def _color(i: int) -> str:
    return VEHICLES[i % len(VEHICLES)]


def _mixed(start: Color, end: Color, share: float) -> Color:
    """The colour at a share of the way from one to another."""
    red, green, blue = (1 - share) * np.array(to_rgb(start)) + share * np.array(to_rgb(end))
    return float(red), float(green), float(blue)


def _explained(ground: _Ground, futures: Sequence[_Future], moving: bool) -> list[Artist]:
    """Legend entries of lines and boxes."""
    handles: list[Artist] = [Line2D([], [], color=HISTORY, lw=1.2, label="history")]
    if ground.seen[:, ground.now + 1 :].any():
        truth = Line2D(
            [], [], color=TRUTH, lw=1.2, marker=_shape(ground), ms=5, mfc="none", mew=0.8, label="ground truth"
        )
        handles.append(truth)
    handles.append(Line2D([], [], color="#6A6A6A", alpha=0.6, lw=2.6, label="forecast"))
    if not moving and any(future.goals is not None for future in futures):
        handles.append(Line2D([], [], ls="", marker="*", ms=7, mfc="#BBBBBB", mec="#222222", mew=0.5, label="goal"))
    return handles


def _shape(ground: _Ground) -> str:
    return "s" if ground.is_road else "o"


def _named(ground: _Ground) -> list[Artist]:
    """The agents' colours, as entries of a legend, unless they are too many to tell apart."""
    if len(ground.names) > MOST_NAMED:
        return []
    return [
        Line2D([], [], ls="", marker=_shape(ground), ms=5.5, mfc=_color(i), mec="#222222", mew=0.5, label=name)
        for i, name in enumerate(ground.names)
    ]
