"""Log of a run for the viewer Rerun (rerun.io, the extra ``viz``): images, patches, graph and poses after each frame.

Entities: ``world`` holds the poses so far, the window's keyframes, edges and points, and the camera with its image and
patches; ``final`` the result; ``confidence`` and ``status`` are shown over time. Everything is logged between two
frames; the tracker is not changed.
"""

from __future__ import annotations

import os
import socket
import sys
import threading
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit, urlunsplit

import cv2
import numpy as np

from dvo.core.errors import DvoError
from dvo.core.settings import shown
from dvo.data.files.output import begin_part, check_place, drop_part, end_part
from dvo.data.frame import Frame
from dvo.odometry.protocol import Estimate, Odometry, Result, Status
from dvo.session.observer import WindowView, archived_lines, graph_of, window_view
from dvo.session.session import Run
from dvo.viz.marks import pixels, shade
from dvo.viz.plot import COLOURS

APPLICATION = "dvo"
PORT = 9876  # of a viewer
VIEWER_LIMIT, FILE_LIMIT = 2.0, 60.0  # seconds to wait for a viewer, and for a file
CHUNK = 100  # poses of a piece of the trajectory; the last piece is logged again with each frame
ARCHIVED_EVERY, POINTS_EVERY = 25, 5  # frames between two versions of the archived edges, and of the window's points
_IMAGE_QUALITY = 80


def has_display() -> bool:
    """True if a window can be opened, or a viewer that runs on this machine takes the run."""
    if sys.platform in ("win32", "darwin") or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")):
        return True
    return _answers("127.0.0.1", PORT)


def reached(address: str) -> str:
    """Address of a viewer in the form that rerun wants, if something answers there.

    Args:
        address: ``HOST:PORT``, ``HOST`` (port 9876), or ``rerun+http://HOST:PORT/proxy``.

    Raises:
        DvoError: no address, or nothing answers.
    """
    url = address if "://" in address else f"rerun+http://{address}/proxy"
    remedy = "start `rerun` on that machine, and give its HOST:PORT, such as 192.168.1.5:9876"
    try:
        parts = urlsplit(url)
        scheme, host, port = parts.scheme, parts.hostname, parts.port or PORT
    except ValueError:
        scheme = host = ""
    if not host or scheme not in ("rerun", "rerun+http", "rerun+https"):
        raise DvoError(f"no address: {shown(address)}", field="--rerun-connect", remedy=remedy)
    if not _answers(host, port):
        raise DvoError(f"no viewer answers at {shown(address)}", field="--rerun-connect", remedy=remedy)
    return urlunsplit(
        (scheme, parts.netloc if parts.port else f"{parts.netloc}:{PORT}", parts.path or "/proxy", "", "")
    )


def _answers(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), timeout=VIEWER_LIMIT).close()
    except (OSError, UnicodeError):
        return False
    return True


def import_rerun(option: str = "--rerun") -> Any:
    """Import the package ``rerun``.

    Args:
        option: that asks for it, for messages.

    Returns:
        The module.

    Raises:
        DvoError: it is not installed.
    """
    try:
        import rerun
    except ImportError:
        raise DvoError(
            "the package rerun-sdk is not installed", field=option, remedy="run pip install 'dvo[viz]'"
        ) from None
    return rerun


class RerunLog:
    """Observer that logs a run to a file or to the viewer (:class:`dvo.session.observer.Observer`).

    An odometry without a keyframe graph gives poses and images only.

    Args:
        file: ``.rrd`` file to write; None starts the viewer, or connects to one.
        name: of the run, in the viewer.
        address: of a viewer that runs, maybe on another machine: ``HOST:PORT``, ``HOST``, or ``rerun+http://...``; None
            for a new one on this machine.

    Attributes:
        file: as given.

    Raises:
        DvoError: rerun is not installed, the file cannot be written, the viewer cannot be started (without a display),
            or none answers at the address.
    """

    def __init__(self, file: Path | None, name: str, address: str | None = None) -> None:
        self._rr = rr = import_rerun("--rerun" if address is None else "--rerun-connect")
        url = None if address is None else reached(address)
        if file is None and url is None and not has_display():
            remedy = "write a file with --rerun FILE.rrd, or show it on another machine with --rerun-connect ADDRESS"
            raise DvoError("there is no display for the viewer", field="--rerun", remedy=remedy)
        self._stream = rr.RecordingStream(APPLICATION)
        self.file, self._limit = file, FILE_LIMIT if file is not None else VIEWER_LIMIT
        self._part: Path | None = None
        self._closed = False
        self._odometry: Odometry | None = None
        self._path: list[np.ndarray] = []
        self._piece = self._segment = self._count = 0
        self._start: float | None = None
        self._status = ""
        try:
            if url is not None:
                self._stream.connect_grpc(url, default_blueprint=self._layout())
            elif file is None:
                self._stream.spawn(default_blueprint=self._layout())
            else:
                check_place(file, "--rerun")  # rerun only prints an error if it cannot write the file
        except RuntimeError as error:  # no viewer, or no display
            message = f"the viewer cannot be started ({str(error).strip().splitlines()[0]})"
            raise DvoError(message, field="--rerun", remedy="write a file with --rerun FILE.rrd") from error
        self._stream.send_recording_name(name)
        for root in ("world", "final"):
            self._stream.log(root, rr.ViewCoordinates.RDF, static=True)

    def begin(self, odometry: Odometry) -> None:
        """Take the odometry whose window is read, and begin the file.

        Args:
            odometry: newly built.
        """
        self._odometry = odometry
        if self.file is not None:
            self._part = begin_part(self.file)
            self._stream.save(self._part, default_blueprint=self._layout())

    def update(self, frame: Frame, estimate: Estimate | None) -> None:
        """Log a frame.

        Args:
            frame: the frame.
            estimate: of the frame; None if it was skipped, which logs nothing.
        """
        if estimate is None:
            return
        self._time(frame)
        self._log_image(frame)
        self._log_estimate(estimate)
        graph = None if self._odometry is None else graph_of(self._odometry)
        if graph is not None:
            view = window_view(graph)
            if view is not None:
                self._log_window(frame, view)
            if self._count % ARCHIVED_EVERY == 0:
                self._lines("world/edges/archived", archived_lines(graph, graph.segment), [120, 130, 145])
        self._count += 1

    def finish(self, run: Run) -> None:
        """Log the result, at the time of the last frame, and close the log.

        Args:
            run: record of the session.
        """
        result, rr = run.result, self._rr
        for number, segment in enumerate(result.segments):
            if _shares_world(result, number):
                colour = _colour(number)
                strip = rr.LineStrips3D([segment.trajectory.positions], colors=[colour], labels=[f"segment {number}"])
                self._stream.log(f"final/trajectory/{number}", strip)
        if len(result.map.points):
            self._stream.log("final/map", rr.Points3D(result.map.points, colors=result.map.colors))
        loops = loop_lines(result)
        if len(loops):
            self._lines("final/loops", loops, [30, 160, 90])
        graph = None if self._odometry is None else graph_of(self._odometry)
        if graph is not None and result.longest is not None:
            self._lines("final/edges", archived_lines(graph, result.longest), [120, 130, 145])
        self.close()

    def close(self) -> None:
        """Write what is buffered, and close the file, which takes the place of an earlier one. A viewer that takes
        nothing more is left after two seconds."""
        if self._closed:
            return
        self._closed = True
        part, self._part = self._part, None
        try:
            self._flush()
        finally:
            self._disconnect()
            if self.file is not None and part is not None:
                try:
                    end_part(part, self.file)
                except OSError:
                    drop_part(part)
                    raise

    def _flush(self) -> None:
        try:
            self._stream.flush(timeout_sec=self._limit)
        except TypeError:  # before rerun 0.26 there is no limit
            self._stream.flush(blocking=self.file is not None)

    def _disconnect(self) -> None:
        """Close the connection in a thread: for a viewer that is gone, rerun waits without a limit."""
        closing = threading.Thread(target=self._stream.disconnect, name="dvo closes rerun", daemon=True)
        closing.start()
        closing.join(self._limit)
        if closing.is_alive():
            self._rr.unregister_shutdown()  # which would wait at the end of the program

    # -- parts of a frame ----------------------------------------------------------------------------------------------

    def _time(self, frame: Frame) -> None:
        self._start = frame.timestamp if self._start is None else self._start
        self._stream.set_time("frame", sequence=frame.index)
        self._stream.set_time("seconds", duration=frame.timestamp - self._start)

    def _log_image(self, frame: Frame) -> None:
        rr, camera = self._rr, frame.camera
        focal, middle = [camera.fx, camera.fy], [camera.cx, camera.cy]
        size = [camera.width, camera.height]
        self._stream.log("world/camera/image", rr.Pinhole(focal_length=focal, principal_point=middle, resolution=size))
        bgr = np.ascontiguousarray(frame.image[..., ::-1])
        done, jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _IMAGE_QUALITY])
        if done:
            image = rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg")
            self._stream.log("world/camera/image", image)

    def _log_estimate(self, estimate: Estimate) -> None:
        rr, stream = self._rr, self._stream
        stream.log("confidence", rr.Scalars(estimate.confidence))
        status = f"{estimate.status}: {estimate.reason}" if estimate.reason else str(estimate.status)
        text = f"{status}, segment {estimate.segment}"
        if text != self._status:
            level = "WARN" if estimate.status is Status.LOST else "INFO"
            stream.log("status", rr.TextLog(text, level=level))
            self._status = text
        if estimate.segment != self._segment:
            self._segment, self._path, self._piece = estimate.segment, [], 0
        if estimate.pose_wc is None:
            return
        position, quaternion = estimate.pose_wc[:3], estimate.pose_wc[3:]
        stream.log("world/camera", rr.Transform3D(translation=position, quaternion=quaternion))
        self._path.append(np.array(position))
        path = f"world/trajectory/{self._segment}/{self._piece}"
        stream.log(path, rr.LineStrips3D([np.array(self._path)], colors=[_colour(self._segment)]))
        if len(self._path) > CHUNK:
            self._path, self._piece = self._path[-1:], self._piece + 1

    def _log_window(self, frame: Frame, view: WindowView) -> None:
        rr, stream = self._rr, self._stream
        centres = view.poses_wc[:, :3]
        stream.log("world/keyframes", rr.Points3D(centres, colors=[230, 140, 40], radii=rr.Radius.ui_points(4)))
        if len(view.pairs):
            strips = centres[view.pairs]
            stream.log("world/edges/active", rr.LineStrips3D(strips, colors=shade(view.pair_confidence)))
        if self._count % POINTS_EVERY == 0:
            stream.log("world/points", rr.Points3D(view.points, colors=view.colors))
        if view.timestamp == frame.timestamp:
            own, matches = pixels(view.patches, frame.camera), pixels(view.matches, frame.camera)
            radius = rr.Radius.ui_points(2.5)
            stream.log("world/camera/image/patches", rr.Points2D(own, colors=[255, 255, 255], radii=radius))
            shown = rr.Points2D(matches, colors=shade(view.confidence), radii=radius)
            stream.log("world/camera/image/matches", shown)
        else:  # the frame has left the window
            stream.log("world/camera/image/patches", rr.Clear(recursive=False))
            stream.log("world/camera/image/matches", rr.Clear(recursive=False))

    def _lines(self, path: str, lines: np.ndarray, colour: list[int]) -> None:
        self._stream.log(path, self._rr.LineStrips3D(lines, colors=[colour]))

    def _layout(self) -> Any:
        import rerun.blueprint as rrb

        views = rrb.Tabs(
            rrb.Spatial3DView(origin="world", name="tracking"), rrb.Spatial3DView(origin="final", name="result")
        )
        beside = rrb.Vertical(
            rrb.Spatial2DView(origin="world/camera/image", name="image"),
            rrb.TimeSeriesView(origin="confidence", name="confidence"),
            rrb.TextLogView(origin="status", name="status"),
            row_shares=[3, 1, 1],
        )
        return rrb.Blueprint(rrb.Horizontal(views, beside, column_shares=[3, 2]), collapse_panels=True)


def _colour(segment: int) -> list[int]:
    text = COLOURS[segment % len(COLOURS)].lstrip("#")
    return [int(text[k : k + 2], 16) for k in (0, 2, 4)]


def _shares_world(result: Result, number: int) -> bool:
    """Return True for the longest segment and those that share its world, whose rows are in the trajectory."""
    times = result.segments[number].trajectory.timestamps
    return bool(len(times)) and bool(np.isin(times, result.trajectory.timestamps).all())


def loop_lines(result: Result) -> np.ndarray:
    """Lines between both visits of each loop in the world of the result.

    Args:
        result: whose ``info`` lists the loops, if there are any.

    Returns:
        ``(L, 2, 3)`` positions, the later visit first.
    """
    times, positions = result.trajectory.timestamps, result.trajectory.positions
    lines = []
    for loop in result.info.get("loops", ()):
        if loop.get("in_map"):  # the time of the map is on another clock
            continue
        rows = [np.flatnonzero(np.isclose(times, loop[end], rtol=0, atol=1e-6)) for end in ("from", "to")]
        if all(len(row) for row in rows):
            lines.append(positions[[row[0] for row in rows]])
    return np.array(lines).reshape(-1, 2, 3)
