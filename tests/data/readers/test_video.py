import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data import Calibration, open_source

CALIB = Calibration(100, 100, 80, 60)


@pytest.mark.parametrize(("name", "codec"), [("v.mp4", "mp4v"), ("v.avi", "MJPG")])
def test_frames_times_and_colours(make, name, codec):
    source = open_source(make.video(name, codec), calib=CALIB)
    frames = list(source)
    assert (source.kind, source.name, len(source), len(frames)) == ("video", "v", 20, 20)
    assert [frame.timestamp for frame in frames] == pytest.approx(np.arange(20) / 20)
    assert source.warnings == [] and source.skipped == 0
    error = np.abs(frames[7].image.astype(int) - make.image(7, 160, 120)[..., ::-1])
    assert error.mean() < 12 < np.abs(frames[7].image.astype(int) - make.image(7, 160, 120)).mean()  # RGB, not BGR
    assert [frame.index for frame in source] == list(range(20))  # again


def test_stride_fps_and_times(make):
    video = make.video("v.mp4", "mp4v")
    source = open_source(video, calib=CALIB, stride=8)
    assert [(frame.index, frame.timestamp) for frame in source] == [(0, 0.0), (8, 0.4), (16, 0.8)]
    assert len(source) == 3
    assert [f.timestamp for f in open_source(video, calib=CALIB, fps=5)] == pytest.approx(np.arange(20) / 5)
    times = make.text("t.txt", "".join(f"{100 + i * i}\n" for i in range(20)))
    assert [f.timestamp for f in open_source(video, calib=CALIB, times=times)] == [100 + i * i for i in range(20)]


def test_a_row_of_jpegs_has_no_times(make):
    code = b"".join(cv2.imencode(".jpg", make.image(i))[1].tobytes() for i in range(5))
    (make.root / "v.mjpeg").write_bytes(code)
    source = open_source(make.root / "v.mjpeg", calib=make.calib())
    assert [frame.timestamp for frame in source] == pytest.approx(np.arange(5) / 25)
    assert any("the video has no times: assuming the stated 25" in warning for warning in source.warnings)
    source = open_source(make.root / "v.mjpeg", calib=make.calib(), fps=10)
    assert [frame.timestamp for frame in source] == pytest.approx(np.arange(5) / 10) and not source.warnings


def test_wrong_number_of_times(make):
    video = make.video("v.mp4", "mp4v")
    with pytest.raises(DvoError, match="19 rows for 20 images"):
        open_source(video, calib=CALIB, times=make.text("t.txt", "".join(f"{i}\n" for i in range(19))))


def test_times_for_what_can_be_read_of_a_truncated_video(make):
    video = make.video("v.avi", "MJPG")
    video.write_bytes(video.read_bytes()[: video.stat().st_size * 6 // 10])
    count = len(list(open_source(video, calib=CALIB)))
    times = make.text("t.txt", "".join(f"{i}\n" for i in range(count)))
    assert [f.timestamp for f in open_source(video, calib=CALIB, times=times)] == list(range(count))


def test_truncated_video_yields_what_can_be_read_and_says_so(make):
    video = make.video("v.avi", "MJPG")
    video.write_bytes(video.read_bytes()[: video.stat().st_size * 6 // 10])
    source = open_source(video, calib=CALIB)
    frames = list(source)
    assert 9 <= len(frames) <= 13
    assert [frame.timestamp for frame in frames] == pytest.approx(np.arange(len(frames)) / 20)
    assert f"announces 20 frames, {len(frames)} could be read: it is cut short" in source.warnings[-1]


@pytest.mark.parametrize("junk", ["zeros", "noise"])
def test_corrupt_middle_of_an_mp4_is_skipped_counted_and_keeps_its_time(make, junk):
    video = make.video("v.mp4", "mp4v")
    data = bytearray(video.read_bytes())
    start, length = len(data) * 4 // 10, len(data) // 8
    noise = np.random.default_rng(0).integers(0, 256, length, dtype=np.uint8).tobytes()
    data[start : start + length] = noise if junk == "noise" else bytes(length)
    video.write_bytes(data)
    source = open_source(video, calib=CALIB)
    frames = list(source)
    assert 12 <= len(frames) < 20 and frames[-1].index == 19  # reading went on behind the damage
    assert source.skipped == 20 - len(frames)
    assert f"{source.skipped} images could not be read" in source.warnings[0]
    assert [frame.timestamp for frame in frames] == pytest.approx([frame.index / 20 for frame in frames])


def test_corrupt_middle_of_an_avi(make):
    video = make.video("v.avi", "MJPG")
    data = bytearray(video.read_bytes())
    start, length = len(data) * 4 // 10, len(data) // 8
    data[start : start + length] = bytes(length)
    video.write_bytes(data)
    source = open_source(video, calib=CALIB)
    frames = list(source)
    assert 14 <= len(frames) < 20 and source.warnings
    assert np.all(np.diff([frame.timestamp for frame in frames]) > 0)


@pytest.mark.parametrize("content", ["empty", "noise", "headless mp4", "png"])
def test_files_that_are_no_video(make, content, capfd):
    video = make.video("v.mp4", "mp4v")
    if content == "headless mp4":  # the index is written last
        video.write_bytes(video.read_bytes()[:5000])
    elif content == "png":  # OpenCV takes a numbered image for a video of all its siblings
        video = make.images("images", ["0001.png", "0002.png"]) / "0001.png"
    else:
        video.write_bytes(b"" if content == "empty" else bytes(np.random.default_rng(0).bytes(5000)))
    capfd.readouterr()
    with pytest.raises(
        DvoError, match="does not decode|no frame of this video decodes|one image is no video|an empty file is no"
    ) as caught:
        list(open_source(video, calib=CALIB))
    assert caught.value.file == video and caught.value.remedy
    assert "VIDEOIO" not in capfd.readouterr().err


def test_no_calibration(make):
    with pytest.raises(DvoError, match="--calib FILE"):
        open_source(make.video("v.mp4", "mp4v"))


def test_intrinsics_of_another_video(make):
    with pytest.raises(DvoError, match="160x120"):
        open_source(make.video("v.mp4", "mp4v"), calib=Calibration(500, 500, 320, 240))


class StampsLike:
    """A capture whose container gives the milliseconds that a test wants."""

    def __init__(self, milliseconds):
        self.milliseconds, self.position = milliseconds, -1

    def isOpened(self):
        return True

    def grab(self):
        self.position += 1
        return self.position < len(self.milliseconds)

    def get(self, key):
        facts = {cv2.CAP_PROP_FRAME_COUNT: len(self.milliseconds), cv2.CAP_PROP_FPS: 25.0}
        return facts.get(key, self.milliseconds[max(self.position, 0)] if key == cv2.CAP_PROP_POS_MSEC else 0.0)

    def set(self, key, value):
        return True

    def retrieve(self):
        return True, np.zeros((120, 160, 3), np.uint8)

    def release(self):
        pass


@pytest.mark.parametrize(
    ("milliseconds", "times", "warned"),
    [
        ([0, 33, 66, 150, 160], [0, 0.033, 0.066, 0.15, 0.16], None),  # variable rate
        ([0, 0, 0, 0], [0, 0.04, 0.08, 0.12], "the stated 25 frames"),
        ([0, 40, 80, 80, 60, 120], [0, 0.04, 0.08, 0.12], "dropped"),
        ([0, 0.01, 0.02, 0.03], [0, 0.04, 0.08, 0.12], "states 25 frames a second: assuming the stated 25"),
    ],
    ids=["variable", "none", "backwards", "hasty"],
)
def test_times_of_the_container(make, monkeypatch, milliseconds, times, warned):
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: StampsLike(milliseconds))
    source = open_source(make.text("v.mp4", "stand-in\0"), calib=CALIB)
    assert [frame.timestamp for frame in source] == pytest.approx(times)
    assert any(warned in warning for warning in source.warnings) if warned else source.warnings == []


def turn(video, degrees):
    """Ask players, in the header of an MP4's track, to turn the frames clockwise."""
    data = bytearray(video.read_bytes())
    at = data.index(b"tkhd") + 4 + 40  # the matrix a b u, c d v, x y w; version 0 of the header
    one = 1 << 16
    a, b = {90: (0, one), 180: (-one, 0), 270: (0, -one)}[degrees]
    data[at : at + 36] = struct.pack(">9i", a, b, 0, -b, a, 0, 0, 0, 1 << 30)
    video.write_bytes(data)


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_a_turned_video_has_no_rows_to_read_out(make, degrees):
    video = make.video("v.mp4", "mp4v")
    if degrees:
        turn(video, degrees)
    calib = Calibration(100, 100, 60, 60, readout=0.02)
    source = open_source(video, calib=calib)
    frame = next(iter(source))
    assert frame.image.shape[:2] == ((160, 120) if degrees in (90, 270) else (120, 160))
    assert frame.camera.readout == (0 if degrees else 0.02)
    assert any("readout" in warning for warning in source.warnings) == bool(degrees)
    assert open_source(video, calib=CALIB if degrees in (0, 180) else replace(calib, readout=0.0)).warnings == []


def test_parts_with_clocks_of_their_own(make, monkeypatch):
    """The times of the second part begin anew: it is read, after the first."""
    milliseconds = [0, 40, *range(20_000, 20_400, 40), *range(0, 400, 40), *range(10, 410, 40)]
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: StampsLike(milliseconds))
    source = open_source(make.video("a.avi", "MJPG", frames=2), calib=make.text("c.txt", "50 50 31.5 23.5"))
    frames = list(source)
    stamps = [frame.timestamp for frame in frames]
    assert len(frames) >= 22 and (np.diff(stamps) > 0).all() and max(np.diff(stamps)[3:21]) < 0.05
    assert any("clock was set back before frame 12" in text for text in source.warnings)


def test_short_parts_with_clocks_of_their_own(make, monkeypatch):
    """Three frames in a row that are late show it; single ones, in another order than that of their times, do not."""
    milliseconds = [*range(0, 400, 40), 390, 400, 420, 410, *range(440, 600, 40), *range(0, 400, 40)]
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: StampsLike(milliseconds))
    source = open_source(make.video("a.avi", "MJPG", frames=2), calib=make.text("c.txt", "50 50 31.5 23.5"))
    stamps = [frame.timestamp for frame in source]
    assert len(stamps) == len(milliseconds) - 3 and (np.diff(stamps) > 0).all() and max(np.diff(stamps)) < 0.05
    assert any("clock was set back before frame 20" in text for text in source.warnings)


@pytest.mark.parametrize(("rate", "said"), [(0, "has no times: assuming"), (90_000, "states 90,000 frames a second")])
def test_a_rate_that_no_camera_has(make, rate, said):
    """Of none FFmpeg makes 25 a second, and of 90,000 a video that lasts no time."""
    video = make.video("a.avi", "MJPG", frames=6)
    data = bytearray(video.read_bytes())
    struct.pack_into("<I", data, data.index(b"avih") + 8, 0)
    struct.pack_into("<II", data, data.index(b"strh") + 28, 1, rate)
    video.write_bytes(data)
    source = open_source(video, calib=CALIB)
    stamps = [frame.timestamp for frame in source]
    assert said in source.warnings[0] and len(stamps) == 6
    assert np.diff(stamps) == pytest.approx(1 / (30 if rate else 25), abs=1e-3)
    assert [frame.timestamp for frame in open_source(video, calib=CALIB, fps=5)][1] == 0.2


@pytest.mark.parametrize(("content", "what"), [
    (b"frame000.png\nframe001.png\n", "a text file"), (b"PK\x03\x04" + bytes(40), "an archive"), (b"", "an empty file"),
    (b"ffconcat version 1.0\nfile clip.mp4\n", "a text file"), (b"\xef\xbb\xbf#EXTM3U\n#\0\n", "a text file"),
    (b"0.05 images/001.png\n" * 24, "a text file"),
    (b"RIFF\x24\x00\x00\x00WAVEfmt " + bytes(40), "a recording of sound"),
    (bytes(3) + b"\x14ftypisom" + bytes(11) + b"\x21hdlr" + bytes(8) + b"soun" + bytes(12), "a recording of sound"),
])  # fmt: skip
def test_files_that_are_no_video_at_all_are_named(tmp_path, content, what):
    (tmp_path / "clip.txt").write_bytes(content)
    with pytest.raises(DvoError, match=f"clip.txt: {what} is no video. Give a video or the folder"):
        open_source(tmp_path / "clip.txt", guess=True)


def with_index(video, change):
    """Change the entries ``(kind, flags, place, length)`` of the index at the end of an AVI."""
    data = video.read_bytes()
    at = data.rindex(b"idx1") + 8
    (length,) = struct.unpack_from("<I", data, at - 4)
    entries = change(list(struct.iter_unpack("<4s3I", data[at : at + length])))
    video.write_bytes(data[:at] + b"".join(struct.pack("<4s3I", *entry) for entry in entries) + data[at + length :])


INDEXES = {
    "right": lambda entries: entries,
    "shuffled": lambda entries: entries[::-1],
    "one place": lambda entries: [(kind, flags, entries[3][2], length) for kind, flags, _, length in entries],
    "other places": lambda entries: [(kind, flags, place + 6, length) for kind, flags, place, length in entries],
}


@pytest.mark.parametrize("index", INDEXES)
def test_the_index_of_an_avi_is_believed_only_if_it_is_that_of_the_frames(make, index):
    video = make.video("v.avi", "MJPG")
    right = [frame.image for frame in open_source(video, calib=CALIB)]
    with_index(video, INDEXES[index])
    source = open_source(video, calib=CALIB)
    frames = list(source)
    assert len(frames) == 20 and all(np.array_equal(a.image, b) for a, b in zip(frames, right, strict=True))
    assert [frame.timestamp for frame in frames] == pytest.approx(np.arange(20) / 20)
    assert ["index of the file is damaged" in text for text in source.warnings] == [True] * (index != "right")


def chunk(kind, content):
    return kind + struct.pack("<I", len(content)) + content + bytes(len(content) % 2)


def test_an_index_of_opendml_in_another_order(make):
    """An index at the head of the stream that names the frames backwards."""
    video = make.video("v.avi", "MJPG")
    right = [frame.image for frame in open_source(video, calib=CALIB)]
    data = video.read_bytes()

    def parts(at, end):
        while at + 8 <= end:
            kind, length = struct.unpack_from("<4sI", data, at)
            yield kind, data[at + 8 : at + 8 + length], at + 8
            at += 8 + length + length % 2

    lists = {content[:4]: (at + 4, at + len(content)) for kind, content, at in parts(12, len(data)) if kind == b"LIST"}
    head = {kind: (content, at) for kind, content, at in parts(*lists[b"hdrl"])}
    stream, at = head[b"LIST"]
    kept = {kind: content for kind, content, _ in parts(at + 4, at + len(stream))}
    frames = [content for kind, content, _ in parts(*lists[b"movi"]) if kind == b"00dc"]

    def beginning(place, length):
        index = struct.pack("<HBBI4s12xQII", 4, 0, 0, 1, b"00dc", place, length, len(frames))
        strl = chunk(b"strh", kept[b"strh"]) + chunk(b"strf", kept[b"strf"]) + chunk(b"indx", index)
        return chunk(b"LIST", b"hdrl" + chunk(b"avih", head[b"avih"][0]) + chunk(b"LIST", b"strl" + strl))

    movie, places = b"movi", []
    for content in frames:
        places.append((12 + len(beginning(0, 0)) + 8 + len(movie) + 8, len(content)))
        movie += chunk(b"00dc", content)
    index = struct.pack("<HBBI4sQ4x", 2, 0, 1, len(places), b"00dc", 0)
    index = chunk(b"ix00", index + b"".join(struct.pack("<II", *place) for place in reversed(places)))
    place = 12 + len(beginning(0, 0)) + 8 + len(movie)
    video.write_bytes(chunk(b"RIFF", b"AVI " + beginning(place, len(index)) + chunk(b"LIST", movie + index)))
    source = open_source(video, calib=CALIB)
    read = list(source)
    assert all(np.array_equal(a.image, b) for a, b in zip(read, right, strict=True))
    assert "damaged" in " ".join(source.warnings)
