import gzip
import io
import os
import threading
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.streams import image_pipe
from dvo.data.streams.image_pipe import pipe_reader, split_images


def encoded(kind, seed=0, *options):
    image = np.random.default_rng(seed).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    return cv2.imencode(kind, image, list(options))[1].tobytes()


def with_thumbnail(jpeg):
    """A JPEG whose EXIF segment holds another one."""
    content = b"Exif\0\0" + encoded(".jpg", 9)
    return jpeg[:2] + b"\xff\xe1" + (len(content) + 2).to_bytes(2, "big") + content + jpeg[2:]


def images():
    progressive = encoded(".jpg", 1, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    restarts = encoded(".jpg", 2, cv2.IMWRITE_JPEG_RST_INTERVAL, 4)
    return [encoded(".jpg"), encoded(".png", 3), with_thumbnail(encoded(".jpg", 4)), progressive, restarts]


def chunks(data, size):
    parts = iter([data[at : at + size] for at in range(0, len(data), size)])
    return lambda: next(parts, b"")


@pytest.mark.parametrize("size", [1, 7, 1000, 10**6])
def test_images_are_found_whatever_the_chunks(size):
    assert list(split_images(chunks(b"".join(images()), size), "pipe")) == images()


def test_an_image_is_given_before_the_next_byte():
    """The reader must not ask for more than the image: a live one would wait for the next."""
    for image in images():
        asked = iter([image])
        assert next(split_images(lambda asked=asked: next(asked), "pipe")) == image


def test_part_headers_and_a_cut_image_are_passed_over():
    first, second = images()[:2]
    header = b"--frame\r\nContent-Type: image/jpeg\r\n\r\n"
    data = header + first + b"\r\n" + header + second + b"\r\n" + first[:-100]
    assert list(split_images(chunks(data, 100), "pipe")) == [first, second]


def test_a_damaged_image_does_not_hide_the_next():
    first, second = images()[:2]
    broken = first[:2] + b"\xff\xe0" + (5).to_bytes(2, "big") + b"\0\0\0no marker"
    no_png = second[:8] + b"\0\0\0\0" + b"\0\0\0\0"
    assert list(split_images(chunks(broken + first + no_png + second, 64), "pipe")) == [first, second]
    png = encoded(".png")
    at = png.index(b"IDAT") - 4
    too_long = png[:at] + (2**31).to_bytes(4, "big") + png[at + 4 :]
    assert list(split_images(chunks(too_long + png, 2**10), "pipe")) == [png]


def test_bounds(monkeypatch):
    endless = lambda: b"\0" * 2**16  # noqa: E731
    with pytest.raises(DvoError, match="pipe: a megabyte without a JPEG or PNG image.*image2pipe"):
        next(split_images(endless, "pipe"))
    monkeypatch.setattr(image_pipe, "MAX_BYTES", 8200)  # the first chunk of data is one of 8192
    with pytest.raises(DvoError, match="more than 0 MB"):
        next(split_images(chunks(encoded(".png"), 2**16), "pipe"))


def test_bytes_of_something_else_are_told_from_a_silent_pipe():
    assert list(split_images(chunks(b"", 100), "pipe")) == []
    video = b"\0\0\0\x18ftypmp42" + bytes(5000)
    with pytest.raises(DvoError, match=r"pipe: no JPEG or PNG image in what arrives. .*image2pipe"):
        list(split_images(chunks(video, 100), "pipe"))


def test_reading_a_pipe_can_be_stopped():
    """A reader that waits for a writer which sends nothing ends when it is told to."""
    out, into = os.pipe()
    stop, found = threading.Event(), []
    with os.fdopen(out, "rb") as file, os.fdopen(into, "wb"):
        read = pipe_reader(file, stop.is_set)
        thread = threading.Thread(target=lambda: found.append(read()))
        thread.start()
        stop.set()
        thread.join(20)
        assert found == [b""]


def test_pipes_and_files_in_memory():
    out, into = os.pipe()
    with os.fdopen(out, "rb") as file:
        with os.fdopen(into, "wb") as writer:
            writer.write(b"abc")
        read = pipe_reader(file, lambda: False)
        assert (read(), read()) == (b"abc", b"")
    memory = pipe_reader(io.BytesIO(b"abc"), lambda: False)
    assert (memory(), memory()) == (b"abc", b"")


def test_what_a_file_decompresses_is_read(tmp_path):
    """The descriptor of a gzip file gives compressed bytes, that of a buffered file not what is in its buffer."""
    data = bytes(range(256)) * 1000
    with gzip.open(tmp_path / "a.gz", "wb") as file:
        file.write(data)
    (tmp_path / "a").write_bytes(data)
    for name, opened in {"a.gz": gzip.open, "a": open}.items():
        with opened(tmp_path / name, "rb") as file:
            assert file.read(5) == data[:5]
            read = pipe_reader(file, lambda: False)
            assert b"".join(iter(read, b"")) == data[5:]


def test_files_that_cannot_be_read_are_named(tmp_path):
    cut = gzip.compress(bytes(10**4))[:-4]
    read = pipe_reader(gzip.GzipFile(fileobj=io.BytesIO(cut)), lambda: False, "clip.gz")
    with pytest.raises(DvoError, match=r"clip.gz: cannot be read \(Compressed file ended"):
        list(iter(read, b""))
    with pytest.raises(DvoError, match="pipe: reading gives str, not bytes"):
        pipe_reader(io.StringIO("abc"), lambda: False)()
    with pytest.raises(DvoError, match="NoneType, not bytes.*waits"):
        pipe_reader(SimpleNamespace(read=lambda count: None), lambda: False)()
