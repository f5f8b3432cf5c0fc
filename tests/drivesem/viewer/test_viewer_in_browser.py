"""The page in a real browser: what moves, by mouse, keyboard and link; and what it says."""

from __future__ import annotations

import base64
import re
import shlex
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

import cv2
import numpy as np
import pytest
import torch

from drivesem.attacks.budgets import PRESETS
from drivesem.cli import main
from drivesem.viewer.server import Server, Viewer, ViewerFrame
from scene_ir import files
from scene_ir.io import save_scene, to_uint8
from scene_ir.render.sources import photograph_scene
from scene_ir.types import Category, SceneIR
from tests.drivesem.viewer.conftest import GRID, SCORE, Stubborn

CHANGED = "<b>changed</b>"
FAITHFUL_DB = 34.0
"""Of a JPEG beside what it holds."""


@pytest.fixture
def opened(chromium: Any, server: Server) -> Iterator[Callable[..., Any]]:
    """Opens the page at a link; at the end there must have been no error, and no request but to the server."""
    complaints: list[str] = []
    requested: list[str] = []
    contexts = []
    hosts = [server.url]

    def at(width: int = 1400, height: int = 900, server: Server = server, **link: Any) -> Any:
        hosts.append(server.url)
        context = chromium.new_context(viewport={"width": width, "height": height})
        context.grant_permissions(["clipboard-read", "clipboard-write"], origin=server.url.rstrip("/"))
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: complaints.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: requested.append(request.url))
        page.goto(f"{server.url}#{urlencode(link)}" if link else server.url)
        settle(page)
        return page

    yield at
    for context in contexts:
        context.close()
    there = (*hosts, *(f"blob:{url}" for url in hosts), "data:,")
    assert not [url for url in requested if not url.startswith(there)]
    dropped = "409"  # what a later request superseded
    assert not [shortcuts for shortcuts in complaints if dropped not in shortcuts]


def settle(page: Any) -> None:
    """Wait until picture and detections are of the state as it stands."""
    page.wait_for_selector("#view[data-settled]", timeout=30000)


def state(page: Any) -> dict[str, str]:
    """What the page's link says."""
    return {name: values[0] for name, values in parse_qs(urlsplit(page.url).fragment).items()}


def slider_of(page: Any, name: str) -> Any:
    return page.locator(f'input[data-name="{name}"]')


def pixels(page: Any) -> np.ndarray:
    """What the picture shows, by the browser's own reading."""
    data = page.evaluate(
        """() => {
            const image = document.getElementById("after"), canvas = document.createElement("canvas");
            [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
            canvas.getContext("2d").drawImage(image, 0, 0);
            return canvas.toDataURL("image/png").split(",")[1];
        }"""
    )
    return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def test_a_slider_moves_picture_boxes_link_and_command(opened: Callable[..., Any], viewer: Viewer) -> None:
    page = opened(frame="still", car=0)
    before = page.locator("#after").get_attribute("src")
    slider = slider_of(page, "objects[0].translate.along")
    slider.fill("0.5")
    page.wait_for_selector("#view:not([data-settled])", state="attached")
    settle(page)
    assert page.locator("#after").get_attribute("src") != before
    assert state(page)["objects[0].translate.along"] == "0.5"
    assert "'objects[0].translate=0.5m,0m'" in page.inner_text("#command")
    assert page.locator("output[for='slider-objects[0].translate.along']").inner_text() == "0.50 m"
    stage = viewer.scene("still")
    expected, still = (
        to_uint8(stage.render_state(values).render.image) for values in ({"objects[0].translate.along": 0.5}, {})
    )
    assert cv2.PSNR(pixels(page), expected) > FAITHFUL_DB > cv2.PSNR(still, expected)
    slider.focus()
    page.keyboard.press("ArrowRight")
    assert state(page)["objects[0].translate.along"] == "0.51"
    page.locator(".slider.moved button").first.click()
    settle(page)
    assert "objects[0].translate.along" not in state(page)
    assert page.inner_text("#command").startswith("drivesem render ")


def test_a_person_is_an_object_with_sliders(
    opened: Callable[..., Any],
    served: Callable[[Viewer], Any],
    street: Callable[..., SceneIR],
    tmp_path: Path,
) -> None:
    """Its own sliders, one chip named by its class, and a picture that place and colour change."""
    scene = street([(-2.5, 9.0), (2.5, 12.0)])
    category = torch.tensor([int(Category.CAR), int(Category.PEDESTRIAN)])
    scene = photograph_scene(scene.with_objects(category=category))
    save_scene(scene, tmp_path / "crossing")
    frames = {"crossing": ViewerFrame(tmp_path / "crossing")}
    viewer = Viewer("people", frames, Stubborn(scene), PRESETS["street"], grid=GRID)
    with closing(viewer), served(viewer) as server:
        page = opened(server=server, frame="crossing", car=1)
        assert page.locator("#cars button").all_inner_texts() == [
            f"0 car\n{SCORE:.2f}",
            f"1 pedestrian\n{SCORE:.2f}",
        ]
        assert page.locator("#map-car").inner_text() == "Pedestrian 1"
        assert page.locator("#car-sliders legend").all_inner_texts() == ["Place", "Colour", "Size and shape"]
        slider = slider_of(page, "objects[1].translate.across")
        assert (slider.get_attribute("min"), slider.get_attribute("max")) == ("-2", "2")
        for name, value in (("translate.across", "1"), ("paint.lightness", "0.5")):
            before = page.locator("#after").get_attribute("src")
            slider_of(page, f"objects[1].{name}").fill(value)
            page.wait_for_selector("#view:not([data-settled])", state="attached")
            settle(page)
            assert page.locator("#after").get_attribute("src") != before
        wanted = {"objects[1].translate.across": 1.0, "objects[1].paint.lightness": 0.5}
        expected = to_uint8(viewer.scene("crossing").render_state(wanted).render.image)
        assert cv2.PSNR(pixels(page), expected) > FAITHFUL_DB
        assert "'objects[1].translate=0m,1m'" in page.inner_text("#command")
        page.close()


def test_the_copied_command_draws_the_picture(
    opened: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = opened(frame=CHANGED, **{"objects[0].translate.along": 0.25, "objects[1].yaw": -4, "weather.rain": 0.5})
    page.keyboard.press("c")
    page.wait_for_selector("#toast:not(:empty)")
    words = shlex.split(page.evaluate("navigator.clipboard.readText()"))
    assert words[:2] == ["drivesem", "edit"]
    monkeypatch.chdir(tmp_path)
    assert main(words[1:]) == 0
    drawn = files.read_image(tmp_path / "view.png")
    assert cv2.PSNR(pixels(page), drawn) > FAITHFUL_DB


def test_a_link_brings_everything_back(opened: Callable[..., Any]) -> None:
    link = {"frame": "still", "car": "1", "x": "weather.fog", "y": "objects[1].yaw", "show": "before"}
    page = opened(**link, **{"objects[1].yaw": 5, "weather.fog": 0.25, "weather.hail": 1, "foliage.hue": "green"})
    assert state(page) == link | {"objects[1].yaw": "5", "weather.fog": "0.25"}
    assert page.locator("#before").is_visible()
    assert page.input_value("#map-x") == "weather.fog"
    assert float(slider_of(page, "objects[1].yaw").input_value()) == 5
    assert page.locator('#cars [aria-pressed="true"]').inner_text().startswith("1 ")
    page.keyboard.press("l")
    page.wait_for_selector("#toast:not(:empty)")
    copied = page.evaluate("navigator.clipboard.readText()")
    page.goto("about:blank")
    page.goto(copied)
    settle(page)
    assert state(page) == link | {"objects[1].yaw": "5", "weather.fog": "0.25"}
    page.evaluate("location.hash = '#frame=still&car=1&objects%5B1%5D.yaw=999'")
    page.wait_for_selector("#view:not([data-settled])", state="attached")
    settle(page)
    assert state(page)["objects[1].yaw"] == "20", "ends at the slider's end"


def test_keys(opened: Callable[..., Any]) -> None:
    page = opened(frame="still", car=0)
    page.keyboard.press("b")
    assert page.locator("#before").is_visible()
    assert not page.locator("#after").is_visible()
    assert page.locator("#flip").get_attribute("aria-pressed") == "true"
    page.keyboard.press("b")
    assert page.locator("#after").is_visible()
    page.keyboard.press("d")
    assert not page.locator("#boxes").is_visible()
    page.keyboard.press("d")
    assert page.locator("#boxes").is_visible()
    page.keyboard.press("e")
    assert state(page)["objects[0].yaw"] == "0.5"
    page.keyboard.press("Shift+Q")
    assert state(page)["objects[0].yaw"] == "-4.5"
    page.keyboard.press("ArrowUp")
    page.keyboard.press("ArrowLeft")
    moved = {name.rpartition(".")[2] for name in state(page) if name.startswith("objects[0].translate")}
    assert moved == {"along", "across"}
    page.keyboard.press("r")
    assert not [name for name in state(page) if name.startswith("objects")]
    page.keyboard.press("n")
    assert state(page)["car"] == "1"
    page.keyboard.press("p")
    assert state(page)["car"] == "0"
    page.keyboard.press("?")
    shortcuts = page.inner_text("#keys").lower()
    assert all(words in shortcuts for words in ("before / after", "boxes on / off", "turn it", "copy the command"))


def test_arrows_follow_the_view(opened: Callable[..., Any], viewer: Viewer) -> None:
    page = opened(frame="still", car=0)
    rest = viewer.scene("still").sliders
    for key, axis, sign in (("ArrowUp", 2, 1), ("ArrowDown", 2, -1), ("ArrowRight", 0, 1), ("ArrowLeft", 0, -1)):
        page.keyboard.press(f"Shift+{key}")
        values = {name: float(text) for name, text in state(page).items() if name.startswith("objects[0]")}
        shift = rest.apply(rest.state(values)).objects.translation[0] - rest.rest.objects.translation[0]
        assert sign * float(shift[axis]) > 0.3, key
        page.keyboard.press("r")


def test_cars_are_dragged_from_above(opened: Callable[..., Any], viewer: Viewer) -> None:
    page = opened(frame="still", car=1)
    scene = viewer.scene("still").sliders
    body = page.locator('#street .car[data-car="0"] .body')
    body.scroll_into_view_if_needed()
    scale = page.evaluate("document.getElementById('street').getScreenCTM().a")
    box = body.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x, y - 0.25 * scale)
    page.mouse.move(x + 0.3 * scale, y - 0.5 * scale, steps=3)
    page.mouse.up()
    settle(page)
    shortcuts = state(page)
    assert shortcuts["car"] == "0"
    values = {name: float(text) for name, text in shortcuts.items() if name.startswith("objects[0]")}
    shift = scene.apply(scene.state(values)).objects.translation[0] - scene.rest.objects.translation[0]
    assert shift[[0, 2]].tolist() == pytest.approx([0.3, 0.5], abs=0.05)
    handle = page.locator("#street .turn").bounding_box()
    x, y = handle["x"] + handle["width"] / 2, handle["y"] + handle["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 0.5 * scale, y, steps=3)
    page.mouse.up()
    assert abs(float(state(page)["objects[0].yaw"])) > 3


def test_the_map_is_filled_and_sets_both_values(opened: Callable[..., Any]) -> None:
    page = opened(frame="still", car=0, x="objects[0].yaw", y="objects[0].paint.gloss")
    page.wait_for_selector('#map[data-cells="25"]', timeout=60000, state="attached")
    assert re.fullmatch(r"\d+ of 25 not found", page.inner_text("#map-status"))
    assert page.locator("#map .cell title").count() == 25
    cell = page.locator('#map .cell[data-i="4"][data-j="3"]')
    cell.scroll_into_view_if_needed()
    box = cell.bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    settle(page)
    shortcuts = state(page)
    assert (shortcuts["objects[0].yaw"], shortcuts["objects[0].paint.gloss"]) == ("20", "0.5")
    assert page.get_attribute("#map", "data-cells") == "25", "it does not depend on what is on its axes"
    slider_of(page, "weather.fog").fill("0.2")
    assert page.get_attribute("#map", "data-cells") == "0"


def test_a_slider_that_is_dragged_leaves_no_queue(opened: Callable[..., Any]) -> None:
    page = opened(frame="still", car=0)
    page.evaluate(
        """async () => {
            const slider = document.querySelector('input[data-name="objects[0].yaw"]');
            window.asked = performance.getEntriesByType("resource").length;
            for (let i = 0; i <= 100; i++) {
                slider.value = i / 10;
                slider.dispatchEvent(new Event("input", {bubbles: true}));
                await new Promise(done => setTimeout(done, 5));
            }
        }"""
    )
    settle(page)
    names = page.evaluate("performance.getEntriesByType('resource').slice(window.asked).map(e => e.name)")
    pictures = [name for name in names if "/picture" in name]
    assert 1 <= len(pictures) <= 60, "one at a time, and the last"
    assert "objects%5B0%5D.yaw=10&" in pictures[-1]
    assert state(page)["objects[0].yaw"] == "10"


def test_names_are_text(opened: Callable[..., Any]) -> None:
    page = opened()
    assert page.inner_text("#title") == "<script>title</script> · stubborn"
    assert page.locator("#frame option").all_inner_texts() == ["still", "<b>changed</b> (1 lost)"]
    page.select_option("#frame", CHANGED)
    page.wait_for_selector("#found:not(.hidden)")
    settle(page)
    found = state(page)
    assert found["frame"] == CHANGED
    assert any(name.startswith("objects[") for name in found), "begins with what the scene holds"
    page.keyboard.press("0")
    assert not any(name.startswith("objects[") for name in state(page))
    page.keyboard.press("f")
    assert state(page) == found


@pytest.mark.parametrize(("width", "height"), [(1400, 900), (390, 844)])
def test_everything_fits(width: int, height: int, opened: Callable[..., Any]) -> None:
    page = opened(width, height, frame="still", car=0)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for selector in ("#view", "#street", "#map", "#car-sliders", "#scene-sliders", "#command", "#cars"):
        box = page.locator(selector).bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= width + 1
        assert box["width"] > 250
    for element in page.locator("button:visible, select:visible, input:visible").all():
        name = element.evaluate("e => e.innerText || e.getAttribute('aria-label') || e.labels?.[0]?.innerText")
        assert name, "every control has a name"
    if width < 500:
        page.mouse.wheel(0, 2000)
        page.wait_for_timeout(500)  # scrolling takes its time, and the page's policy forbids to wait for a script
        assert page.evaluate("scrollY") > 500
        assert page.locator("#view").bounding_box()["y"] < 100, "the picture stays in sight"
