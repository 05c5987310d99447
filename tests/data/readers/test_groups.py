"""Several streams in one folder."""

import re

import cv2
import numpy as np
import pytest

import dvo
from dvo.core.errors import DvoError
from dvo.data import open_source
from dvo.data.companions.depth_source import with_depth
from dvo.data.companions.right_source import with_right
from dvo.data.images.images import is_complete, list_images
from dvo.data.mask import read_mask

DEEP = (np.indices((48, 64))[0] * 10 + 500).astype(np.uint16)


def write(make, folder, *patterns, count=4):
    path = make.root / folder
    path.mkdir()
    for pattern in patterns:
        for i in range(count):
            is_deep = "depth" in pattern or "range" in pattern or pattern.endswith(".tif")
            assert cv2.imwrite(str(path / pattern.format(i)), DEEP if is_deep else make.image(i))
    return path


@pytest.mark.parametrize(
    ("patterns", "option"),
    [
        (("{:04d}.rgb.jpg", "{:04d}.depth.png"), "depth"),
        (("rgb_{}.png", "range_{}.png", "mask_{}.png"), "depth"),
        (("{:03d}.jpg", "{:03d}.tif"), "depth"),  # told apart by their pixels
        (("imgL_{}.png", "imgR_{}.png"), "right"),
        (("cam0_{:03d}.png", "cam1_{:03d}.png"), "right"),
        (("{:03d}-1.png", "{:03d}-2.png"), "right"),
        (("infra1_{:04d}.png", "infra2_{:04d}.png"), "right"),
        (("{:04d}_sensor-3.png", "{:04d}_sensor-5.png"), "right"),
        (("left-{}.png", "right-{}.png", "disparity_{}.png"), "right"),
        (("{}_left.tiff", "{}_right.tiff", "{}_nir.tiff"), "right"),
    ],
)
def test_the_stream_of_colour_or_the_left_one_is_tracked(make, patterns, option):
    folder = write(make, "clip", *patterns)
    source = dvo.open(folder, calib=make.calib(), fps=10)
    assert [path.name for path in source.recording.images] == [patterns[0].format(i) for i in range(4)]
    assert len(source.warnings) == 1 and f"--{option}" in source.warnings[0]
    for place in (None, folder):
        if option == "depth":
            if place is not None and len(patterns) > 2:
                continue
            frame = next(iter(with_depth(source, place)))
            assert np.nanmean(frame.depth) == pytest.approx(DEEP.mean() / 1000)
        elif place is None or len(patterns) == 2:
            frames = list(with_right(source, place, 0.1))
            assert np.array_equal(frames[2].right.image, make.image(2)[..., ::-1])


def test_a_number_that_all_names_of_a_stream_have(make):
    folder = write(make, "renderings", "r_{}.png", "r_{}_depth_0001.png", "r_{}_normal_0001.png")
    source = dvo.open(folder, calib=make.calib(), fps=10)
    assert [path.name for path in source.recording.images] == [f"r_{i}.png" for i in range(4)]
    assert "r_*_depth_*.png (4) for --depth" in source.warnings[0]


@pytest.mark.parametrize(
    ("folder", "beside", "units"),
    [("results", "traj.txt", 6553.5), ("results", "other.txt", 1000), ("clip", "traj.txt", 1000)],
)  # fmt: skip
def test_the_unit_of_depth_in_a_folder_of_replica(make, folder, beside, units):
    images = write(make, folder, "frame{:06d}.jpg", "depth{:06d}.png")
    (make.root / beside).write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n" * 4)
    source = dvo.open(images, calib=make.calib(), fps=10)
    assert any("Replica" in warning for warning in source.warnings) == (units != 1000)
    for place in (None, images):
        frame = next(iter(with_depth(source, place)))
        assert np.nanmean(frame.depth) == pytest.approx(DEEP.mean() / units)
    assert np.nanmean(next(iter(with_depth(source, None, 500))).depth) == pytest.approx(DEEP.mean() / 500)


def test_streams_of_left_and_right_stamps(make):
    names = [f"{side}_{1305031102175304 + 33000 * i + late}.png" for side, late in (("left", 0), ("right", 7)) for i in
             range(3)]  # fmt: skip
    source = dvo.open(make.images("clip", names), calib=make.calib())
    assert len(source) == 3 and np.diff(source.timestamps) == pytest.approx(0.033, abs=1e-6)


@pytest.mark.parametrize("patterns", [("a_{}.png", "b_{}.png"), ("left_depth_{}.png", "right_depth_{}.png")])
def test_streams_without_one_to_track_are_listed(make, patterns):
    folder = write(make, "clip", *patterns)
    with pytest.raises(DvoError, match=r"several streams .*\(4\), .*\(4\).*folder of their own") as caught:
        dvo.open(folder, calib=make.calib())
    assert caught.value.file == folder


@pytest.mark.parametrize(
    "names",
    [
        ["GOPR0001.jpg", "GOPR0002.jpg", "IMG_0003.jpg", "IMG_0004.jpg"],  # two files numbers, no pairs
        ["0_000.png", "0_001.png", "1_000.png", "1_001.png"],
        ["1.png", "2.jpg", "3.png", "4.jpg"],
        ["12_30_0.png", "12_30_1.png", "12_31_0.png", "12_32_7.png"],
    ],
)
def test_one_stream_under_several_names(make, names):
    assert len(dvo.open(make.images("clip", names), calib=make.calib(), fps=10)) == 4


def test_order_of_names_with_and_without_zeros(make):
    names = ["frame10.png", "frame010.png", "frame2.png", "frame02.png", "frame1.png"]
    found = [path.name for path in list_images(make.images("clip", names))]
    assert found == ["frame1.png", "frame02.png", "frame2.png", "frame010.png", "frame10.png"]


@pytest.mark.parametrize("bits", [10, 14])
def test_few_bits_of_16(make, bits):
    folder = make.root / "deep"
    folder.mkdir()
    for i in range(3):
        grey = make.image(i)[..., 1].copy()
        grey[0, 0] = 255
        cv2.imwrite(str(folder / f"{i}.png"), grey.astype(np.uint16) << (bits - 8))
    source = dvo.open(folder, calib=make.calib(), fps=10)
    frame = list(source)[2]
    grey[0, 0] = 255
    assert np.array_equal(frame.image[..., 0], grey)
    assert len(source.warnings) == 1 and f"hold {bits} bits" in source.warnings[0]


@pytest.mark.parametrize(("low", "factor", "told"), [
    (29_000, 6, "29[0-9]{3} to [23][0-9]{4} of 65535"), (7_000, 2, "7[0-9]{3} to 7[0-9]{3} of 16383"), (2_000, 200, ""),
])  # fmt: skip
def test_levels_of_temperatures_are_told(make, low, factor, told):
    folder = make.root / "deep"
    folder.mkdir()
    for i in range(3):
        cv2.imwrite(str(folder / f"{i}.png"), low + factor * make.image(i)[..., 1].astype(np.uint16))
    said = " ".join(dvo.open(folder, calib=make.calib(), fps=10).warnings)
    assert re.search(f"have levels from {told}", said) if told else "levels" not in said


def test_what_follows_the_end_of_an_image():
    picture = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    for code in (
        cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes(),
        cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_RST_INTERVAL, 2])[1].tobytes(),
        cv2.imencode(".png", picture)[1].tobytes(),
    ):
        for trailer in (bytes(5 * len(code)), b"\xff" * 5 * len(code), b"\0\0\0\x18ftypmp42" + code[: len(code) // 2]):
            assert is_complete(code + trailer)
        assert not is_complete(code[: len(code) * 6 // 10])
    # a thumbnail that ends within the first segments is no end
    inner = cv2.imencode(".jpg", picture)[1].tobytes()
    segment = b"\xff\xe1" + (len(inner) + 2).to_bytes(2, "big") + inner
    assert is_complete(inner[:2] + segment + inner[2:])
    assert not is_complete(inner[:2] + segment + inner[2 : len(inner) // 2])


def test_images_of_phones_that_are_not_read_are_said(make):
    (make.root / "phone").mkdir()
    for name in ("a.heic", "b.HEIC"):
        (make.root / "phone" / name).write_bytes(b"\0\0\0\x18ftypheic")
    with pytest.raises(DvoError, match=r"2 images of a format that is not read \(HEIC\).*convert|Convert"):
        dvo.open(make.root / "phone", calib=make.calib())
    make.images("phone", ["1.png", "2.png"])
    assert (
        "2 images of a format that is not read (HEIC)" in dvo.open(make.root / "phone", fps=1, guess=True).warnings[0]
    )


def test_links_without_a_file(make):
    folder = make.images("clip", ["0.png", "2.png"])
    (folder / "1.png").symlink_to("nowhere.png")
    source = dvo.open(folder, calib=make.calib(), fps=10)
    assert [frame.index for frame in source] == [0, 2] and source.skipped == 1
    assert any("1 image is not there" in warning and "1.png" in warning for warning in source.warnings)
    (make.root / "broken").mkdir()
    (make.root / "broken" / "1.png").symlink_to("nowhere.png")
    with pytest.raises(DvoError, match="none of the 1 images is there"):
        dvo.open(make.root / "broken", calib=make.calib(), fps=10)


def test_masks_in_the_alpha_channel(make):
    folder = make.root / "clear"
    folder.mkdir()
    alpha = np.full((48, 64), 255, np.uint8)
    alpha[:20] = 0
    for i in range(3):
        cv2.imwrite(str(folder / f"{i}.png"), np.dstack([make.image(i), alpha]))
    source = dvo.open(folder, calib=make.calib(), fps=10)
    assert len(list(source)) == 3 and "transparent" in source.warnings[0] and "--mask" in source.warnings[0]
    frame = next(iter(dvo.open(folder, calib=make.calib(), fps=10, mask=folder)))
    assert np.array_equal(frame.mask, alpha > 0)
    cv2.imwrite(str(make.root / "m.png"), np.dstack([np.zeros((48, 64, 3), np.uint8), alpha]))
    assert np.array_equal(read_mask(make.root / "m.png"), alpha > 0)
    white = np.zeros((48, 64, 3), np.uint8)
    white[:, :30] = 255
    cv2.imwrite(str(make.root / "m.png"), np.dstack([white, alpha]))
    assert np.array_equal(read_mask(make.root / "m.png"), (alpha > 0) & (white[..., 0] > 0))


def test_backslashes_in_lists(make):
    make.images("s/rgb", ["1.png", "2.png"])
    make.text("s/rgb.txt", "timestamp filename\n1.0 rgb\\1.png\n1.5 rgb\\2.png\n")
    assert len(list(dvo.open(make.root / "s", calib=make.calib()))) == 2


@pytest.mark.parametrize(
    ("folders", "said"),
    [
        (["L", "R"], ["R (--right "]),
        (["cam_left", "cam_right"], ["cam_right (--right "]),
        (["infra2", "infra1"], ["infra2 (--right "]),
        (["view_9", "view_10"], ["view_10 (--right "]),
        (["image_0", "image_1"], ["image_1 (--right "]),
        (["rgb", "depth", "masks"], ["depth (--depth ", "masks (--mask "]),
        (["color", "disparity"], ["disparity"]),
    ],
)
def test_folders_beside_the_one_that_is_read(make, folders, said):
    for name in folders:
        write(make, f"clip_{name}", "{:03d}.png")
    clip = make.root / "clip"
    clip.mkdir()
    for name in folders:
        (make.root / f"clip_{name}").rename(clip / name)
    source = dvo.open(clip, calib=make.calib(), fps=10)
    chosen = "infra1" if "infra1" in folders else folders[0]
    assert source.recording.images[0].parent.name == chosen
    (note,) = source.warnings
    assert f"reading {chosen}; beside it are " in note and all(part in note for part in said)
    assert "disparity (" not in note


def test_folders_that_no_name_tells_apart(make):
    for name in ("front", "back"):
        write(make, name, "{:03d}.png")
    with pytest.raises(DvoError, match="several folders of images: back, front"):
        dvo.open(make.root, calib=make.calib(), fps=10)


@pytest.mark.parametrize("pattern", ["DSC{:05d}.JPG", "IMG_{:04d}.JPG", "GOPR{:04d}.JPG"])
def test_cameras_count_anew_behind_9999(make, pattern):
    names = [pattern.format((9995 + i) % 9999 + 1) for i in range(8)]
    source = dvo.open(make.images("clip", names), calib=make.calib(), fps=10)
    assert [path.name for path in source.recording.images] == names
    assert source.warnings == [f"the names count from {names[3]} on with {names[4]}"]
    whole = [pattern.format(i) for i in (*range(1, 9000, 900), 9999)]  # every so many of a long recording
    source = dvo.open(make.images("few", whole), calib=make.calib(), fps=10)
    assert [path.name for path in source.recording.images] == whole and source.warnings == []


def test_names_of_several_recordings_are_said(make):
    takes = [f"take{take}_{i:03d}.png" for take in (1, 2) for i in range(4)]
    source = dvo.open(make.images("takes", takes), calib=make.calib(), fps=10)
    assert len(source) == 8 and "begin anew at take2_000.png" in " ".join(source.warnings)
    parts = [f"part{part}_{4 * part + i:03d}.png" for part in (1, 2) for i in range(4)]
    assert dvo.open(make.images("parts", parts), calib=make.calib(), fps=10).warnings == []


def test_a_name_of_another_kind_is_said(make):
    names = [f"{i:03d}.png" for i in range(8)]
    source = dvo.open(make.images("odd", [*names, "preview.png"]), calib=make.calib(), fps=10)
    assert len(source) == 9 and "another kind are read too" in " ".join(source.warnings)
    assert "preview.png" in " ".join(source.warnings)
    words = make.images("words", ["kitchen.png", "hall.png", "door.png", "room.png"])
    assert dvo.open(words, calib=make.calib(), fps=10).warnings == []


def test_hexadecimal_numbers_are_in_order(make):
    folder = write(make, "clip", "{:02x}.png", count=20)
    assert [path.stem for path in list_images(folder)] == [f"{i:02x}" for i in range(20)]


def test_jpeg_files_of_other_endings(make):
    folder = make.root / "clip"
    folder.mkdir()
    for i, ending in enumerate(("jfif", "jpe", "JPG")):
        (folder / f"{i}.{ending}").write_bytes(cv2.imencode(".jpg", make.image(i))[1].tobytes())
    assert len(list(dvo.open(folder, calib=make.calib(), fps=10))) == 3


def test_streams_of_airsim(make):
    """The number before a stamp that both share is that of the kind of image."""
    names = [f"img_Drone1__{kind}_{1700000000000000000 + k * 33333333}.png" for kind in (0, 5) for k in range(4)]
    source = open_source(make.images("clip", names), calib=make.calib())
    assert [file.name for file in source.recording.images] == names[:4]
    assert "img_Drone*__5_*.png (4), which are not used" in source.warnings[0]


@pytest.mark.parametrize(("stems", "told"), [
    (["one", "two", "three", "four", "five"], True), (["7f03a1", "03b2ff", "b19c00", "e24d01", "55aa12"], True),
    (["0af438d2-9752", "3b5f3d86-268e", "03e0a813-bdc2", "11aa813b-cdc2", "e1aa813b-c0c2"], True),
    ([f"{k * 3:02x}" for k in range(12)], False), (["a1", "a2", "a3", "b1"], False), (["one", "two", "three"], False),
])  # fmt: skip
def test_names_that_are_in_no_order_are_told(make, stems, told):
    folder = make.images("clip", [f"{stem}.png" for stem in stems])
    said = open_source(folder, calib=make.calib(), fps=10).warnings
    assert any("do not tell in which order" in line for line in said) == told
    make.text("times.txt", "".join(f"{stem}.png {k / 10}\n" for k, stem in enumerate(stems)))
    assert not any("in which order" in line for line in open_source(folder, calib=make.calib()).warnings)
