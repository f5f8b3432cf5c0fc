"""How long `drivesem view` takes to answer a slider: over HTTP, and in a browser from the slider to the screen."""

from __future__ import annotations

import http.client
import json
import shutil
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any
from urllib.parse import urlencode

from detectors.base import Predictor
from drivesem.attacks.budgets import PRESETS, STREET
from drivesem.bench.session import Columns
from drivesem.bench.timing import Spread
from drivesem.scenes.scene import demo_scene
from drivesem.scenes.sources import find_scene_folders
from drivesem.viewer.server import HOST, Server, Viewer, ViewerFrame
from drivesem.viewer.sliders import Slider
from scene_ir.io import save_scene

TITLE = "The viewer's answer to a slider"
COLUMNS: Columns = {
    "slider": ("slider", "slider"), "size": ("picture, px", "px"), "cars": ("vehicles", "cars"),
    "where": ("where", "where"), "states": ("states", "states"),
    "picture_ms": ("picture, ms", "picture"), "picture_iqr_ms": ("IQR", "IQR"),
    "detections_ms": ("detections, ms", "detections"), "detections_iqr_ms": ("IQR", "IQR"),
    "cpu_ms": ("of the processor, ms", "CPU"),
}  # fmt: skip
METHOD = (
    "The server of drivesem view in this process, queried over its port as by the page: picture and detections "
    "of a state at once, on two connections that stay open, each state new. HTTP: from the request to the last "
    "byte. Browser: in headless Chromium, from the slider's event to the decoded picture, and to the boxes that "
    "are drawn; left out where Debian's chromium or Playwright is missing. Medians and quartiles; the processor's "
    "time is of all threads of the server, for both answers. Sliders: the nearest judged vehicle's place, heading "
    "and paint, and fog, in which the detector sees the whole picture anew."
)
QUICK_STATES, FULL_STATES = 10, 30
_LASTS = ("translate.along", "yaw", "paint.lightness")
_SCENE = "weather.fog"
_FETCH_SCRIPT = """async ([name, value]) => {
    const slider = document.querySelector(`input[data-name="${name}"]`), view = document.getElementById("view");
    slider.value = value;
    slider.dispatchEvent(new Event("input", {bubbles: true}));
    while (!view.dataset.settled) await new Promise(requestAnimationFrame);
    const {picture, detections} = document.getElementById("times").dataset;
    return [Number(picture), Number(detections)];
}"""


@dataclass(frozen=True, slots=True)
class ViewerRow:
    """One slider."""

    slider: str
    size: str
    cars: int
    where: str
    """HTTP or browser."""
    states: int
    picture_ms: float
    picture_iqr_ms: float
    detections_ms: float
    detections_iqr_ms: float
    cpu_ms: float | None
    """Median of a state's, of the server; None where a browser shares the processor's work."""


def measure(scene: Path | None, detector: Predictor, states: int, seed: int) -> Iterator[ViewerRow]:
    """Rows of a scene's folder, or of the first embedded one."""
    with tempfile.TemporaryDirectory(prefix="drivesem-bench-") as made:
        if scene is None:
            name, folder = "demo", Path(made) / "demo"
            save_scene(demo_scene(seed=seed).ir, folder)
        else:
            name, folder = next(iter(find_scene_folders(scene).items()))
        viewer = Viewer(name, {name: ViewerFrame(folder)}, detector, PRESETS[STREET])
        with _served(viewer) as server:
            stage = viewer.scene(name)
            camera, cars = stage.sliders.rest.camera, len(stage.sliders.rest.objects)
            facts = (f"{camera.width} x {camera.height}", cars)
            wanted = [f"objects[{stage.focus}].{last}" for last in _LASTS]
            knobs = [stage.sliders.sliders[n] for n in (*wanted, _SCENE) if n in stage.sliders.sliders]
            for knob in knobs:
                times = _over_http(server, name, knob, states)
                yield _row(knob, facts, "HTTP", *times)
            with _browser() as browser:
                if browser is not None:
                    page = browser.new_page()
                    page.goto(f"{server.url}#{urlencode({'frame': name, 'car': stage.focus})}")
                    page.wait_for_selector("#view[data-settled]")
                    for knob in knobs:
                        yield _row(knob, facts, "browser", *_in_browser(page, knob, states))


def _values(knob: Slider, states: int) -> list[float]:
    """As many values, none of them 0, with one more to warm up on."""
    return [round(knob.high * (i + 1) / (states + 2), 4) for i in range(states + 1)]


def _over_http(
    server: Server, name: str, knob: Slider, states: int
) -> tuple[list[float], list[float], list[float] | None]:
    lines = [http.client.HTTPConnection(HOST, server.server_port, timeout=60) for _ in range(2)]
    found: list[tuple[float, float, float]] = []
    with ThreadPoolExecutor(2) as pool:
        for value in _values(knob, states):
            query = urlencode({"frame": name, knob.name: value})
            cpu = time.process_time()
            responses = [
                pool.submit(_get, line, f"{path}?{query}") for line, path in zip(lines, _PATHS, strict=True)
            ]
            picture, detections = (one.result() for one in responses)
            found.append((picture, detections, 1e3 * (time.process_time() - cpu)))
    for line in lines:
        line.close()
    pictures, detections, cpu = zip(*found[1:], strict=True)
    return list(pictures), list(detections), list(cpu)


_PATHS = ("/picture", "/detections")


def _get(line: http.client.HTTPConnection, path: str) -> float:
    """Milliseconds until an answer is there."""
    start = time.perf_counter()
    line.request("GET", path)
    answer = line.getresponse()
    content = answer.read()
    taken = 1e3 * (time.perf_counter() - start)
    if answer.status != http.client.OK:
        raise RuntimeError(f"{path}: {content[:200]!r}")
    if path.startswith(_PATHS[1]):
        json.loads(content)
    return taken


def _in_browser(page: Any, knob: Slider, states: int) -> tuple[list[float], list[float], None]:
    times = [page.evaluate(_FETCH_SCRIPT, [knob.name, value]) for value in _values(knob, states)][1:]
    page.evaluate(_FETCH_SCRIPT, [knob.name, 0])
    return [picture for picture, _ in times], [detections for _, detections in times], None


def _row(
    knob: Slider,
    facts: tuple[str, int],
    where: str,
    pictures: list[float],
    detections: list[float],
    cpu: list[float] | None,
) -> ViewerRow:
    picture, found = Spread.from_values(pictures), Spread.from_values(detections)
    return ViewerRow(
        slider=knob.name,
        size=facts[0],
        cars=facts[1],
        where=where,
        states=len(pictures),
        picture_ms=round(picture.median, 1),
        picture_iqr_ms=round(picture.iqr, 1),
        detections_ms=round(found.median, 1),
        detections_iqr_ms=round(found.iqr, 1),
        cpu_ms=None if cpu is None else round(Spread.from_values(cpu).median, 1),
    )


@contextmanager
def _served(viewer: Viewer) -> Iterator[Server]:
    server = Server(viewer, 0)
    thread = Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        viewer.close()
        thread.join()


@contextmanager
def _browser() -> Iterator[Any | None]:
    """Debian's Chromium, headless, or None."""
    path = shutil.which("chromium")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        path = None
    if path is None:
        yield None
        return
    with sync_playwright() as driver:  # pyright: ignore[reportPossiblyUnboundVariable]
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        try:
            yield browser
        finally:
            browser.close()
