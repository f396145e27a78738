"""The page in a real browser, from disk and without a network: tabs, sorting, legends, provenance of numbers."""

from __future__ import annotations

import base64
import io
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from epo_lightning.report.page import _behind, picture_uri
from epo_lightning.report.runs import collect
from epo_lightning.report.tables import build_tables
from epo_lightning.report.write import Report, write_report

from .page_runs import over_runtime, over_steps, rows_with_seeds
from .run_folders import make_run, scores

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
TABS = [
    *("Tables", "Cost", "Best settings", "Paired tests", "Learning curves", "S curve", "Runtime", "Scenes"),
    "Learned weights",
]


def write_page(folder: Path) -> Path:
    """A report with all sections, and names that a careless page would take for markup."""
    runs, out = folder / "runs", folder / "out"
    for make in (rows_with_seeds, over_steps, over_runtime):
        make(runs / make.__name__)
    make_run(runs / "odd", "<b>Odd</b> & \"co\" </script><script>alert('x')</script>", "marginal", scores(0.07))
    make_run(runs / "late", "Late", "epo", None, settings={"optimizer.lr": 0.5})
    for lr in (0.001, 0.0003):
        make_run(runs / f"lr{lr}", "Searched", "marginal", scores(lr), split="val", settings={"optimizer.lr": lr})
    pictures = [out / "figures" / name for name in ("scene_1.png", "learned_weights.png")]
    for picture in pictures:
        picture.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (2000, 700), "#336699").save(picture)
    report = Report.of_folder(runs)
    write_report(report, out, pictures, "**Budget: reduced.** Not `paper`.", console=Console(file=io.StringIO()))
    return out / "index.html"


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_page(tmp_path_factory.mktemp("page"))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("no chromium on this machine")
    with playwright.sync_playwright() as started:
        opened = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        yield opened
        opened.close()


@pytest.fixture
def opened(browser: Any, page_file: Path) -> Iterator[Any]:
    """The page; afterwards nothing was asked of a network, and nothing was complained about."""
    context = browser.new_context(viewport={"width": 1280, "height": 860})
    requests, complaints = [], []

    def only_files(route: Any) -> None:
        requests.append(route.request.url)
        if route.request.url.startswith("file:"):
            route.continue_()
        else:
            route.abort()

    context.route("**/*", only_files)
    page = context.new_page()
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("dialog", lambda dialog: (complaints.append(dialog.message), dialog.dismiss()))
    page.goto(page_file.as_uri())
    yield page
    context.close()
    assert complaints == []
    assert {url for url in requests if not url.startswith("data:")} == {page_file.as_uri()}


def shown(page: Any) -> list[str]:
    return page.eval_on_selector_all(
        "main > section", "all => all.filter(one => one.getClientRects().length).map(one => one.id)"
    )


def test_every_tab_shows_its_section_by_mouse_and_keys(opened: Any) -> None:
    tabs = opened.locator('[role="tab"]')
    assert tabs.all_inner_texts() == [*TABS, "How this was made"]
    for tab in tabs.all():
        tab.click()
        assert shown(opened) == [tab.get_attribute("aria-controls")]
        assert tab.get_attribute("aria-selected") == "true"
        section = opened.locator("section.shown")
        assert section.locator("table, svg, img, details").count() > 0
        assert opened.evaluate("document.documentElement.scrollWidth <= innerWidth")
    opened.keyboard.press("ArrowRight")
    assert shown(opened) == ["tables"]
    opened.keyboard.press("ArrowLeft")
    assert shown(opened) == ["how-this-was-made"]
    opened.reload()
    assert shown(opened) == ["how-this-was-made"]


def column(page: Any, place: int) -> list[str]:
    return page.locator("table.scores").first.locator(f"tbody tr > :nth-child({place})").all_inner_texts()


def test_tables_sort_by_any_column_and_back(opened: Any) -> None:
    before = column(opened, 1)
    head = opened.locator("table.scores").first.locator("thead th").nth(4)
    for direction, sign in (("ascending", 1), ("descending", -1)):
        head.locator("button").click()
        assert head.get_attribute("aria-sort") == direction
        values = [float(text.split()[0]) for text in column(opened, 5)]
        assert values == sorted(values, key=lambda value: sign * value)
        assert len(set(values)) > 2
    head.locator("button").click()
    assert head.get_attribute("aria-sort") is None
    assert column(opened, 1) == before


def test_the_best_is_bold_and_the_second_underlined(opened: Any) -> None:
    row = opened.locator("table.scores").first.locator("tbody tr", has_text="V-LSTM + EPO")
    best = row.locator(".best").first
    assert best.inner_text() == "0.032"
    assert best.evaluate("it => getComputedStyle(it).fontWeight") == "700"
    second = opened.locator("table.scores").first.locator("tbody tr", has_text="V-LSTM + SC").locator(".second").first
    assert "underline" in second.evaluate("it => getComputedStyle(it).textDecorationLine")


def test_a_click_on_a_number_shows_its_provenance(opened: Any, page_file: Path) -> None:
    table = opened.locator("table.scores").first
    cell = table.locator("tbody tr", has_text="V-LSTM + EPO").locator("button.cell").nth(2)
    detail = opened.locator("#detail")
    cell.hover()
    assert detail.is_visible()
    opened.mouse.move(5, 5)
    assert detail.is_hidden()
    cell.focus()
    opened.keyboard.press("Enter")
    opened.mouse.move(5, 5)
    text = detail.inner_text()
    for expected in (
        *("V-LSTM + EPO", "SADE, rpi, test split", "0.031500", "0.001500", "paper\n0.03", "+0.001500", "n\n3"),
        *(f"Seed {seed}: 0.03" for seed in range(3)),
        *("epo train experiment=None seed=2", "0123456789abcdef", "data\nabc"),
        str(page_file.parents[1] / "runs" / "rows_with_seeds" / "epo" / "s1"),
    ):
        assert expected in text
    opened.keyboard.press("Escape")
    assert detail.is_hidden()
    assert cell.evaluate("it => it === document.activeElement")


def test_clicks_on_the_legend_toggle_rows_of_a_chart(opened: Any) -> None:
    opened.locator("#tab-learning-curves").click()
    chart = opened.locator("#learning-curves figure")
    line, band, other = (
        chart.locator(f'.wide [id="learning_curves-wide-{part}"]') for part in ("row1-line", "row1-band", "row0-line")
    )
    button = chart.locator(".legend button", has_text="V-LSTM + SC")
    for visible in (True, False, True):
        assert button.get_attribute("aria-pressed") == str(visible).lower()
        assert [part.is_visible() for part in (line, band, other)] == [visible, visible, True]
        button.click()
    summary = chart.locator("summary")
    summary.click()
    assert "0.0640" in chart.locator("table").inner_text()


def test_how_it_was_made_names_every_run_and_what_was_left_out(opened: Any) -> None:
    opened.locator("#tab-how-this-was-made").click()
    made = opened.locator("#how-this-was-made details", has_text="V-LSTM + SC")
    made.locator("summary").click()
    text = made.inner_text()
    assert "n = 3 · seeds 0, 1, 2 · 1234 parameters · budget reduced · commit 0123456789 · data abc" in text
    assert "1000 steps, 62 s, begun 2024-05-03T10:00:00Z" in text
    assert "torch 2.13.0" in text
    assert "late interrupted" in opened.locator(".left-out").inner_text()
    assert "newest of 2024-05-03" in opened.locator("header").inner_text()


def test_the_page_fits_the_screen_of_a_phone(browser: Any, page_file: Path) -> None:
    page = browser.new_page(viewport={"width": 390, "height": 800}, has_touch=True, is_mobile=True)
    page.goto(page_file.as_uri())
    for tab in page.locator('[role="tab"]').all():
        tab.click()
        assert page.evaluate("document.documentElement.scrollWidth") == 390
    page.locator("#tab-runtime").click()
    assert page.locator("#runtime .narrow svg").first.is_visible()
    assert page.locator("#runtime .wide svg").first.is_hidden()
    page.locator("#tab-tables").click()
    page.locator("button.cell").first.tap()
    box = page.locator("#detail").bounding_box()
    assert (box["x"], box["width"]) == (0, 390)
    assert box["y"] + box["height"] == pytest.approx(800, abs=1)
    page.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_has_enough_contrast_in_both_colour_schemes(browser: Any, page_file: Path, scheme: str) -> None:
    page = browser.new_page(color_scheme=scheme)
    page.goto(page_file.as_uri())

    def color(selector: str, name: str) -> np.ndarray:
        found = page.eval_on_selector(selector, "(it, name) => getComputedStyle(it)[name]", name)
        return np.array([float(part) for part in re.findall(r"[\d.]+", found)[:3]]) / 255

    def luminance(rgb: np.ndarray) -> float:
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    grounds = [color("body", "backgroundColor"), color(".card", "backgroundColor")]
    assert (luminance(grounds[0]) > 0.5) == (scheme == "light")
    for selector in (".own", ".deviation", ".paper", ".hint", ".facts", ".kind", 'a[role="tab"]', "thead .sort"):
        for ground in grounds:
            bright, dim = sorted((luminance(color(selector, "color")), luminance(ground)), reverse=True)
            assert (bright + 0.05) / (dim + 0.05) > 4.5, selector
    page.close()


def test_all_sections_are_shown_without_scripts_and_in_print(browser: Any, page_file: Path) -> None:
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(page_file.as_uri())
    assert all(section.is_visible() for section in page.locator("main > section").all())
    context.close()
    page = browser.new_page(viewport={"width": 718, "height": 1000})  # A4 with margins of a centimetre
    page.goto(page_file.as_uri())
    page.emulate_media(media="print")
    assert page.evaluate("document.documentElement.scrollWidth") == 718
    assert all(section.is_visible() for section in page.locator("main > section").all())
    assert page.locator("nav").is_hidden()
    page.close()


def test_the_page_loads_no_other_file(page_file: Path) -> None:
    text = page_file.read_text()
    linked = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert linked
    assert all(link.startswith(("data:", "#")) for link in linked)
    assert "@import" not in text
    assert not re.search(r"url\((?!#)", text)
    assert "<b>Odd" not in text
    assert "</script><script>alert" not in text
    assert page_file.stat().st_size < 1_000_000


def test_sections_without_content_are_left_out(tmp_path: Path) -> None:
    make_run(tmp_path / "runs" / "a", "V-LSTM", "marginal", scores(0.3))
    write_report(Report.of_folder(tmp_path / "runs"), tmp_path / "out", console=Console(file=io.StringIO()))
    text = (tmp_path / "out" / "index.html").read_text()
    assert re.findall(r'role="tab" id="[^"]*" href="#([^"]*)"', text) == ["tables", "how-this-was-made"]
    assert not (tmp_path / "out" / "figures").exists()


def test_pictures_are_reduced_and_remain_similar(tmp_path: Path) -> None:
    gradient = np.zeros((300, 3000, 3), np.uint8)
    gradient[..., 0] = np.linspace(0, 255, 3000)
    Image.fromarray(gradient).save(tmp_path / "wide.png")
    small = Image.open(io.BytesIO(base64.b64decode(picture_uri(tmp_path / "wide.png").partition(",")[2])))
    assert small.size == (1500, 150)
    red = np.asarray(small.convert("RGB"))[..., 0].astype(int)
    assert np.abs(red - np.linspace(0, 255, 1500)).max() < 12


@pytest.mark.parametrize(("trained", "shown"), [("abc", ""), ("other", "other")])
def test_details_name_the_data_of_a_training_that_are_not_those_of_the_test(
    trained: str, shown: str, tmp_path: Path
) -> None:
    make_run(tmp_path / "run", "EPO", "epo", scores(0.1), digest="abc", trained_digest=trained)
    (run,) = _behind(build_tables(collect(tmp_path))[0].rows[0])["runs"]
    assert (run["digest"], run["trained"]) == ("abc", shown)
