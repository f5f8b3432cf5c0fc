"""`drivesem view`: a page on this machine where a scene moves, and what a detector finds in it."""

from __future__ import annotations

import sys
import webbrowser

from drivesem.config.commands import ViewConfig
from drivesem.config.errors import UsageError
from drivesem.report.tables import format_count, print_json
from drivesem.report.terminal import Console
from drivesem.viewer.frames import Shown, opened
from drivesem.viewer.server import HOST, Server, Viewer

_PORT = 8321
"""The first that is tried; links to states hold as long as it stays the same."""
_TRIED = 20


def run(config: ViewConfig) -> int:
    """Serve until Ctrl-C; exit code 0. Raises UsageError or SceneError for bad input."""
    shown = opened(config)
    if config.window:
        from drivesem.viewer.window import show

        show(*next((name, frame.folder) for name, frame in shown.frames.items()))
        return 0
    server = _server(shown, config.port)
    try:
        server.viewer.stage(next(iter(shown.frames)))  # what cannot be shown is told before a page is
        _tell(server, config)
        server.serve_forever()
    except KeyboardInterrupt as error:
        if type(error) is not KeyboardInterrupt:  # SIGTERM
            raise
        sys.stderr.write("\n")
    finally:
        server.server_close()
        server.viewer.close()
    return 0


def _server(shown: Shown, port: int | None) -> Server:
    """At the port that was asked for, or at the first that is free."""
    viewer = Viewer(shown.title, shown.frames, shown.detector, shown.budget, shown.t_star)
    ports = range(_PORT, _PORT + _TRIED) if port is None else [port]
    for number in ports:
        try:
            return Server(viewer, number)
        except OSError:
            continue
    found = f"{ports[0]}, which cannot be had" if port is not None else f"none from {_PORT} on"
    raise UsageError("--port", f"a free port of {HOST}", found)


def _tell(server: Server, config: ViewConfig) -> None:
    frames = len(server.viewer.frames)
    if config.json:
        print_json({"url": server.url, "frames": frames, "detector": server.viewer.detector.name})
        sys.stdout.flush()
    else:
        what = f"{format_count(frames, 'frame')}, {server.viewer.detector.name}"
        Console(stderr=True).print(f"{server.url} ({what}); Ctrl-C ends it", soft_wrap=True, markup=False)
    if config.browser:
        webbrowser.open(server.url)
