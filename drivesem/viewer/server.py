"""Serve the viewer's page and data over HTTP on this machine.

The server listens on 127.0.0.1 and only answers GET requests, which change nothing. A request must name this server as
its host, so that no other site can reach it through DNS rebinding. Anything unknown gets one line and a 4xx status.
"""

from __future__ import annotations

import json
import math
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import parse_qsl, urlsplit

from detectors.base import DetectorError, Predictor
from detectors.registry import load_predictor
from drivesem.attacks.budgets import parse_budget
from drivesem.attacks.space import Budget
from drivesem.attacks.targets import EvaluatedClasses
from drivesem.config.commands import ViewConfig
from drivesem.config.errors import UsageError
from drivesem.reporting.tables import format_count
from drivesem.reporting.web import render_page
from drivesem.run.feature_map import FailureMap
from drivesem.run.finished import load_runs
from drivesem.run.folder import CONFIG, load_run_detector, load_trusted_config
from drivesem.run.frame import build_map
from drivesem.run.results import FrameResult
from drivesem.scenes.sources import find_scene_folders
from drivesem.viewer.scene import InteractiveScene
from drivesem.viewer.sliders import State
from scene_ir import files
from scene_ir.errors import SceneError, make_printable
from scene_ir.io import count_objects

HOST = "127.0.0.1"
GRID = 9
"""Cells of a failure map per axis: at most a minute on two cores."""
POLICY = (
    "default-src 'none'; img-src 'self' blob: data:; style-src 'self'; script-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content security policy of the page."""
_HTML = "text/html; charset=utf-8"
_ASSETS = {
    "/": ("drivesem.viewer", "page.html", _HTML),
    "/page.css": ("drivesem.viewer", "page.css", "text/css; charset=utf-8"),
    "/page.js": ("drivesem.viewer", "page.js", "text/javascript; charset=utf-8"),
    "/report.css": ("drivesem.reporting", "style.css", "text/css; charset=utf-8"),
}
_JSON, _JPEG, _PNG, _TEXT = "application/json", "image/jpeg", "image/png", "text/plain; charset=utf-8"
_MAX_SCENES, _MAX_PAGES = 2, 64
_MOST_FIELDS = 2000
_CLOSE_TIMEOUT_S = 10.0
_BACKGROUND = "background"
"""Kind of a background request, which runs while nothing moves."""
_LONGEST_LINE = 300

T = TypeVar("T")


class RefusedError(ValueError):
    """A request that is answered with one line and an error status."""

    def __init__(self, message: str, status: HTTPStatus = HTTPStatus.BAD_REQUEST) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True, slots=True)
class ViewerFrame:
    """One frame of the viewer."""

    folder: Path
    """Folder of its scene."""
    words: str = ""
    """Text after its name in the list of frames."""


@dataclass(frozen=True, slots=True)
class RequestOrder:
    """Position of a request among those of its page, to drop superseded ones."""

    page: str
    """Identifier of the page; "" if it sends none."""
    number: int
    """Increases with each state of the page."""


class Viewer:
    """Answers the requests of the page.

    Rendering and detecting run in one thread each, so the next picture is rendered while the detector evaluates the
    last one. A waiting request is dropped when its page sends a later one.
    """

    def __init__(
        self,
        title: str,
        frames: Mapping[str, ViewerFrame],
        detector: Predictor,
        budget: Budget,
        t_star: float | None = None,
        grid: int = GRID,
        failure_map: FailureMap | None = None,
    ) -> None:
        """Create a viewer.

        Args:
            title: Title of the page.
            frames: Frames by name.
            detector: Detector that evaluates each state.
            budget: Range of the sliders.
            t_star: Score from which a detection counts; None: the detector's own.
            grid: Cells of the failure map per axis.
            failure_map: What the run searched; None if the frames are of no run.
        """
        self.grid, self.failure_map = grid, failure_map or FailureMap()
        self.title, self.frames, self.detector = title, frames, detector
        self._budget, self._t_star = budget, t_star
        self._scenes: OrderedDict[str, InteractiveScene] = OrderedDict()
        self._latest: OrderedDict[str, dict[str, int]] = OrderedDict()
        self._loading, self._orders_lock = threading.Lock(), threading.Lock()
        self._render_pool, self._detect_pool = (
            ThreadPoolExecutor(1, thread_name_prefix=name) for name in ("render", "detect")
        )

    def overview(self) -> dict[str, Any]:
        """Title, detector and frames, as JSON values."""
        frames = [{"name": name, "words": frame.words} for name, frame in self.frames.items()]
        return {"title": self.title, "detector": self.detector.name, "grid": self.grid, "frames": frames}

    def searched(self) -> str:
        """Table of what the run searched, as HTML; "" if the frames are of no run."""
        if not self.failure_map.searched:
            return ""
        return render_page("drivesem.run.report:map.html", map=self.failure_map, links=True)

    def facts(self, name: str) -> dict[str, Any]:
        """Sliders and vehicles of a frame, as JSON values."""
        scene = self.scene(name)
        return {"name": name, **self._detect_pool.submit(scene.facts).result()}

    def photograph(self, name: str) -> bytes:
        """JPEG of a frame's photograph."""
        return self.scene(name).encode_photograph()

    def street(self, name: str) -> bytes:
        """PNG of a frame's ground from above."""
        return self.scene(name).encode_street()

    def picture(self, name: str, values: Mapping[str, float], order: RequestOrder) -> bytes:
        """JPEG of a state.

        Args:
            name: Name of the frame.
            values: Slider values.
            order: Position of the request.
        """
        scene, state = self._register_request(name, values, order, "picture")
        rendered = self._run_latest(self._render_pool, lambda: scene.render_state(state), order, "picture")
        return scene.encode_picture(rendered)

    def detections(self, name: str, values: Mapping[str, float], order: RequestOrder) -> dict[str, Any]:
        """Detections in a state, as JSON values.

        Args:
            name: Name of the frame.
            values: Slider values.
            order: Position of the request.
        """
        scene, state = self._register_request(name, values, order, "detections")
        rendered = self._run_latest(self._render_pool, lambda: scene.render_state(state), order, "detections")
        return self._run_latest(self._detect_pool, lambda: scene.detect(state, rendered), order, "detections")

    def score(self, name: str, values: Mapping[str, float], order: RequestOrder, car: int) -> dict[str, Any]:
        """Status and score of one vehicle in a state, as JSON values.

        Args:
            name: Name of the frame.
            values: Slider values.
            order: Position of the request.
            car: Row of the vehicle.
        """
        scene, state = self._register_request(name, values, order, _BACKGROUND)
        if not 0 <= car < len(scene.sliders.rest.objects):
            raise RefusedError(f"car: expected a row of the scene, found {car}")
        known = scene.known_score(state, car)
        if known is not None:
            return known
        rendered = self._run_latest(
            self._render_pool, lambda: scene.render_state(state, keep=False), order, _BACKGROUND
        )
        return self._run_latest(self._detect_pool, lambda: scene.score(state, car, rendered), order, _BACKGROUND)

    def notes(self, name: str, values: Mapping[str, float], order: RequestOrder) -> list[str]:
        """Violated constraints in a state.

        Args:
            name: Name of the frame.
            values: Slider values.
            order: Position of the request.
        """
        scene, state = self._register_request(name, values, order, _BACKGROUND)
        rendered = self._run_latest(self._render_pool, lambda: scene.render_state(state), order, _BACKGROUND)
        return self._run_latest(self._detect_pool, lambda: scene.notes(rendered), order, _BACKGROUND)

    def scene(self, name: str) -> InteractiveScene:
        """Load a frame, or return the cached one."""
        frame = self.frames.get(name)
        if frame is None:
            raise RefusedError(
                f"frame: expected one of {len(self.frames)} frames, found {make_printable(name) or 'none'}"
            )
        with self._loading:
            known = self._scenes.get(name)
            if known is None:
                make = partial(InteractiveScene, frame.folder, self.detector, self._budget, self._t_star)
                # loading renders and detects, so it needs both threads
                known = self._render_pool.submit(lambda: self._detect_pool.submit(make).result()).result()
                self._scenes[name] = known
                while len(self._scenes) > _MAX_SCENES:
                    self._scenes.popitem(last=False)
            else:
                self._scenes.move_to_end(name)
            return known

    def close(self) -> None:
        """Stop the threads."""
        for pool in (self._render_pool, self._detect_pool):
            pool.shutdown(wait=False, cancel_futures=True)

    def _register_request(
        self, name: str, values: Mapping[str, float], order: RequestOrder, kind: str
    ) -> tuple[InteractiveScene, State]:
        scene = self.scene(name)
        state = scene.sliders.state(values)
        if order.page:
            with self._orders_lock:
                latest = self._latest.setdefault(order.page, {})
                latest[kind] = max(order.number, latest.get(kind, 0))
                self._latest.move_to_end(order.page)
                while len(self._latest) > _MAX_PAGES:
                    self._latest.popitem(last=False)
        return scene, state

    def _run_latest(self, pool: ThreadPoolExecutor, work: Callable[[], T], order: RequestOrder, kind: str) -> T:
        """Run `work` in a pool. Raises RefusedError if the page has sent a later request of the same kind, or for a
        background request any later one.
        """

        def work_if_latest() -> T:
            with self._orders_lock:
                latest = self._latest.get(order.page, {})
                newest = max(latest.values(), default=0) if kind == _BACKGROUND else latest.get(kind, 0)
            if order.number < newest:
                raise RefusedError("superseded by a later request", HTTPStatus.CONFLICT)
            return work()

        return pool.submit(work_if_latest).result()


class Server(ThreadingHTTPServer):
    """The HTTP server of one viewer; port 0 is any free one."""

    daemon_threads = True

    def __init__(self, viewer: Viewer, port: int) -> None:
        self.viewer = viewer
        self._active_requests, self._ended = 0, False
        self._changed = threading.Condition()
        super().__init__((HOST, port), _Handler)
        number = self.server_port
        self.hosts = frozenset(f"{name}:{number}" for name in (HOST, "localhost"))

    @contextmanager
    def answering(self) -> Iterator[None]:
        """Count a request that is being answered. Raises RefusedError after the server has ended."""
        with self._changed:
            if self._ended:
                raise RefusedError("drivesem view has ended", HTTPStatus.SERVICE_UNAVAILABLE)
            self._active_requests += 1
        try:
            yield
        finally:
            with self._changed:
                self._active_requests -= 1
                self._changed.notify_all()

    def server_close(self) -> None:
        """Close after running requests have finished: the interpreter would abort while library code runs in another
        thread.
        """
        super().server_close()
        with self._changed:
            self._ended = True
            self._changed.wait_for(lambda: self._active_requests == 0, _CLOSE_TIMEOUT_S)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report errors in one line; a closed connection is none."""
        error = sys.exception()
        if not isinstance(error, ConnectionError | TimeoutError):
            sys.stderr.write(f"drivesem: {type(error).__name__}: {' '.join(str(error).split())}\n")

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self.server_port}/"


class _Handler(BaseHTTPRequestHandler):
    server: Server  # pyright: ignore[reportIncompatibleVariableOverride]
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # head and body are two packets, and the second must not wait
    timeout = 300

    def do_GET(self) -> None:
        try:
            with self.server.answering():
                content, kind = self._answer()
            status = HTTPStatus.OK
        except RefusedError as error:
            content, kind, status = _line(error), _TEXT, error.status
        except SceneError as error:
            content, kind, status = _line(error), _TEXT, HTTPStatus.BAD_REQUEST
        except Exception as error:  # an internal error: the page displays it and continues
            sys.stderr.write(
                f"drivesem: {make_printable(self.path, _LONGEST_LINE)}: {type(error).__name__}: {error}\n"
            )
            content, kind, status = _line(error), _TEXT, HTTPStatus.INTERNAL_SERVER_ERROR
        self._send(content, kind, status)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer other methods, and malformed requests, with one line."""
        self.close_connection = True
        status = HTTPStatus(code)
        self._send(f"{message or status.phrase}\n".encode(), _TEXT, status)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing: a slider sends thirty requests a second."""

    def _answer(self) -> tuple[bytes, str]:
        if self.headers.get("Host", "").lower() not in self.server.hosts:
            raise RefusedError(f"Host: expected {self.server.url}, found another name", HTTPStatus.FORBIDDEN)
        if self.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin") and self.path != "/":
            raise RefusedError("expected a request of this page, found another site's", HTTPStatus.FORBIDDEN)
        address = urlsplit(self.path)
        if address.path in _ASSETS:
            package, name, kind = _ASSETS[address.path]
            return resources.files(package).joinpath(name).read_bytes(), kind
        route = _ROUTES.get(address.path)
        if route is None:
            raise RefusedError(f"{make_printable(address.path)}: expected a known address", HTTPStatus.NOT_FOUND)
        return route(self.server.viewer, _Query.parse(address.query))

    def _send(self, content: bytes, kind: str, status: HTTPStatus) -> None:
        try:
            self.send_response(status)
            for name, value in (
                ("Content-Type", kind),
                ("Content-Length", str(len(content))),
                ("Content-Security-Policy", POLICY),
                ("Cross-Origin-Resource-Policy", "same-origin"),
                ("Referrer-Policy", "no-referrer"),
                ("X-Content-Type-Options", "nosniff"),
                ("Cache-Control", "no-store"),
            ):
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)
        except ConnectionError:  # the page was closed, or sent a later request
            self.close_connection = True

    def version_string(self) -> str:
        return "drivesem"


@dataclass(frozen=True, slots=True)
class _Query:
    """The parsed query of a request; `values` by slider name."""

    frame: str
    order: RequestOrder
    car: int
    values: dict[str, float]

    @classmethod
    def parse(cls, text: str) -> _Query:
        """Parse a query string. Raises RefusedError."""
        try:
            pairs = parse_qsl(text, keep_blank_values=True, max_num_fields=_MOST_FIELDS, errors="strict")
        except ValueError as error:
            raise RefusedError("query: expected NAME=VALUE with &, found something else") from error
        fields = dict(pairs)
        if len(fields) < len(pairs):
            raise RefusedError("query: expected each name once, found one twice")
        frame, page = fields.pop("frame", ""), fields.pop("page", "")
        number, car = (_whole(name, fields.pop(name, "0")) for name in ("n", "car"))
        if len(page) > 40:
            raise RefusedError("page: expected at most 40 characters, found more")
        return cls(
            frame, RequestOrder(page, number), car, {name: _number(name, value) for name, value in fields.items()}
        )


def _whole(name: str, text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 15):
        raise RefusedError(f"{name}: expected a whole number from 0, found {make_printable(text)}")
    return int(text)


def _number(name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise RefusedError(f"{make_printable(name)}: expected a number, found {make_printable(text)}")
    return value


def _line(error: Exception) -> bytes:
    return (" ".join(make_printable(error, _LONGEST_LINE).split()) + "\n").encode()


def _json(value: object) -> tuple[bytes, str]:
    return json.dumps(value).encode(), _JSON


_ROUTES: Mapping[str, Callable[[Viewer, _Query], tuple[bytes, str]]] = {
    "/overview": lambda viewer, _: _json(viewer.overview()),
    "/searched": lambda viewer, _: (viewer.searched().encode(), _HTML),
    "/frame": lambda viewer, q: _json(viewer.facts(q.frame)),
    "/photograph": lambda viewer, q: (viewer.photograph(q.frame), _JPEG),
    "/street": lambda viewer, q: (viewer.street(q.frame), _PNG),
    "/picture": lambda viewer, q: (viewer.picture(q.frame, q.values, q.order), _JPEG),
    "/detections": lambda viewer, q: _json(viewer.detections(q.frame, q.values, q.order)),
    "/score": lambda viewer, q: _json(viewer.score(q.frame, q.values, q.order, q.car)),
    "/notes": lambda viewer, q: _json(viewer.notes(q.frame, q.values, q.order)),
}


_SETTING = "SCENE|RUN"
_DEFAULT_DETECTOR = "squeezedet"


@dataclass(frozen=True, slots=True)
class ViewerFrames:
    """The frames of one viewer and the settings that they share."""

    title: str
    """Title of the page."""
    frames: Mapping[str, ViewerFrame]
    """Frames by name; the page opens the first one."""
    detector: Predictor
    """Detector that evaluates each state."""
    budget: Budget
    """Range of the sliders."""
    t_star: float | None
    """Score from which a detection counts; None: the detector's own."""
    failure_map: FailureMap | None = None
    """What the run searched; None if the frames are of no run."""


def open_viewer_frames(config: ViewConfig) -> ViewerFrames:
    """Open the scenes or the run that a command names.

    Raises UsageError for a path or detector that cannot be used, FormatError for a damaged file.
    """
    path = Path(config.scene)
    budget, t_star, failure_map = parse_budget(config.budget), config.t_star, None
    if _is_run(path):
        (run,) = load_runs([config.scene], setting=_SETTING)
        frames = {
            frame.result.identifier: ViewerFrame(frame.folder / "scene", _summarize_frame(frame.result))
            for frame in run.frames
        }
        failure_map = build_map([frame.result for frame in run.frames])
        attack = load_trusted_config(run.folder, config.trust, _SETTING)
        t_star = attack.t_star if t_star is None else t_star
        own = config.detector is None
        detector = load_run_detector(attack, config.device, _SETTING) if own else _load_detector(config)
    else:
        if not path.is_dir():
            raise UsageError(_SETTING, "a scene of drivesem derender, a folder of some, or a run", config.scene)
        frames = {name: ViewerFrame(folder) for name, folder in find_scene_folders(path).items()}
        detector = _load_detector(config)
    if config.frame is not None and config.frame not in frames:
        raise UsageError("--frame", f"a frame of {config.scene}", config.frame)
    first = config.frame or next((name for name, frame in frames.items() if count_objects(frame.folder)), None)
    if first is not None:
        frames = {first: frames[first], **frames}
    return ViewerFrames(path.resolve().name, frames, detector, budget, t_star, failure_map)


def _is_run(path: Path) -> bool:
    """Whether a folder is a run of drivesem attack. A folder of drivesem derender has settings too."""
    if not (path / CONFIG).is_file():
        return False
    settings = files.read_yaml(path / CONFIG)
    return isinstance(settings, dict) and {"detector", "params", "combo"} <= settings.keys()


def _load_detector(config: ViewConfig) -> Predictor:
    try:
        detector = load_predictor(config.detector or _DEFAULT_DETECTOR, config.device, config.tiles)
        EvaluatedClasses.from_detector(detector)
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector that knows cars", error) from error
    return detector


def _summarize_frame(result: FrameResult) -> str:
    """Failures of a frame in a few words."""
    kinds = [failure.kind for failure in result.failures]
    lost, phantoms = kinds.count("lost"), kinds.count("phantom")
    parts = [f"{lost} lost"] if lost else []
    parts += [format_count(phantoms, "phantom")] if phantoms else []
    return ", ".join(parts) or ("withstood" if result.attacked else "not attacked")
