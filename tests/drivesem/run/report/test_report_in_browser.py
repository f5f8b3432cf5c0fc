"""The page in a real browser: no error, no request, and all that can be moved moves, by mouse and by keyboard."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from drivesem.cli import main


@pytest.fixture
def opened(chromium: Any) -> Iterator[Callable[..., Any]]:
    """Opens a page; at the end there must have been no error and no request but for the file itself."""
    complaints: list[str] = []
    pages = []

    def at(path: Path, width: int = 1280, **of: Any) -> Any:
        page = chromium.new_page(viewport={"width": width, "height": 900}, **of)
        page.on("console", lambda message: complaints.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        requests: list[str] = []
        page.goto(path.as_uri())
        page.wait_for_load_state("networkidle")
        pages.append((page, requests, path))
        return page

    yield at
    for page, requests, path in pages:
        assert [url for url in requests if not url.startswith("data:")] == [path.as_uri()]
        page.close()
    assert not complaints


@pytest.fixture
def page(some_run: Path) -> Path:
    assert main(["report", str(some_run)]) == 0
    return some_run / "report.html"


def cut_of(page: Any, place: int = 0) -> float:
    style = page.locator(".stage").nth(place).evaluate("e => getComputedStyle(e).getPropertyValue('--cut')")
    return float(style.removesuffix("%"))


def visible_texts(page: Any, selector: str) -> list[str]:
    return page.locator(f"{selector}:not(.hidden)").evaluate_all("all => all.map(e => e.dataset.name)")


def test_slider_by_keyboard_and_mouse(opened: Callable[..., Any], page: Path) -> None:
    tab = opened(page)
    slider = tab.locator(".cut").first
    slider.focus()
    tab.keyboard.press("Home")
    assert cut_of(tab) == 0
    tab.keyboard.press("ArrowRight")
    assert cut_of(tab) == 1
    tab.keyboard.press("End")
    assert cut_of(tab) == 100
    assert slider.get_attribute("aria-valuetext") == "100 % of the left picture"
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    tab.mouse.click(box["x"] + 0.25 * box["width"], box["y"] + 0.5 * box["height"])
    assert cut_of(tab) == pytest.approx(25, abs=1.5)
    flip = tab.locator("button.flip").first
    flip.focus()
    tab.keyboard.press("Enter")
    assert cut_of(tab) == 0
    flip.click()
    assert cut_of(tab) == 100
    right = tab.locator(".layer.right").first
    assert right.evaluate("e => getComputedStyle(e).clipPath") == "inset(0px 0px 0px 100%)"


def test_filters(opened: Callable[..., Any], page: Path) -> None:
    tab = opened(page)
    every = ["0001/rain/00004", "000003", "000002", "000001"]
    assert visible_texts(tab, "article") == every
    tab.get_by_label("lost objects").check()
    assert visible_texts(tab, "article") == ["0001/rain/00004", "000002"]
    assert visible_texts(tab, "#frames tbody tr") == ["0001/rain/00004", "000002"]
    assert tab.locator("#count").inner_text() == "2 of 4 frames"
    tab.get_by_role("button", name="All frames").click()
    assert visible_texts(tab, "article") == every
    tab.get_by_label("parameter").select_option("weather")
    assert visible_texts(tab, "article") == ["000003"]
    tab.get_by_role("button", name="All frames").click()
    tab.locator("select[name=weather]").select_option("rain")
    assert visible_texts(tab, "article") == ["0001/rain/00004"]
    tab.get_by_role("button", name="All frames").click()
    tab.get_by_label("size of change").fill("30")
    assert visible_texts(tab, "article") == ["000003", "000001"]
    tab.get_by_role("button", name="All frames").click()
    tab.get_by_label("name", exact=True).fill("00000")
    assert visible_texts(tab, "article") == every[1:]
    tab.get_by_label("order").select_option("name")
    assert visible_texts(tab, "article") == every[:0:-1]


def test_boxes_can_be_switched(opened: Callable[..., Any], page: Path) -> None:
    tab = opened(page)
    for name, kind, on in (("true", "true", True), ("detected", "found", True), ("ignored", "ignored", False)):
        drawn = tab.locator(f".layer .box.{kind}").first
        assert drawn.evaluate("e => getComputedStyle(e).display !== 'none'") is on
        tab.get_by_label(name, exact=True).click()
        assert drawn.evaluate("e => getComputedStyle(e).display !== 'none'") is not on


def test_tables_are_sorted_by_keyboard(opened: Callable[..., Any], page: Path) -> None:
    tab = opened(page)
    heading = tab.locator("#frames th", has_text="phantoms")
    heading.locator("button").focus()
    tab.keyboard.press("Enter")
    assert heading.get_attribute("aria-sort") == "descending"
    values = tab.locator("#frames tbody tr").evaluate_all("all => all.map(e => e.dataset.phantoms)")
    assert values == sorted(values, reverse=True)
    tab.keyboard.press("Space")
    assert heading.get_attribute("aria-sort") == "ascending"
    values = tab.locator("#frames tbody tr").evaluate_all("all => all.map(e => e.dataset.phantoms)")
    assert values == sorted(values)
    tab.locator("#frames th", has_text="frame").first.locator("button").click()
    assert visible_texts(tab, "#frames tbody tr") == ["000001", "0001/rain/00004", "000002", "000003"]


def test_runs_change_sides(
    opened: Callable[..., Any], tmp_path: Path, frame: Callable[..., Any], make_run: Callable[..., Path]
) -> None:
    a, b = (make_run(tmp_path / n, [frame("1", lost=n == "a", phantom=n == "b"), frame("2")]) for n in ("a", "b"))
    assert main(["report", str(a), str(b), "--out", str(tmp_path / "page.html")]) == 0
    tab = opened(tmp_path / "page.html")
    titles = lambda: [tab.locator(f".stage >> nth=0 >> .tag.{side}").inner_text() for side in "lr"]  # noqa: E731
    assert titles() == ["before", "a"]
    tab.get_by_role("button", name="b: 1 phantom").click()
    assert titles() == ["before", "b"]
    assert tab.locator("article >> nth=0 >> .close:not(.hidden)").count() == 1
    tab.locator("#left").select_option("1")
    tab.locator("#right").select_option("2")
    assert titles() == ["a", "b"]
    for side, kind in (("left", "lost"), ("right", "phantom")):
        assert tab.locator(f".layer.{side} .boxes.on .box.{kind}").count() == 1
    tab.locator("#runs th", has_text="lost").locator("button").click()
    assert tab.locator("#runs tbody tr td:first-child").all_inner_texts() == ["a", "b"]


@pytest.mark.parametrize("width", [360, 768, 1280])
def test_nothing_is_wider_than_the_screen(opened: Callable[..., Any], page: Path, width: int) -> None:
    tab = opened(page, width=width)
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    assert tab.locator("details.tools").evaluate("e => e.open") is (width > 640)


def test_dark_and_printed(opened: Callable[..., Any], page: Path) -> None:
    tab = opened(page, color_scheme="dark")
    ground = "getComputedStyle(document.body).backgroundColor"
    assert tab.evaluate(ground) == "rgb(19, 21, 24)"
    tab.emulate_media(media="print")
    assert tab.evaluate(ground) == "rgb(255, 255, 255)"
    layers = tab.locator("article >> nth=0 >> .layer").evaluate_all(
        "all => all.map(e => [getComputedStyle(e).visibility, getComputedStyle(e).position])"
    )
    assert layers == [["visible", "relative"]] * 2
    assert not tab.locator(".tools").is_visible()


def test_frames_can_be_reached_by_keyboard(opened: Callable[..., Any], page: Path) -> None:
    tab = opened(page)
    tab.keyboard.press("Tab")
    assert tab.evaluate("document.activeElement.textContent") == "Skip to the frames"
    reached = set()
    for _ in range(60):
        tab.keyboard.press("Tab")
        reached.add(tab.evaluate("document.activeElement.className || document.activeElement.name"))
    assert {"cut", "flip", "lost", "size"} <= reached
