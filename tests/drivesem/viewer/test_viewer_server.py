"""What the server answers, and what it refuses, without a browser."""

from __future__ import annotations

import http.client
import json
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

import cv2
import numpy as np
import pytest

from drivesem.attacks.budgets import PRESETS
from drivesem.failures.feature_cells import CellVisit
from drivesem.run.feature_map import FailureMap
from drivesem.viewer.scene import InteractiveScene
from drivesem.viewer.server import HOST, POLICY, Server, Viewer, ViewerFrame
from tests.drivesem.viewer.conftest import GRID, Stubborn

STILL = {"frame": "still"}
SLIDER = "objects[0].translate.along"


class Answer:
    """status; kind: of content; body."""

    def __init__(self, status: int, headers: dict[str, str], body: bytes) -> None:
        self.status, self.headers, self.body = status, headers, body
        self.kind = headers["content-type"]

    @property
    def line(self) -> str:
        """The one line of a refusal."""
        assert self.kind == "text/plain; charset=utf-8"
        assert self.body.count(b"\n") == 1
        assert b"Traceback" not in self.body
        return self.body.decode().rstrip("\n")


def get(server: Server, path: str, method: str = "GET", **headers: str) -> Answer:
    with closing(http.client.HTTPConnection(HOST, server.server_port, timeout=60)) as connection:
        connection.request(method, path, headers={name.replace("_", "-"): text for name, text in headers.items()})
        answer = connection.getresponse()
        content = {name.lower(): text for name, text in answer.getheaders()}
        return Answer(answer.status, content, answer.read())


def query(path: str, **values: Any) -> str:
    return f"{path}?{urlencode(values)}"


def test_it_listens_to_this_machine_alone(server: Server) -> None:
    assert server.server_address[0] == "127.0.0.1"
    assert server.url == f"http://127.0.0.1:{server.server_port}/"


@pytest.mark.parametrize(
    ("path", "kind"),
    [("/", "text/html"), ("/page.js", "text/javascript"), ("/page.css", "text/css"), ("/report.css", "text/css")],
)
def test_the_page_and_what_belongs_to_it(path: str, kind: str, server: Server) -> None:
    answer = get(server, path)
    assert answer.status == 200
    assert answer.kind == f"{kind}; charset=utf-8"
    assert answer.headers["content-security-policy"] == POLICY
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["cross-origin-resource-policy"] == "same-origin"
    assert b"script>title" not in answer.body, "names come as data"
    assert "server" not in answer.headers or answer.headers["server"] == "drivesem"


def test_the_policy_lets_no_other_script_in() -> None:
    content = dict(part.strip().split(" ", 1) for part in POLICY.split(";"))
    assert content["default-src"] == "'none'"
    assert content["script-src"] == "'self'"
    assert "unsafe" not in POLICY
    assert "http" not in POLICY


def test_what_there_is_to_see(server: Server) -> None:
    content = json.loads(get(server, "/overview").body)
    assert content == {
        "title": "<script>title</script>",
        "detector": "stubborn",
        "grid": GRID,
        "frames": [{"name": "still", "words": ""}, {"name": "<b>changed</b>", "words": "1 lost"}],
    }
    frame = json.loads(get(server, query("/frame", frame="<b>changed</b>")).body)
    assert frame["name"] == "<b>changed</b>"
    assert frame["found"]
    assert {slider["name"] for slider in frame["sliders"]} >= {SLIDER, "weather.fog", "sun.azimuth"}
    assert json.loads(get(server, query("/frame", **STILL)).body)["found"] == {}


def test_a_state_as_picture_and_as_what_is_found(server: Server, viewer: Viewer) -> None:
    values = STILL | {SLIDER: 0.5, "weather.fog": "0.25"}
    answer = get(server, query("/picture", **values))
    assert (answer.status, answer.kind) == (200, "image/jpeg")
    picture = cv2.imdecode(np.frombuffer(answer.body, np.uint8), cv2.IMREAD_COLOR)
    photograph = get(server, query("/photograph", **STILL))
    before = cv2.imdecode(np.frombuffer(photograph.body, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == before.shape
    assert np.abs(picture.astype(int) - before).mean() > 1
    found = json.loads(get(server, query("/detections", **values)).body)
    assert found["command"] == viewer.scene("still").sliders.command(
        viewer.frames["still"].folder.resolve(), {SLIDER: 0.5, "weather.fog": 0.25}
    )
    assert len(found["cars"]) == len(viewer.scene("still").sliders.rest.objects)
    one = json.loads(get(server, query("/score", **values, car=0)).body)
    assert one == found["cars"][0]
    assert json.loads(get(server, query("/notes", **values)).body) == []
    assert get(server, query("/street", **STILL)).kind == "image/png"


def test_the_map_of_the_run_links_to_what_is_lost(still: Path, stubborn: Stubborn, server: Server) -> None:
    assert get(server, "/searched").body == b""
    visit = CellVisit(3, (0, 0, 0, 0), 2, 1, final=True)
    searched = FailureMap.from_frames([("<b>a&b</b>", [visit], {3})])
    with closing(
        Viewer("t", {"still": ViewerFrame(still)}, stubborn, PRESETS["street"], failure_map=searched)
    ) as made:
        table = made.searched()
    assert "1 certain of 1 object" in table
    assert 'href="#frame=%3Cb%3Ea%26b%3C%2Fb%3E&amp;car=3"' in table
    assert "<b>a" not in table


@pytest.mark.parametrize(
    ("path", "status", "message"),
    [
        ("/nowhere", 404, "/nowhere: expected a known address"),
        ("/../page.js", 404, "expected a known address"),
        ("/page.js/../../stage.py", 404, "expected a known address"),
        (f"/{quote('<b>é')}", 404, "expected a known address"),
        ("/picture", 400, "frame: expected one of 2 frames, found none"),
        ("/picture?frame=../../etc", 400, "found ../../etc"),
        ("/picture?frame=still&frame=still", 400, "each name once"),
        ("/picture?frame=still&weather.fog", 400, "weather.fog: expected a number"),
        ("/picture?frame=still&weather.fog=dense", 400, "weather.fog: expected a number, found dense"),
        ("/picture?frame=still&weather.fog=nan", 400, "weather.fog: expected a number, found nan"),
        ("/picture?frame=still&weather.fog=inf", 400, "expected a number"),
        ("/picture?frame=still&weather.fog=1.5", 400, "weather.fog: expected 0 to 1, found 1.5"),
        ("/picture?frame=still&weather.hail=1", 400, "weather.hail: expected a parameter of this scene"),
        ("/picture?frame=still&objects[0].yaw=170", 400, "expected -20 to 20 deg, found 170"),
        ("/picture?frame=still&n=-1", 400, "n: expected a whole number from 0, found -1"),
        ("/picture?frame=still&n=9999999999999999", 400, "n: expected a whole number"),
        (f"/picture?frame=still&page={'a' * 41}", 400, "page: expected at most 40 characters"),
        ("/score?frame=still&car=99", 400, "car: expected a row of the scene, found 99"),
        ("/score?frame=still&car=one", 400, "car: expected a whole number"),
        ("/picture?frame=%ff", 400, "query: expected NAME=VALUE"),
        (f"/picture?{'&'.join(f'a{i}=1' for i in range(3000))}", 400, "query: expected NAME=VALUE"),
        (f"/picture?frame={'x' * 5000}", 400, "5,000 characters"),
        ("/picture?frame=%1b[31m", 400, "\\x1b[31m"),
    ],
)
def test_what_is_not_known_gets_one_line(path: str, status: int, message: str, server: Server) -> None:
    answer = get(server, path)
    assert answer.status == status
    assert message in answer.line


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "HEAD"])
def test_there_is_nothing_but_reading(method: str, server: Server) -> None:
    answer = get(server, "/overview", method)
    assert answer.status == 501
    assert answer.headers["content-security-policy"] == POLICY
    assert not any(name.startswith("access-control") for name in answer.headers)


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", "evil.example:{port}", "127.0.0.1:1", ""])
def test_other_names_for_this_machine_are_refused(host: str, server: Server) -> None:
    for path in ("/", query("/picture", **STILL)):
        answer = get(server, path, Host=host.format(port=server.server_port))
        assert answer.status == 403
        assert answer.line.startswith("Host: expected http://127.0.0.1:")


def test_localhost_is_this_machine(server: Server) -> None:
    assert get(server, "/overview", Host=f"localhost:{server.server_port}").status == 200


def test_other_sites_may_link_but_not_request(server: Server) -> None:
    assert get(server, "/", Sec_Fetch_Site="cross-site").status == 200
    assert get(server, "/overview", Sec_Fetch_Site="same-origin").status == 200
    for site in ("cross-site", "same-site"):
        answer = get(server, query("/picture", **STILL), Sec_Fetch_Site=site)
        assert answer.status == 403
        assert "another site's" in answer.line


def test_what_is_not_http_gets_one_line(server: Server) -> None:
    import socket

    with socket.create_connection((HOST, server.server_port), timeout=10) as connection:
        connection.sendall(b"\x16\x03\x01 what HTTP/9.9\r\n\r\n")
        answer = connection.recv(4096)
    assert b"Traceback" not in answer
    assert b"<" not in answer


def test_a_fault_of_ours_is_one_line_too(
    server: Server, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def broken(self: InteractiveScene, drawn: object) -> bytes:
        raise AssertionError("two\nlines")

    monkeypatch.setattr(InteractiveScene, "encode_picture", broken)
    answer = get(server, query("/picture", **STILL))
    assert answer.status == 500
    assert answer.line == "two lines"
    assert "AssertionError" in capfd.readouterr().err
    monkeypatch.undo()
    assert get(server, query("/picture", **STILL)).status == 200


def test_a_later_request_of_a_page_supersedes_those_that_wait(
    still: Path, stubborn: Stubborn, served: Callable[[Viewer], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    viewer = Viewer("t", {"still": ViewerFrame(still)}, stubborn, PRESETS["street"])
    viewer.scene("still")
    drawn: list[float] = []
    begun, go_on = threading.Event(), threading.Event()
    really = InteractiveScene.render_state

    def slow(self: InteractiveScene, state: Any, keep: bool = True) -> Any:
        drawn.append(state.get("weather.fog", 0.0))
        begun.set()
        assert go_on.wait(30)
        return really(self, state, keep)

    monkeypatch.setattr(InteractiveScene, "render_state", slow)
    statuses: dict[int, int] = {}
    with served(viewer) as server:

        def send(number: int) -> None:
            values = STILL | {"page": "p", "n": number, "weather.fog": number / 100}
            statuses[number] = get(server, query("/picture", **values)).status

        threads = [threading.Thread(target=send, args=(number,)) for number in range(1, 21)]
        threads[0].start()
        assert begun.wait(30)
        for thread in threads[1:]:
            thread.start()
        for _ in range(3000):
            if viewer._latest.get("p") == {"picture": 20} and viewer._render_pool._work_queue.qsize() == 19:
                break
            threading.Event().wait(0.01)
        go_on.set()
        for thread in threads:
            thread.join(30)
        assert get(server, query("/picture", **STILL, page="q", n=1)).status == 200, (
            "another page is not concerned"
        )
        assert get(server, query("/picture", **STILL, page="p", n=3)).status == 409
        assert get(server, query("/detections", **STILL, page="p", n=19)).status == 200, "another kind"
        assert get(server, query("/score", **STILL, page="p", n=19, **{"weather.fog": 0.7})).status == 409
        assert get(server, query("/score", **STILL, page="p", n=20, **{"weather.fog": 0.7})).status == 200
        assert get(server, query("/notes", **STILL, page="p", n=19)).status == 409
        assert get(server, query("/picture", **STILL)).status == 200, "no page at all"
    viewer.close()
    assert statuses == {1: 200, 20: 200, **dict.fromkeys(range(2, 20), 409)}
    assert drawn[:2] == [0.01, 0.2], "none of those between is drawn"


def test_the_end_waits_for_what_is_being_answered(
    still: Path, stubborn: Stubborn, served: Callable[[Viewer], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    viewer = Viewer("t", {"still": ViewerFrame(still)}, stubborn, PRESETS["street"])
    begun, go_on = threading.Event(), threading.Event()

    def slow(self: Viewer) -> dict[str, Any]:
        begun.set()
        assert go_on.wait(30)
        return {}

    monkeypatch.setattr(Viewer, "overview", slow)
    answers: list[Answer] = []
    with served(viewer) as server, closing(http.client.HTTPConnection(HOST, server.server_port)) as open_still:
        open_still.request("GET", "/page.css")
        open_still.getresponse().read()
        requesting = threading.Thread(target=lambda: answers.append(get(server, "/overview")))
        requesting.start()
        assert begun.wait(30)
        server.shutdown()
        ending = threading.Thread(target=server.server_close)
        ending.start()
        ending.join(0.2)
        assert ending.is_alive()
        open_still.request("GET", "/page.css")
        late = open_still.getresponse()
        assert (late.status, late.read()) == (503, b"drivesem view has ended\n")
        go_on.set()
        for thread in (ending, requesting):
            thread.join(30)
    viewer.close()
    assert [answer.status for answer in answers] == [200]


def test_few_frames_and_pages_are_cached(
    still: Path, changed: Path, stubborn: Stubborn, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Path] = []

    class Made:
        def __init__(self, folder: Path, *rest: Any) -> None:
            made.append(folder)

    monkeypatch.setattr("drivesem.viewer.server.InteractiveScene", Made)
    frames = {name: ViewerFrame(Path(name)) for name in "abc"}
    viewer = Viewer("t", frames, stubborn, PRESETS["street"])
    for name in "abacab":
        viewer.scene(name)
    viewer.close()
    assert made == [Path(name) for name in "abcb"]
