"""Answer times of the page of `epo explore`, and a film of it.

    python -m benchmarks.explore times rpi/v_lstm_epo             # a run folder, or a run that ships with the package
    epo explore run=rpi/v_lstm_epo                                # in another terminal
    python -m benchmarks.explore film http://127.0.0.1:8765 explore.gif

The times are those of the server: the solution of the changed game, its energies and its Nash gap. The film needs
playwright and Chromium.
"""

from __future__ import annotations

import io
import random
import shutil
import statistics
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from PIL import Image

from benchmarks.command_line import parser_of
from benchmarks.measure import positive
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.config.settings import ExploreSettings
from epo_lightning.experiment.explore import open_session
from epo_lightning.explore.edit import Edit
from epo_lightning.explore.session import Session
from epo_lightning.schema import read

WIDTH, HEIGHT = 1180, 760
"""Size of the browser's window in pixels."""
SHOWN = 0.7
"""Size of the film's frames relative to the window."""


def random_edit(session: Session, draw: random.Random) -> Edit:
    """A change as sliders and goals make it: two factors and, where there are goals, a goal moved by up to 2 m."""
    scene = draw.randrange(len(session.scenes.history))
    names = [name for of_kind in session.forecaster.energy.weighted for name in of_kind]
    goals = session.solve(Edit(scene=scene))["modes"][0]["goals"]
    moved = {str(agent): [x + draw.uniform(-2, 2), y + draw.uniform(-2, 2)] for agent, (x, y) in [*goals.items()][:1]}
    return Edit(scene=scene, factors={name: 2 ** draw.uniform(-2, 2) for name in draw.sample(names, 2)}, goals=moved)


def times(words: Sequence[str], count: int) -> dict[str, list[float]]:
    """Milliseconds of solver and whole answer for random edits of a run's games, from the overrides of ``epo explore``."""
    session, draw = open_session(read(ExploreSettings, compose("explore", words)), words), random.Random(0)
    found: dict[str, list[float]] = {"solver": [], "all": []}
    for _ in range(count):
        answer = session.solve(random_edit(session, draw))
        for name, values in found.items():
            values.append(answer["milliseconds"][name])
    return found


def film(address: str, file: str) -> None:
    """Drive the page at an address and write what is seen: a goal is dragged, a weight raised, an agent moved."""
    from playwright.sync_api import sync_playwright

    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))))
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.goto(address)
        page.wait_for_selector("[data-chosen]", state="attached")
        frames = [*_scenario(page)]
        browser.close()
    pictures = [
        Image.open(io.BytesIO(frame))
        .convert("RGB")
        .resize((round(SHOWN * WIDTH), round(SHOWN * HEIGHT)), Image.Resampling.LANCZOS)
        for frame in frames
    ]
    palette = pictures[0].quantize(64)
    first, *others = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    first.save(file, save_all=True, append_images=others, duration=120, loop=0, optimize=True)


def _scenario(page: Any) -> Iterator[bytes]:
    """Screenshots of the page while it is used."""

    def settled() -> bytes:
        page.wait_for_timeout(250)
        return bytes(page.screenshot())

    def drag(what: str, by: tuple[float, float], steps: int = 10) -> Iterator[bytes]:
        box = page.locator(f"[data-drag='{what}']").first.bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        for step in range(1, steps + 1):
            page.mouse.move(x + by[0] * step / steps, y + by[1] * step / steps)
            yield settled()
        page.mouse.up()

    def slide(selector: str, values: Sequence[float]) -> Iterator[bytes]:
        for value in values:
            page.locator(selector).first.evaluate(
                f"slider => {{ slider.value = {value}; slider.dispatchEvent(new Event('input')); }}"
            )
            yield settled()

    yield settled()
    yield from slide("#time", range(0, 41, 4))
    yield from drag("goal", (-60, 170))
    yield from slide("[data-weight]", [step / 2 for step in range(9)])
    yield from drag("state", (10, -90))
    yield from [settled()] * 4


def main(words: Sequence[str] | None = None) -> None:
    parser = parser_of("explore", __doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    timed = verbs.add_parser("times")
    timed.add_argument("run")
    timed.add_argument("overrides", nargs="*", help="overrides of epo explore")
    timed.add_argument("--edits", type=positive, default=200)
    filmed = verbs.add_parser("film")
    filmed.add_argument("address")
    filmed.add_argument("file")
    given = parser.parse_args(words)
    if given.verb == "film":
        film(given.address, given.file)
        print(f"wrote {given.file}")
        return
    torch.set_num_threads(1)
    for name, values in times([f"run={given.run}", *given.overrides], given.edits).items():
        tenths = statistics.quantiles(values, n=10)
        print(f"{name:<8} median {statistics.median(values):6.1f} ms, nine tenths below {tenths[-1]:6.1f} ms")


if __name__ == "__main__":
    main()
