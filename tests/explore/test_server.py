"""The page's questions over HTTP, and the page in a real browser."""

from __future__ import annotations

import contextlib
import json
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest

import epo_lightning
from epo_lightning import pretrained
from epo_lightning.experiment.config.settings import ExploreSettings
from epo_lightning.experiment.explore import explore
from epo_lightning.explore.session import Session
from epo_lightning.registry import ConfigError

uvicorn = pytest.importorskip("uvicorn", reason="needs epo_lightning[explore]")
RUN = "rpi/v_lstm_epo"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    from epo_lightning.explore.server import application

    session = Session(epo_lightning.load(RUN), pretrained.examples(RUN), "<b>rpi</b>", ("executed", "alternative"))
    server = uvicorn.Server(uvicorn.Config(application(session), log_level="error"))
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        bound.listen()
        thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]})
        thread.start()
        try:
            while not server.started:
                time.sleep(0.02)
            yield f"http://127.0.0.1:{bound.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join(30)


def ask(address: str, body: Any = None) -> tuple[int, Any]:
    data = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
    with contextlib.suppress(HTTPError), urlopen(Request(address, data), timeout=60) as answer:
        return answer.status, json.load(answer)
    try:
        urlopen(Request(address, data), timeout=60).close()
    except HTTPError as error:
        return error.code, json.load(error)
    raise AssertionError("the second answer differs from the first")


def test_questions_are_answered_and_mistakes_named(address: str) -> None:
    status, scene = ask(f"{address}/scenes/0")
    assert (status, scene["title"]) == (200, "<b>rpi</b>")
    status, solution = ask(f"{address}/solve", {"scene": 0, "factors": {"goal": 2}})
    assert (status, len(solution["modes"])) == (200, 2)
    for body, message in (
        (b"{", "the request is no JSON"),
        ([], "must be an object"),
        ({"scnee": 1}, "unknown key scnee: did you mean 'scene'"),
        ({"scene": "first"}, "scene must be"),
        ({"scene": 99}, "scene must be a number from 0 to 15"),
        ({"goals": {"0": ["a", "b"]}}, "goals must be a mapping of names to a list of numbers"),
        ({"factors": {"goal": None}}, "factors must be a mapping of names to a number"),
        (["x" * 10**6], "must be an object"),
    ):
        status, answer = ask(f"{address}/solve", body)
        assert (status, message in answer["error"]) == (422, True), answer
        assert len(answer["error"]) < 1000
    for index in ("99", "-1", "first", "9" * 5000):
        assert ask(f"{address}/scenes/{index}")[0] == 422, index[:9]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("no chromium on this machine")
    with playwright.sync_playwright() as started:
        opened = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        yield opened
        opened.close()


def test_changes_on_the_page_change_the_trajectories(address: str, browser: Any) -> None:
    page = browser.new_page(viewport={"width": 1300, "height": 850})
    page.set_default_timeout(60_000)
    errors: list[str] = []
    foreign: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("request", lambda request: None if request.url.startswith(address) else foreign.append(request.url))
    page.goto(address)

    def answers() -> int:
        return int(page.evaluate("document.body.dataset.answers || 0"))

    def after(change: Any) -> str:
        """The chosen trajectory of agent 0 after a change on the page."""
        before = answers()
        change()
        page.wait_for_function(f"document.body.dataset.answers > {before}")
        return str(page.locator("[data-chosen='0']").get_attribute("points"))

    def slide(value: float) -> None:
        page.locator("[data-weight='goal']").evaluate(
            f"slider => {{ slider.value = {value}; slider.dispatchEvent(new Event('input')); }}"
        )

    def drag(what: str) -> None:
        box = page.locator(f"[data-drag='{what}'][data-agent='0']").bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x - 30, y - 40)
        page.mouse.up()

    page.wait_for_selector("[data-chosen='0']", state="attached")
    assert page.locator("h1").inner_text() == "<b>rpi</b>"
    first = str(page.locator("[data-chosen='0']").get_attribute("points"))
    assert after(lambda: slide(2.0)) != first
    assert page.locator("#weights output").first.inner_text().endswith(" 4")
    assert after(lambda: slide(0.0)) == first
    assert after(lambda: drag("goal")) != first
    after(lambda: page.locator("#reset").click())
    assert str(page.locator("[data-chosen='0']").get_attribute("points")) == first
    assert after(lambda: drag("state")) != first
    after(lambda: page.locator("#reset").click())
    after(lambda: page.locator("input[data-agent='1']").uncheck())
    assert page.locator("[data-chosen]").count() == 1
    other = page.locator("#modes button[aria-pressed='false']")
    after(other.click)
    after(lambda: page.locator("#after").click())
    assert page.locator("#scene").input_value() == "1"
    page.locator("#time").evaluate("time => { time.value = 20; time.dispatchEvent(new Event('input')); }")
    assert page.locator("#seconds").inner_text() == "2.0 s"
    assert float(page.locator("#energy").inner_text()) > 0
    page.locator("#scene").fill("99")
    page.locator("#scene").dispatch_event("change")
    page.wait_for_selector("#error:not([hidden])")
    assert "from 0 to 15" in page.locator("#error").inner_text()
    assert errors == foreign == []


def test_a_port_that_is_taken_is_named(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=f"port {port} cannot be used"):
            explore(ExploreSettings(run=RUN, port=port), [], print)
        with pytest.raises(ConfigError, match=r"no checkpoint .*nowhere\.ckpt"):
            explore(ExploreSettings(run=RUN, port=port, checkpoint="nowhere.ckpt"), [], print)
    with pytest.raises(ConfigError, match="port must be a number from 0 to 65535"):
        ExploreSettings(run=RUN, port=70000)
