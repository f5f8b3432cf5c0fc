"""A generated street as a run left it and as it was photographed, and a detector that never looks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from torch import Tensor

from detectors.types import CLASSES, Detections
from drivesem.attacks.budgets import PRESETS
from drivesem.viewer.server import Server, Viewer, ViewerFrame
from scene_ir.io import load_scene, save_scene
from scene_ir.types import SceneIR

SCORE = 0.9
GRID = 5


class Stubborn:
    """Finds what was photographed where it was photographed, whatever the picture shows."""

    name = "stubborn"
    classes: tuple[str, ...] = CLASSES

    def __init__(self, scene: SceneIR) -> None:
        objects = scene.objects
        order = objects.occlusion.argsort()
        self.found = Detections(
            objects.box2d[order].float(),
            objects.category[order],
            objects.box2d.new_full((len(objects),), SCORE).float(),
        )

    def forward(self, images: Tensor) -> int:
        return len(images)

    def decode(self, raw: int) -> list[Detections]:
        return [self.found] * raw


@pytest.fixture(scope="session")
def changed(small_run: Path) -> Path:
    """A scene's folder with its vehicles moved and turned."""
    return small_run / "frames" / "demo-000" / "scene"


@pytest.fixture(scope="session")
def still(changed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same scene's as it was photographed."""
    folder = tmp_path_factory.mktemp("scenes") / "it's still"
    save_scene(load_scene(changed).unperturbed(), folder)
    return folder


@pytest.fixture(scope="session")
def stubborn(still: Path) -> Stubborn:
    return Stubborn(load_scene(still))


@pytest.fixture(scope="session")
def viewer(still: Path, changed: Path, stubborn: Stubborn) -> Iterator[Viewer]:
    frames = {"still": ViewerFrame(still), "<b>changed</b>": ViewerFrame(changed, "1 lost")}
    made = Viewer("<script>title</script>", frames, stubborn, PRESETS["street"], grid=GRID)
    yield made
    made.close()


@contextmanager
def _served(viewer: Viewer) -> Iterator[Server]:
    server = Server(viewer, 0)
    thread = Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@pytest.fixture(scope="session")
def server(viewer: Viewer) -> Iterator[Server]:
    with _served(viewer) as made:
        yield made


@pytest.fixture(scope="session")
def served() -> Callable[[Viewer], Any]:
    """A viewer at a port, as a context."""
    return _served
