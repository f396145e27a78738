"""Animations of traffic scenes: the history and then the most likely joint mode, in real time, as a GIF or an MP4."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.animation import FFMpegWriter
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from epo_lightning.files import whole_file
from epo_lightning.forecast import JointForecast
from epo_lightning.registry import ConfigError
from epo_lightning.report.scene_panels import (
    PALE,
    agent_color,
    draw_agent,
    draw_path,
    draw_road,
    layout,
    mixed,
    undrawn_note,
    with_start,
)
from epo_lightning.report.scene_view import JointMode, SceneView, by_probability, joint_mode
from epo_lightning.report.style import HISTORY, TRUTH, style
from epo_lightning.scene import HEADING, Scene

FRAME, HOLD = 0.1, 1.2
"""Longest time between two frames of an animation, and duration of the last frame [s]."""
ANIMATION_DPI = 100
COLORS = 128
"""Palette size of a GIF."""


def animate(scene: Scene, forecast: JointForecast, path: str | Path, title: str = "") -> Path:
    """Animation of the history and the most likely joint mode in real time, with the ground truth as outlines.

    Args:
        scene, forecast, title: as for :func:`~epo_lightning.report.scenes.draw`.
        path: path of the animation, which ends in .gif (equal scenes give equal bytes) or .mp4.

    Returns:
        ``path``.

    Raises:
        ConfigError: another ending, or an .mp4 without an installed ffmpeg.
        ValueError: as for :func:`~epo_lightning.report.scenes.draw`.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in (".gif", ".mp4"):
        raise ConfigError(f"{path}: an animation must end in .gif or, if ffmpeg is installed, .mp4")
    if ending == ".mp4" and not FFMpegWriter.isAvailable():
        raise ConfigError(f"{path}: an .mp4 needs the program ffmpeg, which is not installed; choose a .gif instead")
    view = SceneView.of(scene)
    future = view.turned(joint_mode(forecast, by_probability(forecast)[0], title))
    parts = max(1, round(view.dt / FRAME))
    with style():
        figure, (axes,) = layout(view, [future], "", moving=True)
        draw_road(axes, view)
        frames = _moving(axes, view, future, parts)
        with whole_file(path, ending) as temporary:
            write = write_gif if ending == ".gif" else _write_mp4
            write(figure, frames, view.dt / parts, temporary)
    return path


def _moving(axes: Axes, view: SceneView, future: JointMode, parts: int) -> Iterator[float]:
    """Draw one frame after another, ``parts`` per time step; yields the time of each frame [s]."""
    note = undrawn_note(axes, view, future)
    axes.set_title(f"{future.title}{note and f' ({note})'}", loc="left", fontsize=9, pad=3)
    clock = axes.set_title("", loc="right", fontsize=9, pad=3)
    predicted, finite = with_start(view, future)
    now, last = view.now, max(view.states.shape[1] - 1, view.now + predicted.shape[1] - 1)
    for t in np.arange(last * parts + 1) / parts:
        clock.set_text(f"t = {(t - now) * view.dt:+.1f} s")
        drawn: list[Artist] = []
        for i in range(len(view.states)):
            path, seen = _until(view.states[i], view.seen[i], t)
            latest = mixed(HISTORY, TRUTH, t / last)
            drawn.append(draw_path(axes, path[:, :2], seen, HISTORY, latest, width=1.0, zorder=4))
            if t > now:
                if seen[-1]:
                    drawn += draw_agent(axes, view, i, path[-1], fc="none", ec=TRUTH, lw=0.9, zorder=7)
                path, seen = _until(predicted[i], finite[i], t - now)
                pale = mixed("white", agent_color(i), PALE)
                strong = mixed(pale, agent_color(i), min(1.0, (t - now) / (predicted.shape[1] - 1)))
                drawn.append(draw_path(axes, path[:, :2], seen, pale, strong, width=3.0, zorder=2))
            if seen[-1]:
                drawn += draw_agent(axes, view, i, path[-1], fc=agent_color(i), ec="#222222", lw=0.6, zorder=6)
        yield float((t - now) * view.dt)
        for artist in drawn:
            artist.remove()


def _until(
    states: Float[np.ndarray, "T 4"], seen: Bool[np.ndarray, " T"], t: float
) -> tuple[Float[np.ndarray, "steps 4"], Bool[np.ndarray, " steps"]]:
    """States and mask of a track up to step ``t``, interpolated between steps; unobserved after the end of the track."""
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


def write_gif(figure: Figure, frames: Iterator[float], seconds: float, path: Path) -> None:
    """Write a GIF of a figure that is drawn anew for every entry of ``frames``, shown for so many ``seconds`` each."""
    from PIL import Image

    figure.set_dpi(ANIMATION_DPI)
    canvas = FigureCanvasAgg(figure)
    images = []
    for _ in frames:
        canvas.draw()
        images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
    # One palette for all frames, taken from three of them, so that still parts of the picture do not flicker.
    sample = Image.new("RGB", (images[0].width, 3 * images[0].height))
    for row, image in enumerate((images[0], images[len(images) // 2], images[-1])):
        sample.paste(image, (0, row * image.height))
    palette = sample.quantize(COLORS, method=Image.Quantize.FASTOCTREE)
    first, *rest = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    durations = [round(1000 * seconds)] * len(images)
    durations[-1] = round(1000 * HOLD)
    animation = io.BytesIO()  # written from memory: the encoder's error on a full disk would not name the file
    first.save(animation, format="GIF", save_all=True, append_images=rest, duration=durations, loop=0, optimize=True)
    path.write_bytes(animation.getbuffer())


def _write_mp4(figure: Figure, frames: Iterator[float], seconds: float, path: Path) -> None:
    writer = FFMpegWriter(fps=round(1 / seconds))
    with writer.saving(figure, str(path), ANIMATION_DPI):
        for _ in frames:
            writer.grab_frame()
        for _ in range(round(HOLD / seconds)):
            writer.grab_frame()
