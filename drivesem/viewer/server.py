"""The page and its answers over HTTP, for this machine alone.

Bound to 127.0.0.1. Everything is a GET that changes nothing. A request must name this server as its host, so that
no other site's page can ask by a name of its own that leads here, and what it asks must be known: anything else
gets one line and a 4xx.
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

from detectors.base import Predictor
from drivesem.attack.space import Budget
from drivesem.viewer.knobs import State
from drivesem.viewer.stage import Stage
from scene_ir.errors import SceneError, shown

HOST = "127.0.0.1"
GRID = 9
"""Cells of a failure map each way: a minute at most on two cores."""
POLICY = (
    "default-src 'none'; img-src 'self' blob: data:; style-src 'self'; script-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""What the page may do."""
_ASSETS = {
    "/": ("drivesem.viewer", "page.html", "text/html; charset=utf-8"),
    "/page.css": ("drivesem.viewer", "page.css", "text/css; charset=utf-8"),
    "/page.js": ("drivesem.viewer", "page.js", "text/javascript; charset=utf-8"),
    "/report.css": ("drivesem.report", "style.css", "text/css; charset=utf-8"),
}
_JSON, _JPEG, _PNG, _TEXT = "application/json", "image/jpeg", "image/png", "text/plain; charset=utf-8"
_KEPT_STAGES, _KEPT_PAGES = 2, 64
_MOST_FIELDS = 2000
_PATIENCE_S = 10.0
_ASIDE = "aside"
"""A kind of request: for what is looked at while nothing moves."""
_LONGEST_LINE = 300

T = TypeVar("T")


class RefusedError(ValueError):
    """A request that gets one line and a status."""

    def __init__(self, words: str, status: HTTPStatus = HTTPStatus.BAD_REQUEST) -> None:
        super().__init__(words)
        self.status = status


@dataclass(frozen=True, slots=True)
class ShownFrame:
    """A scene's folder, and what is said of it beside its name."""

    folder: Path
    words: str = ""


@dataclass(frozen=True, slots=True)
class Turn:
    """Which of a page's states a request is about. page: "" where it does not say."""

    page: str
    number: int


class Viewer:
    """What the server answers. frames: by name; title: of the page. budget, t_star: as of `Stage`; grid: cells of
    the failure map, each way.

    Drawing and looking have a thread each, so that the next picture is drawn while the detector looks at the last
    one. A request that a page has followed by a later one is dropped where it waits: queues don't grow.
    """

    def __init__(
        self,
        title: str,
        frames: Mapping[str, ShownFrame],
        detector: Predictor,
        budget: Budget,
        t_star: float | None = None,
        grid: int = GRID,
    ) -> None:
        self.grid = grid
        self.title, self.frames, self.detector = title, frames, detector
        self._budget, self._t_star = budget, t_star
        self._stages: OrderedDict[str, Stage] = OrderedDict()
        self._latest: OrderedDict[str, dict[str, int]] = OrderedDict()
        self._making, self._turns = threading.Lock(), threading.Lock()
        self._draw, self._see = (ThreadPoolExecutor(1, thread_name_prefix=name) for name in ("draw", "see"))

    def overview(self) -> dict[str, Any]:
        """What there is to see; for JSON."""
        frames = [{"name": name, "words": frame.words} for name, frame in self.frames.items()]
        return {"title": self.title, "detector": self.detector.name, "grid": self.grid, "frames": frames}

    def facts(self, name: str) -> dict[str, Any]:
        """A frame's knobs and vehicles."""
        stage = self.stage(name)
        return {"name": name, **self._see.submit(stage.facts).result()}

    def photograph(self, name: str) -> bytes:
        """A frame's photograph, JPEG."""
        return self.stage(name).photograph()

    def street(self, name: str) -> bytes:
        """A frame's ground from above, PNG."""
        return self.stage(name).street()

    def picture(self, name: str, values: Mapping[str, float], turn: Turn) -> bytes:
        """A state's picture, JPEG."""
        stage, state = self._asked(name, values, turn, "picture")
        drawn = self._in_turn(self._draw, lambda: stage.drawn(state), turn, "picture")
        return stage.picture(drawn)

    def detections(self, name: str, values: Mapping[str, float], turn: Turn) -> dict[str, Any]:
        """What the detector finds in a state."""
        stage, state = self._asked(name, values, turn, "detections")
        drawn = self._in_turn(self._draw, lambda: stage.drawn(state), turn, "detections")
        return self._in_turn(self._see, lambda: stage.seen(state, drawn), turn, "detections")

    def score(self, name: str, values: Mapping[str, float], turn: Turn, car: int) -> dict[str, Any]:
        """What the detector makes of one vehicle in a state."""
        stage, state = self._asked(name, values, turn, _ASIDE)
        if not 0 <= car < len(stage.knobs.rest.objects):
            raise RefusedError(f"car: expected a row of the scene, found {car}")
        known = stage.known_score(state, car)
        if known is not None:
            return known
        drawn = self._in_turn(self._draw, lambda: stage.drawn(state, keep=False), turn, _ASIDE)
        return self._in_turn(self._see, lambda: stage.score(state, car, drawn), turn, _ASIDE)

    def notes(self, name: str, values: Mapping[str, float], turn: Turn) -> list[str]:
        """What no car can do in a state."""
        stage, state = self._asked(name, values, turn, _ASIDE)
        drawn = self._in_turn(self._draw, lambda: stage.drawn(state), turn, _ASIDE)
        return self._in_turn(self._see, lambda: stage.notes(drawn), turn, _ASIDE)

    def stage(self, name: str) -> Stage:
        """A frame made ready, or as it was before."""
        frame = self.frames.get(name)
        if frame is None:
            raise RefusedError(f"frame: expected one of {len(self.frames)} frames, found {shown(name) or 'none'}")
        with self._making:
            known = self._stages.get(name)
            if known is None:
                make = partial(Stage, frame.folder, self.detector, self._budget, self._t_star)
                # it draws and looks: neither thread may do so for another frame meanwhile
                known = self._draw.submit(lambda: self._see.submit(make).result()).result()
                self._stages[name] = known
                while len(self._stages) > _KEPT_STAGES:
                    self._stages.popitem(last=False)
            else:
                self._stages.move_to_end(name)
            return known

    def close(self) -> None:
        """Let go of the threads."""
        for pool in (self._draw, self._see):
            pool.shutdown(wait=False, cancel_futures=True)

    def _asked(self, name: str, values: Mapping[str, float], turn: Turn, kind: str) -> tuple[Stage, State]:
        stage = self.stage(name)
        state = stage.knobs.state(values)
        if turn.page:
            with self._turns:
                latest = self._latest.setdefault(turn.page, {})
                latest[kind] = max(turn.number, latest.get(kind, 0))
                self._latest.move_to_end(turn.page)
                while len(self._latest) > _KEPT_PAGES:
                    self._latest.popitem(last=False)
        return stage, state

    def _in_turn(self, pool: ThreadPoolExecutor, work: Callable[[], T], turn: Turn, kind: str) -> T:
        """Work in its thread. RefusedError where the page asked for a later state's meanwhile; of what is asked
        aside, where it asked anything about one.
        """

        def do() -> T:
            with self._turns:
                latest = self._latest.get(turn.page, {})
                newest = max(latest.values(), default=0) if kind == _ASIDE else latest.get(kind, 0)
            if turn.number < newest:
                raise RefusedError("superseded by a later request", HTTPStatus.CONFLICT)
            return work()

        return pool.submit(do).result()


class Server(ThreadingHTTPServer):
    """A viewer at a port of this machine; 0 is any that is free."""

    daemon_threads = True

    def __init__(self, viewer: Viewer, port: int) -> None:
        self.viewer = viewer
        self._answering, self._ended = 0, False
        self._changed = threading.Condition()
        super().__init__((HOST, port), _Handler)
        number = self.server_port
        self.hosts = frozenset(f"{name}:{number}" for name in (HOST, "localhost"))

    @contextmanager
    def answering(self) -> Iterator[None]:
        """While a request is answered. RefusedError at the end of the server."""
        with self._changed:
            if self._ended:
                raise RefusedError("drivesem view has ended", HTTPStatus.SERVICE_UNAVAILABLE)
            self._answering += 1
        try:
            yield
        finally:
            with self._changed:
                self._answering -= 1
                self._changed.notify_all()

    def server_close(self) -> None:
        """Ends, once what is being answered is: an interpreter that goes while a library's code runs in another
        thread is aborted by it.
        """
        super().server_close()
        with self._changed:
            self._ended = True
            self._changed.wait_for(lambda: self._answering == 0, _PATIENCE_S)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A page that goes away is no error; anything else is told in one line."""
        error = sys.exception()
        if not isinstance(error, ConnectionError | TimeoutError):
            sys.stderr.write(f"drivesem: {type(error).__name__}: {' '.join(str(error).split())}\n")

    @property
    def url(self) -> str:
        """Where the page is."""
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
        except Exception as error:  # a fault of ours: the page says so, and goes on
            sys.stderr.write(f"drivesem: {shown(self.path, _LONGEST_LINE)}: {type(error).__name__}: {error}\n")
            content, kind, status = _line(error), _TEXT, HTTPStatus.INTERNAL_SERVER_ERROR
        self._send(content, kind, status)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Other methods, and what is no HTTP: one line too."""
        self.close_connection = True
        status = HTTPStatus(code)
        self._send(f"{message or status.phrase}\n".encode(), _TEXT, status)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: a slider asks thirty times a second."""

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
            raise RefusedError(f"{shown(address.path)}: expected a known address", HTTPStatus.NOT_FOUND)
        return route(self.server.viewer, _Query.of(address.query))

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
        except ConnectionError:  # the page has gone, or asks for something later
            self.close_connection = True

    def version_string(self) -> str:
        return "drivesem"


@dataclass(frozen=True, slots=True)
class _Query:
    """What a request says. values: by knob's name."""

    frame: str
    turn: Turn
    car: int
    values: dict[str, float]

    @classmethod
    def of(cls, text: str) -> _Query:
        """RefusedError for what cannot be read."""
        try:
            pairs = parse_qsl(text, keep_blank_values=True, max_num_fields=_MOST_FIELDS, errors="strict")
        except ValueError as error:
            raise RefusedError("query: expected NAME=VALUE with &, found something else") from error
        told = dict(pairs)
        if len(told) < len(pairs):
            raise RefusedError("query: expected each name once, found one twice")
        frame, page = told.pop("frame", ""), told.pop("page", "")
        number, car = (_whole(name, told.pop(name, "0")) for name in ("n", "car"))
        if len(page) > 40:
            raise RefusedError("page: expected at most 40 characters, found more")
        return cls(frame, Turn(page, number), car, {name: _number(name, value) for name, value in told.items()})


def _whole(name: str, text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 15):
        raise RefusedError(f"{name}: expected a whole number from 0, found {shown(text)}")
    return int(text)


def _number(name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise RefusedError(f"{shown(name)}: expected a number, found {shown(text)}")
    return value


def _line(error: Exception) -> bytes:
    return (" ".join(shown(error, _LONGEST_LINE).split()) + "\n").encode()


def _json(value: object) -> tuple[bytes, str]:
    return json.dumps(value).encode(), _JSON


_ROUTES: Mapping[str, Callable[[Viewer, _Query], tuple[bytes, str]]] = {
    "/overview": lambda viewer, _: _json(viewer.overview()),
    "/frame": lambda viewer, q: _json(viewer.facts(q.frame)),
    "/photograph": lambda viewer, q: (viewer.photograph(q.frame), _JPEG),
    "/street": lambda viewer, q: (viewer.street(q.frame), _PNG),
    "/picture": lambda viewer, q: (viewer.picture(q.frame, q.values, q.turn), _JPEG),
    "/detections": lambda viewer, q: _json(viewer.detections(q.frame, q.values, q.turn)),
    "/score": lambda viewer, q: _json(viewer.score(q.frame, q.values, q.turn, q.car)),
    "/notes": lambda viewer, q: _json(viewer.notes(q.frame, q.values, q.turn)),
}
