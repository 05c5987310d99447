import cv2
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data import open_source
from dvo.data.images.images import natural_key


def test_natural_sort():
    names = ["img10.png", "img2.png", "img1.png", "a.png", "10.png", "9.png"]
    assert sorted(names, key=natural_key) == ["9.png", "10.png", "a.png", "img1.png", "img2.png", "img10.png"]


def test_images_in_natural_order_with_a_guessed_rate_said_aloud(make):
    folder = make.images("clip", [f"img_{i}.png" for i in range(12)])
    (folder / "notes.md").write_text("not an image")
    (folder / "._img_3.png").write_bytes(b"\0\5\x16\7")
    source = open_source(folder, calib=make.calib())
    frames = list(source)
    assert source.kind == "folder" and source.name == "clip" and len(source) == len(frames) == 12
    assert any("30 frames a second" in warning and "--fps" in warning for warning in source.warnings)
    assert [frame.timestamp for frame in frames] == pytest.approx(np.arange(12) / 30)
    assert [frame.index for frame in frames] == list(range(12))
    assert np.array_equal(frames[10].image, make.image(10)[..., ::-1])  # RGB, and img_10 after img_9
    assert frames[0].camera == source.camera and source.camera.intrinsics.tolist() == [50, 51, 31, 23]


def test_a_source_is_iterated_again(make):
    folder = make.images("clip", ["a.png", "b.png", "c.png"])
    (folder / "b.png").write_bytes(b"broken")
    source = open_source(folder, calib=make.calib(), fps=10)
    assert [f.timestamp for f in source] == [f.timestamp for f in source] == [0.0, 0.2]
    assert source.skipped == 1 and len(source.warnings) == 1


def test_fps(make):
    folder = make.images("clip", ["1.png", "2.png", "3.png"])
    source = open_source(folder, calib=make.calib(), fps=4)
    assert [frame.timestamp for frame in source] == [0, 0.25, 0.5] and source.warnings == []
    with pytest.raises(DvoError, match="positive rate|Give a positive"):
        open_source(folder, calib=make.calib(), fps=0)


def test_stride_keeps_index_and_time(make):
    folder = make.images("clip", [f"{i}.png" for i in range(7)])
    source = open_source(folder, calib=make.calib(), fps=10, stride=3)
    assert [(frame.index, frame.timestamp) for frame in source] == [(0, 0.0), (3, pytest.approx(0.3)), (6, 0.6)]
    assert len(source) == 3
    with pytest.raises(DvoError, match="stride"):
        open_source(folder, calib=make.calib(), stride=0)


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (["1305031102.175304.png", "1305031102.211214.png"], [1305031102.175304, 1305031102.211214]),
        (["1403636579763555584.png", "1403636579813555456.png"], [1403636579.763555584, 1403636579.813555456]),
        (["1.25.png", "1.5.png", "10.0.png"], [1.25, 1.5, 10.0]),  # natural order would put 1.5 first
        (["000001.png", "000002.png"], [0, 1 / 30]),  # frame numbers are no seconds
        (["frame-000000.color.png", "frame-000001.color.png"], [0, 1 / 30]),
        (["20240102030405.png", "20240102030406.png"], [1704164645, 1704164646]),  # dates, UTC
        (["PXL_20240102_030405123.jpg", "PXL_20240102_030405156.jpg"], [1704164645.123, 1704164645.156]),
        (["IMG_20240102_030405.jpg", "IMG_20240102_030405_1.jpg", "IMG_20240102_030405_2.jpg"], [0, 1 / 30, 2 / 30]),
        (["left_1305031102175304.png", "left_1305031102211214.png"], [1305031102.175304, 1305031102.211214]),
        (["1305031102-005000000.png", "1305031102-038000000.png"], [1305031102.005, 1305031102.038]),
        (["000007_1305031102.175.png", "000008_1305031102.211.png"], [1305031102.175, 1305031102.211]),
        (["shot1.0001.png", "shot1.0002.png"], [0, 1 / 30]),
    ],
)
def test_names_as_stamps(make, names, times):
    source = open_source(make.images("clip", names), calib=make.calib())
    assert [frame.timestamp for frame in source] == pytest.approx(times, abs=1e-6)


def test_stereo_pairs_give_the_left_images(make):
    names = [f"{1403715273262142976 + 50_000_000 * i}_{side}.png" for i in range(3) for side in (0, 1)]
    source = open_source(make.images("pairs", names), calib=make.calib())
    assert [frame.timestamp for frame in source] == pytest.approx([1403715273.262143 + 0.05 * i for i in range(3)])
    assert "left" in source.warnings[0]


@pytest.mark.parametrize("where", ["clip/times.txt", "times.txt"])
def test_times_file_beside_the_images_or_one_level_up(make, where):
    folder = make.images("clip", ["1.5.png", "1.75.png"])
    make.text(where, "# seconds\n0.5\n0.7\n")
    assert [frame.timestamp for frame in open_source(folder, calib=make.calib())] == [0.5, 0.7]
    source = open_source(folder, calib=make.calib(), fps=10)
    assert any("--fps was not used" in warning for warning in source.warnings)


@pytest.mark.parametrize(
    "text",
    [
        "0.5\n0.7\n",
        "#t\n0.5 x.png 3\n0.7 y.png 4\n",
        "time,name\n0.5,x.png\n0.7,y.png\n",
        "500000000000000000\n500000000200000000\n",
    ],
    ids=["plain", "columns", "csv", "nanoseconds"],
)
def test_times_option(make, text):
    folder = make.images("clip", ["1.png", "2.png"])
    make.text("times.txt", "1\n2\n3\n")  # loses, although it is malformed
    times = [frame.timestamp for frame in open_source(folder, calib=make.calib(), times=make.text("t.csv", text))]
    assert times[0] in (0.5, 5e8) and times[1] - times[0] == pytest.approx(0.2)


NAMED = [
    (["7f.png", "03.png", "b1.png"], "7f.png 0.5\n03.png 0.7\nb1.png 0.9\n", [0, 1, 2]),  # order of the list alone
    (["a0.png", "a1.png", "a2.png"], "time [ms],file\n900,clip\\a0.png\n700,clip\\a1.png\n500,clip\\a2.png\n",
     [2, 1, 0]),
    (["a3.png", "a4.png", "a5.png"], "".join(f"a{k} 2024-01-02 10:11:{k / 5:06.3f}\n" for k in range(9)), [0, 1, 2]),
    (["00003.png", "00004.png", "00005.png"], "".join(f"{k:05} {k / 5 - 0.1:.3f} 4.1\n" for k in range(9)), [0, 1, 2]),
]  # fmt: skip


@pytest.mark.parametrize(("names", "text", "order"), NAMED, ids=["hashes", "backwards", "dates", "numbers"])
def test_times_of_rows_that_name_their_images(make, names, text, order):
    folder = make.images("clip", names)
    make.text("times.txt", text)
    for path in (folder, make.root):
        source = open_source(path, calib=make.calib())
        assert [file.name for file in source.recording.images] == [names[k] for k in order]
        times = [frame.timestamp for frame in source]
        assert np.diff(times) == pytest.approx([0.2, 0.2], abs=1e-6)
        assert any("name images that are not there" in said for said in source.warnings) == (text.count("\n") == 9)


def test_images_that_no_row_names(make):
    folder = make.images("clip", ["a.png", "b.png", "c.png"])
    file = make.text("times.txt", "a.png 1\nc.png 2\n")
    with pytest.raises(DvoError, match="no row for b.png") as caught:
        open_source(folder, calib=make.calib())
    assert caught.value.file == file
    make.text("times.txt", "a.png 1\nb.png x\nc.png 2\n")
    with pytest.raises(DvoError, match="line 2: no time beside the name"):
        open_source(folder, calib=make.calib())


def test_numbers_that_are_no_names(make):
    """Seconds from 0 for images that are counted from 1."""
    folder = make.images("clip", ["1.png", "2.png", "3.png"])
    make.text("times.txt", "0\n1\n2\n")
    assert [frame.timestamp for frame in open_source(folder, calib=make.calib())] == [0, 1, 2]


def test_times_in_names_are_no_parts_of_several_recordings(make):
    names = [f"{9 + k / 4:.2f}".rstrip("0") + ".png" for k in range(12)]
    source = open_source(make.images("clip", [name.replace("..", ".0.") for name in names]), calib=make.calib())
    assert not source.warnings and len(list(source)) == 12


@pytest.mark.parametrize(
    ("text", "match"),
    [("0\n1\n", "2 rows for 3 images"), ("0\n1\n1\n", "increase"), ("0\nx\n2\n", "'x' is no time"), ("", "0 rows")],
)
def test_times_that_do_not_fit(make, text, match):
    folder = make.images("clip", ["1.png", "2.png", "3.png"])
    file = make.text("t.txt", text)
    with pytest.raises(DvoError, match=match) as caught:
        open_source(folder, calib=make.calib(), times=file)
    assert caught.value.file == file and caught.value.remedy


def test_times_and_fps_together(make):
    folder = make.images("clip", ["1.png"])
    with pytest.raises(DvoError, match="not both"):
        open_source(folder, calib=make.calib(), times=make.text("t.txt", "0\n"), fps=3)


def test_equal_stamps_are_dropped_with_a_remedy(make):
    folder = make.images("clip", ["1.5.png", "1.50.png", "2.5.png"])
    source = open_source(folder, calib=make.calib())
    assert [frame.timestamp for frame in source] == [1.5, 2.5]
    assert "dropped" in source.warnings[0] and "--times" in source.warnings[0]


@pytest.mark.parametrize("damage", ["empty", "text", "cut png", "cut jpg"])
def test_corrupt_images_are_skipped_and_counted(make, damage):
    suffix = "jpg" if damage == "cut jpg" else "png"
    folder = make.images("clip", [f"{i}.{suffix}" for i in range(5)], 320, 240)
    victim = folder / f"2.{suffix}"
    whole = victim.read_bytes()
    victim.write_bytes({"empty": b"", "text": b"hello"}.get(damage, whole[: len(whole) * 6 // 10]))
    source = open_source(folder, calib=make.text("c.txt", "300 300 160 120"), fps=10)
    assert [frame.index for frame in source] == [0, 1, 3, 4]
    assert [frame.timestamp for frame in source] == pytest.approx([0, 0.1, 0.3, 0.4])
    assert source.skipped == 1 and victim.name in source.warnings[0]


def test_first_image_corrupt(make):
    folder = make.images("clip", ["0.png", "1.png"])
    (folder / "0.png").write_bytes(b"")
    assert [frame.index for frame in open_source(folder, calib=make.calib(), fps=10)] == [1]


def test_pixel_formats(make):
    folder = make.root / "formats"
    folder.mkdir()
    grey = make.image(0)[..., 1]
    cv2.imwrite(str(folder / "0.png"), grey)
    cv2.imwrite(str(folder / "1.png"), grey.astype(np.uint16) * 257)
    cv2.imwrite(str(folder / "2.png"), np.dstack([make.image(0), np.full_like(grey, 7)]))  # alpha
    cv2.imwrite(str(folder / "3.png"), make.image(0).astype(np.uint16) * 257)
    frames = [frame.image for frame in open_source(folder, calib=make.calib(), fps=1)]
    assert all(image.shape == (48, 64, 3) and image.dtype == np.uint8 for image in frames)
    assert np.array_equal(frames[0], np.dstack([grey] * 3)) and np.array_equal(frames[1], frames[0])
    assert np.array_equal(frames[2], make.image(0)[..., ::-1]) and np.array_equal(frames[3], frames[2])


def test_float_pixels_are_refused_by_name(make):
    folder = make.root / "depth"
    folder.mkdir()
    cv2.imwrite(str(folder / "0.tiff"), np.ones((48, 64), np.float32))
    with pytest.raises(DvoError, match="0.tiff: pixels of type float32"):
        open_source(folder, calib=make.calib())


def test_images_of_two_sizes(make):
    folder = make.images("clip", ["0.png", "1.png"])
    cv2.imwrite(str(folder / "2.png"), make.image(0, 32, 24))
    frames = iter(open_source(folder, calib=make.calib(), fps=1))
    assert [next(frames).index, next(frames).index] == [0, 1]
    with pytest.raises(DvoError, match="2.png: this image is 32x24, those before are 64x48"):
        next(frames)
