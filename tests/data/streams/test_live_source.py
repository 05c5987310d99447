"""Cameras (a fake one), addresses (a server on this machine) and pipes as sources."""

import gc
import gzip
import http.server
import io
import math
import os
import threading
import time
import urllib.request
from functools import partial

import cv2
import numpy as np
import pytest

import dvo
from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import FOUND_BY_DVO
from dvo.data.streams.capture import Capture, StreamClock, is_stream, shown
from dvo.data.streams.live_source import LiveSource, open_stream
from tests.support.interlaced import moving, woven

CALIB = "50 51 31 23\n"


class FakeCamera:
    """Stand-in for ``cv2.VideoCapture``: sends ``images``, one whenever ``send`` allows it."""

    images: list = []
    send = None
    stated: list = []
    opened = True
    last = None

    def __init__(self, *arguments):
        self.arguments, self.index, self.released = arguments, -1, False
        FakeCamera.last = self

    def isOpened(self):
        return self.opened

    def set(self, key, value):
        return False

    def get(self, key):
        if key == cv2.CAP_PROP_POS_MSEC:
            return self.stated[self.index] if self.stated else 0.0
        return -1.0 if key == cv2.CAP_PROP_FRAME_COUNT else 0.0

    def grab(self):
        if self.send is not None:
            assert self.send.acquire(timeout=20)
        self.index += 1
        return self.index < len(self.images)

    def retrieve(self):
        image = self.images[self.index]
        return image is not None, image

    def release(self):
        self.released = True


@pytest.fixture
def camera(monkeypatch, make):
    """A camera that sends twelve images as fast as they are read."""
    fake = type("Camera", (FakeCamera,), {"images": [make.image(i) for i in range(12)]})
    monkeypatch.setattr(cv2, "VideoCapture", fake)
    return fake


def jpegs(make, count=6):
    return [cv2.imencode(".jpg", make.image(i))[1].tobytes() for i in range(count)]


@pytest.fixture
def server(make):
    """Address of a server of one file, ``clip.avi``, and of ``camera``, six images as a webcam sends them."""
    parts = jpegs(make)
    make.video("clip.avi", "MJPG", frames=12, fps=20.0)

    class Handler(http.server.SimpleHTTPRequestHandler):
        def do_GET(self):
            if self.path != "/camera":
                return super().do_GET()
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=part")
            self.end_headers()
            for part in [*parts, parts[-1]]:  # FFmpeg gives an image when the next one begins
                self.wfile.write(b"--part\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(part))
                self.wfile.write(part + b"\r\n")
            return None

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(make.root))) as found:
        thread = threading.Thread(target=found.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield f"http://user:secret@127.0.0.1:{found.server_port}"
        found.shutdown()
        thread.join()


def test_streams_are_told_from_files():
    assert all(map(is_stream, ["webcam:0", "webcam:12", "rtsp://host/a", "HTTPS://host/a.m3u8", "-"]))
    assert not any(map(is_stream, ["webcam:", "webcam:x", "video.mp4", "./-", "C:/a.mp4", "ftp://a", None, 0]))
    assert shown("rtsp://user:p@ss/word@host:554/a?token=abc") == "rtsp://host:554/a?token=***"
    assert shown("a@b.mp4") == "a@b.mp4"


def test_a_camera(camera, make):
    camera.send = threading.Semaphore(1)
    before = time.monotonic()
    source = dvo.open("webcam:3", calib=make.calib(), queue=2)
    assert isinstance(source, LiveSource) and camera.last.arguments == (3,)
    assert (source.name, source.kind, source.frame_count, source.times) == ("webcam-3", "stream", None, "arrival")
    camera.send.release()
    found = []
    for frame in source:
        found.append(frame)
        camera.send.release()
    assert [frame.index for frame in found] == list(range(12))
    assert all(np.array_equal(f.image, make.image(i)[..., ::-1]) for i, f in enumerate(found))
    times = [before, *(frame.timestamp for frame in found), time.monotonic()]
    assert (np.diff(times) > 0).all(), "times are those of arrival"
    assert (source.counts.received, source.counts.dropped, source.warnings) == (12, 0, [])
    assert camera.last.released


def test_a_slow_consumer_gets_the_newest_frames(camera, make):
    source = open_stream("webcam:0", calib=make.calib())
    while not camera.last.released:  # all have arrived
        time.sleep(0.001)
    assert [frame.index for frame in source] == [11]
    source = open_stream("webcam:0", calib=make.calib(), queue=3)
    while not camera.last.released:
        time.sleep(0.001)
    assert [frame.index for frame in source] == [9, 10, 11]
    assert [frame.index for frame in open_stream("webcam:0", calib=make.calib(), queue=0)] == list(range(12))
    assert [frame.index for frame in open_stream("webcam:0", calib=make.calib(), queue=0, stride=5)] == [0, 5, 10]


def test_a_focal_length_of_a_clip_is_found_and_not_given(camera, make):
    with open_stream("webcam:0", calib=make.calib()) as given:
        assert given.calibrated
    with open_stream("webcam:0", calib=make.text("found.txt", f"{FOUND_BY_DVO}50 51 31 23\n")) as found:
        assert not found.calibrated and found.guess is None


def test_images_that_do_not_decode_are_left_out(camera, make):
    camera.images[4] = None
    assert [f.index for f in open_stream("webcam:0", calib=make.calib(), queue=0)] == [0, 1, 2, 3, *range(5, 12)]


@pytest.mark.parametrize("interlaced", [True, False])
def test_a_converter_of_analogue_video(camera, make, interlaced):
    """The note comes while frames are read, of all received ones: the consumer sees the newest alone."""
    camera.images = list(woven(moving(32, 2), True)) if interlaced else list(moving(16, 2))
    calib = make.text("calib.txt", "300 300 159.5 119.5")
    with open_stream("webcam:0", calib=calib) as source:
        while not camera.last.released:
            time.sleep(0.001)
        assert len(list(source)) == 1
        assert any("interlaced" in said and "bwdif" in said for said in source.warnings) == interlaced


def test_without_a_calibration_the_angle_of_view_is_assumed(camera):
    source = dvo.open("webcam:0", guess=True)
    assert source.camera.fx == pytest.approx(32 / math.tan(math.radians(32))) and source.guess.source == "prior"
    assert "no calibration" in source.warnings[0] and "51 px" in source.warnings[0]
    source.close()
    assert camera.last.released


def test_a_distorted_calibration_is_applied(camera, make):
    lens = make.text("lens.txt", "50 51 31 23 -0.1 0.01 0 0")
    with dvo.open("webcam:0", calib=lens, queue=0) as source:
        frame = next(iter(source))
    assert frame.camera.model == "none" and not np.array_equal(frame.image, make.image(0)[..., ::-1])


def test_what_cannot_be_opened(camera, make, tmp_path):
    camera.opened = False
    with pytest.raises(DvoError, match="webcam:7: no camera of number 7 can be opened. Check that it is connected"):
        dvo.open("webcam:7")
    with pytest.raises(DvoError, match=r"^rtsp://host/a: no video stream can be opened there. Check the address"):
        dvo.open("rtsp://user:secret@host/a")
    camera.opened = True
    camera.images = []
    with pytest.raises(DvoError, match="webcam:0: ends without an image"):
        dvo.open("webcam:0")
    for options in ({"times": "t.txt"}, {"groundtruth": "g.txt"}, {"reader": "video"}):
        with pytest.raises(DvoError, match="not for a stream"):
            dvo.open("webcam:0", **options)
    with pytest.raises(DvoError, match="queue"):
        dvo.open(make.images("clip", ["0.png"]), calib=make.calib(), queue=2)
    for wrong, match in ((3, "cannot be int"), ("clip.mp4", "neither a camera"), ("-", "queue")):
        with pytest.raises(DvoError, match=match):
            open_stream(wrong, queue=-1 if wrong == "-" else None)


def test_rtsp_states_its_times(camera, make):
    """They are put on the clock of this machine at the first image, and again when they jump."""
    camera.stated = [5000, 5040, 5080, 5120, 5160, 5200, 100, 140, 180, 220, 260, 300]
    frames = list(open_stream("rtsp://host/a", calib=make.calib(), queue=0))
    steps = np.diff([frame.timestamp for frame in frames])
    assert abs(frames[0].timestamp - time.monotonic()) < 60
    assert np.allclose(np.delete(steps, 5), 0.04) and steps[5] > 0


def test_clock_of_a_stream():
    clock = StreamClock()
    assert [clock(10.0, 0.0), clock(10.0), clock(11.0, 3.0)] == pytest.approx([10.0, 10.000001, 11.0])
    assert clock(11.6, 3.5) == pytest.approx(11.5), "the stated difference, not that of arrival"
    assert clock(30.0, 4.0) == pytest.approx(30.0), "the stream has fallen far behind"
    assert clock(30.1, 3.0) == pytest.approx(30.1), "the camera has restarted"


def test_an_address_of_a_recording_is_read_whole(server, make):
    source = dvo.open(f"{server}/clip.avi", calib=make.text("c.txt", "150 150 79 59"))
    assert source.times == "file" and "secret" not in source.name
    time.sleep(0.05)
    frames = list(source)
    assert [frame.index for frame in frames] == list(range(12)) and source.counts.dropped == 0
    expected = [frame.timestamp for frame in dvo.open(make.root / "clip.avi", calib=make.root / "c.txt")]
    assert [frame.timestamp for frame in frames] == pytest.approx(expected)


def test_a_webcam_behind_an_address(server, make):
    source = dvo.open(f"{server}/camera", calib=make.calib(), queue=0)
    frames = list(source)
    assert source.times == "arrival" and len(frames) >= 6
    assert np.abs(frames[3].image.astype(int) - make.image(3)[..., ::-1]).mean() < 12
    with pytest.raises(DvoError, match=r"^http://127.0.0.1:\d+/missing.avi: no video stream"):
        Capture(f"{server}/missing.avi")


def test_a_pipe_with_a_rate_is_a_recording(make):
    source = dvo.open_stream(io.BytesIO(b"".join(jpegs(make))), calib=make.calib(), fps=20)
    frames = list(source)
    assert [frame.timestamp for frame in frames] == pytest.approx(0.05 * np.arange(6))
    assert source.times == "fps" and source.counts.received == 6
    assert np.abs(frames[2].image.astype(int) - make.image(2)[..., ::-1]).mean() < 12


def test_a_pipe_without_a_rate_is_live(make):
    """Everything has arrived before the iteration: the newest is there. The file stays open until then."""
    out, into = os.pipe()
    with os.fdopen(out, "rb") as file:
        with os.fdopen(into, "wb") as writer:
            writer.write(b"".join(jpegs(make)))
        source = dvo.open_stream(file, calib=make.calib())
        while source.counts.received < 6:
            time.sleep(0.001)
        assert [frame.index for frame in source] == [5] and source.times == "arrival"


@pytest.mark.parametrize(("interlaced", "dropped"), [(True, ()), (False, ()), (False, (2, 5, 6, 9, 10, 11))])
def test_an_interlaced_pipe_is_told(make, interlaced, dropped):
    """Images that were dropped do not make progressive ones look interlaced."""
    images = list(woven(moving(32, 2), True)) if interlaced else list(moving(24, 2))
    codes = [cv2.imencode(".png", image)[1].tobytes() for image in images]
    codes = [b"\xff\xd8\xff\xd9" if index in dropped else code for index, code in enumerate(codes)]
    calib = make.text("calib.txt", "300 300 159.5 119.5")
    source = open_stream(io.BytesIO(b"".join(codes)), calib=calib, fps=20)
    assert len(list(source)) == len(images) - len(dropped)
    assert sum("interlaced" in said and "bwdif" in said for said in source.warnings) == interlaced


def test_a_compressed_file(make):
    data = gzip.compress(b"".join(jpegs(make)))
    source = open_stream(gzip.GzipFile(fileobj=io.BytesIO(data)), calib=make.calib(), fps=20)
    assert [frame.index for frame in source] == list(range(6))
    with gzip.open(make.root / "clip.gz", "wb") as file:
        file.write(b"".join(jpegs(make)))
    with gzip.open(make.root / "clip.gz", "rb") as file:  # it has a descriptor, that of the compressed file
        assert len(list(open_stream(file, calib=make.calib(), fps=20))) == 6


def test_the_response_of_a_server(server, make):
    """Its header has been read into a buffer, together with the first images."""
    address = server.replace("user:secret@", "")
    with urllib.request.urlopen(f"{address}/camera", timeout=20) as response:
        found = list(open_stream(response, calib=make.calib(), queue=0))
    assert [frame.index for frame in found] == list(range(7))


def test_a_process_in_text_mode(make):
    out, into = os.pipe()
    with os.fdopen(into, "wb") as writer:
        writer.write(b"".join(jpegs(make)))
    with os.fdopen(out, "r") as file:
        source = open_stream(file, calib=make.calib(), fps=20)
        assert source.recording.live.name == "pipe" and len(list(source)) == 6


DAMAGED = b"\xff\xd8\xff\xd9"


def test_damaged_images_at_the_beginning_are_skipped(make):
    for count, said in ((1, "the first image was skipped"), (5, "the first 5 images were skipped")):
        data = DAMAGED * count + b"".join(jpegs(make))
        source = open_stream(io.BytesIO(data), calib=make.calib(), fps=20)
        assert len(source.warnings) == 1 and said in source.warnings[0]
        frames = list(source)
        assert [frame.index for frame in frames] == list(range(count, count + 6)), "numbers are those of the stream"
        assert frames[0].timestamp == pytest.approx(count / 20) and source.counts.received == 6
    with pytest.raises(DvoError, match="the first 30 images do not decode"):
        open_stream(io.BytesIO(DAMAGED * 50 + jpegs(make)[0]), calib=make.calib(), fps=20)
    with pytest.raises(DvoError, match="the first 2 images do not decode, and then: ends without an image"):
        open_stream(io.BytesIO(DAMAGED * 2), calib=make.calib(), queue=2)


def test_a_damaged_image_is_named_by_its_number(make):
    """Where others were dropped, its place among those that were processed is not its number."""
    images = jpegs(make)
    out, into = os.pipe()
    with os.fdopen(out, "rb") as file:
        with os.fdopen(into, "wb", buffering=0) as writer:
            writer.write(images[0])
            source = open_stream(file, calib=make.calib(), queue=2)
            writer.write(b"".join([*images[1:4], DAMAGED, images[5]]))
        while source.counts.received < 6:
            time.sleep(0.001)
        assert [frame.index for frame in source] == [5], "the newest two are kept"
    assert source.warnings[0] == "1 image could not be read and was skipped: image 4"


def test_pipes_that_hold_nothing(make):
    with pytest.raises(DvoError, match="no JPEG or PNG image in what arrives"):
        open_stream(io.BytesIO(b"no image"))
    with pytest.raises(DvoError, match="ends without an image"):
        open_stream(io.BytesIO(b""))
    with pytest.raises(DvoError, match="first image does not decode"):
        open_stream(io.BytesIO(b"\xff\xd8\xff\xd9"))
    leader, terminal = os.openpty()
    with os.fdopen(terminal, "rb", buffering=0) as file, pytest.raises(DvoError, match="is a terminal.*image2pipe"):
        open_stream(file)
    os.close(leader)


def test_a_pipe_that_is_closed_is_told(monkeypatch):
    closed = io.BytesIO()
    closed.close()
    with pytest.raises(DvoError, match="is closed"):
        open_stream(closed)
    monkeypatch.setattr("sys.stdin", None)
    with pytest.raises(DvoError, match="standard input: is closed"):
        open_stream("-")


def _ended():
    return not [thread for thread in threading.enumerate() if thread.name.startswith("dvo stream")]


@pytest.mark.parametrize("address", ["webcam:0", "rtsp://host/stream"])
@pytest.mark.parametrize("begun", [False, True])
def test_a_camera_is_released_with_the_last_reference_to_its_source(camera, address, begun):
    camera.images = camera.images * 1000
    source = open_stream(address)
    frames = iter(source) if begun else None
    assert frames is None or next(frames).index >= 0
    assert not camera.last.released
    del source, frames
    gc.collect()
    end = time.monotonic() + 20
    while not (camera.last.released and _ended()):
        assert time.monotonic() < end
        time.sleep(0.001)


def test_a_pipe_is_left_with_the_last_reference_to_its_source(make):
    """Its writer waits, and so does the thread that reads it."""
    reader, writer = os.pipe()
    with open(reader, "rb") as file, open(writer, "wb") as out:
        out.write(jpegs(make)[0])
        out.flush()
        source = open_stream(file)
        assert not _ended()
        del source
        gc.collect()
        end = time.monotonic() + 20
        while not _ended():
            assert time.monotonic() < end
            time.sleep(0.001)
        assert not file.closed, "it belongs to the caller"


def test_the_clock_of_a_served_file_that_is_set_back(camera, monkeypatch):
    """Parts with clocks of their own, one after the other, in a file whose rate is stated wrong."""
    rate = {cv2.CAP_PROP_FPS: 30.0, cv2.CAP_PROP_FRAME_COUNT: 12.0}
    plain = camera.get
    monkeypatch.setattr(camera, "get", lambda self, key: rate.get(key) or plain(self, key))
    camera.stated = [10_000.0 + 1000 * (i % 4) for i in range(12)]
    camera.stated[:4] = [20_000.0 + 1000 * i for i in range(4)]
    frames = list(open_stream("http://host/file.mp4"))
    assert [frame.index for frame in frames][:6] == list(range(6))
    assert (np.diff([frame.timestamp for frame in frames]) > 0).all()
