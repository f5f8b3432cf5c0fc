"""`drivesem view`: serve the viewer on this machine."""

from __future__ import annotations

import sys
import webbrowser

from drivesem.config.commands import ViewConfig
from drivesem.config.errors import UsageError
from drivesem.reporting.tables import Console, format_count, print_json
from drivesem.viewer.server import HOST, Server, Viewer, ViewerFrames, open_viewer_frames

_PORT = 8321
"""First port to try. Links to states remain valid while the port stays the same."""
_MAX_TRIES = 20


def view_command(config: ViewConfig) -> int:
    """`drivesem view`: serve until Ctrl-C."""
    frames = open_viewer_frames(config)
    server = _create_server(frames, config.port)
    try:
        server.viewer.scene(next(iter(frames.frames)))  # fail before the page opens
        _print_address(server, config)
        server.serve_forever()
    except KeyboardInterrupt as error:
        if type(error) is not KeyboardInterrupt:  # SIGTERM
            raise
        sys.stderr.write("\n")
    finally:
        server.server_close()
        server.viewer.close()
    return 0


def _create_server(frames: ViewerFrames, port: int | None) -> Server:
    """Create the server at the given port, or at the first free one."""
    viewer = Viewer(
        frames.title,
        frames.frames,
        frames.detector,
        frames.budget,
        frames.t_star,
        failure_map=frames.failure_map,
    )
    ports = range(_PORT, _PORT + _MAX_TRIES) if port is None else [port]
    for number in ports:
        try:
            return Server(viewer, number)
        except OSError:
            continue
    found = f"{ports[0]}, which is in use" if port is not None else f"none from {_PORT} on"
    raise UsageError("--port", f"a free port of {HOST}", found)


def _print_address(server: Server, config: ViewConfig) -> None:
    frames = len(server.viewer.frames)
    if config.json:
        print_json({"url": server.url, "frames": frames, "detector": server.viewer.detector.name})
        sys.stdout.flush()
    else:
        what = f"{format_count(frames, 'frame')}, {server.viewer.detector.name}"
        Console(stderr=True).print(f"{server.url} ({what}); Ctrl-C ends it", soft_wrap=True, markup=False)
    if config.browser:
        webbrowser.open(server.url)
