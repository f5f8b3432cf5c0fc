"""Finished runs of hand-made frames, and a page taken apart: no renderer, no detector."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from drivesem.attacks.targets import HEADLINE
from drivesem.config.commands import AttackConfig
from drivesem.config.options import to_yaml
from drivesem.run.results import BoxRecord, Coordinate, Failure, FrameResult, dump_frame
from scene_ir import files
from tests.drivesem.counting import summary_of

SIZE_WH = (320, 96)
CAR, OTHER, NOTHING = (40.0, 40.0, 90.0, 70.0), (230.0, 40.0, 280.0, 70.0), (150.0, 30.0, 200.0, 62.0)
Xyxy = tuple[float, float, float, float]
_VOID = ("meta", "link", "img", "input", "br")


def _box(
    xyxy: tuple[float, float, float, float], score: float | None = None, index: int | None = None
) -> BoxRecord:
    return BoxRecord(xyxy, HEADLINE, score=score, index=index)


def _frame(
    name: str, lost: bool = False, phantom: bool = False, yaw: float = 0.1, fog: float = 0.0, queries: int = 10
) -> FrameResult:
    """A frame of two cars. lost: the first scores 0.3 after the change and not 0.9; phantom: a third is seen."""
    moved = (CAR[0] + 4, CAR[1], CAR[2] + 4, CAR[3])
    cars = (_box(CAR, index=0), _box(OTHER, index=1))
    region = BoxRecord((0.0, 0.0, 20.0, 20.0), HEADLINE, ignore=True)
    seen = (_box(CAR, 0.9), _box(OTHER, 0.8))
    failures = [Failure("lost", HEADLINE, moved, index=0)] if lost else []
    after = [_box(moved, 0.3 if lost else 0.9), seen[1]]
    if phantom:
        after.append(_box(NOTHING, 0.7))
        failures.append(Failure("phantom", HEADLINE, NOTHING, score=0.7))
    theta = [
        Coordinate("objects[0].translate.along", "own lengths", 0.05, -0.25, 0.25, "0.21 m"),
        Coordinate("objects[0].translate.across", "own lengths", -0.02, -0.25, 0.25, "-0.08 m"),
        Coordinate("objects[0].yaw", "rad", yaw, -0.35, 0.35, f"{np.degrees(yaw):.3g} deg"),
        Coordinate("objects[1].ffd[0,0,0].x", "unit boxes", 0.01, -0.25, 0.25, "0.04 m"),
    ]
    if fog:
        theta.append(Coordinate("weather.fog", "code", fog, 0.0, 1.0, f"{fog:.3g}"))
    return FrameResult(
        identifier=name,
        objects=2,
        queries=queries,
        loss_trace=(1.0, 1.5, 2.0),
        theta=tuple(theta),
        active_constraints=(),
        violations=(),
        targets_benign=(*cars, region),
        targets_moved=(_box(moved, index=0), cars[1], region),
        detections_benign=seen,
        detections_rerendered=seen,
        detections_attacked=tuple(after),
        failures=tuple(failures),
        became_ignored=(),
        judged=(0, 1),
        found_before=(0, 1),
        success_paper=bool(failures),
        success_moved=bool(failures),
        identity_psnr_db=None,
        seconds=0.0,
    )


def _run(folder: Path, results: Sequence[FrameResult], config: AttackConfig | None = None, tone: int = 90) -> Path:
    """Write a run's folder. tone: of the photographs."""
    config = config or AttackConfig()
    photograph = np.full((SIZE_WH[1], SIZE_WH[0], 3), tone, np.uint8)
    photograph[40:70, 40:90], photograph[40:70, 230:280] = (160, 30, 30), (30, 30, 160)
    for result in results:
        frame = folder / "frames" / result.identifier
        for name, image in (
            ("benign", photograph),
            ("rerender", photograph),
            ("counterexample", np.roll(photograph, 4, axis=1)),
        ):
            files.write_png(frame / f"{name}.png", image)
        files.write_text(frame / "result.json", dump_frame(result))
    files.write_text(folder / "config.yaml", to_yaml(config))
    files.write_json(folder / "metrics.json", summary_of(config, results).to_json())
    files.write_json(folder / "manifest.json", {"frames": {r.identifier: {} for r in results}})
    return folder


class Parsed(HTMLParser):
    """tags: (name, attributes) in order; open_tags must be empty at the end; text: of the body."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.open_tags: list[str] = []
        self.text = ""
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {key: value or "" for key, value in attrs}))
        if tag not in _VOID:
            self.open_tags.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {key: value or "" for key, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self.open_tags.pop() == tag, f"</{tag}> closes another"

    def handle_data(self, data: str) -> None:
        if not {"script", "style"} & set(self.open_tags):
            self.text += data

    def having(self, tag: str, **attributes: str) -> list[dict[str, str]]:
        """Attributes of all such elements."""
        return [a for name, a in self.tags if name == tag and all(a.get(k) == v for k, v in attributes.items())]


@pytest.fixture
def frame() -> Callable[..., FrameResult]:
    return _frame


@pytest.fixture
def make_run() -> Callable[..., Path]:
    return _run


@pytest.fixture
def some_run(tmp_path: Path) -> Path:
    """Four frames: nothing failed, a lost car, a phantom, and both."""
    frames = [
        _frame("000001", yaw=0.02),
        _frame("000002", lost=True, yaw=0.3),
        _frame("000003", phantom=True, fog=0.2),
        _frame("0001/rain/00004", lost=True, phantom=True, yaw=-0.2),
    ]
    return _run(tmp_path / "runs" / "some run", frames)


@pytest.fixture
def parse() -> Callable[[Path], Parsed]:
    return lambda path: Parsed(path.read_text(encoding="utf-8"))
