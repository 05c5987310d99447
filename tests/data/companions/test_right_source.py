"""Right images for any source: of the data set, of folders, lists and videos, and the distance of the cameras."""

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data import open_source
from dvo.data.companions.right_source import with_right


def images(make, names=("1.png", "2.png", "3.png"), folder="seq/image_0"):
    make.images(folder, list(names))
    make.calib("seq/calib.txt")
    return open_source(make.root / folder, calib=make.root / "seq/calib.txt", fps=10)


def seen(make, source):
    """Number of the image of the fixture that each right image is, None without one."""
    numbers = []
    for frame in source:
        view = frame.right
        same = [] if view is None else [k for k in range(5) if np.array_equal(view.image, make.image(k)[..., ::-1])]
        numbers.append(same[0] if same else None)
    return numbers


def test_by_the_numbers_of_a_folder_beside_the_images(make):
    source = images(make)
    make.images("seq/other", ["r1.png", "r3.png"])
    for path in (make.root / "seq/other", "../other"):
        found = with_right(source, path, 0.2)
        assert seen(make, found) == [0, None, 1]
    assert all(frame.right is None for frame in source)  # as it was
    view = next(iter(found)).right
    assert view.camera == source.camera and view.T_left_right.tolist() == [0.2, 0, 0, 0, 0, 0, 1]


def test_the_usual_folder_beside_that_of_the_images(make):
    source = images(make)
    make.images("seq/image_1", ["1.png", "2.png", "3.png"])
    assert seen(make, with_right(source, None, 0.2)) == [0, 1, 2]
    with pytest.raises(DvoError, match="--baseline: is not known"):
        with_right(source)


def test_in_order_and_by_the_times_of_a_list(make):
    source = images(make, ("a.png", "b.png", "c.png"))
    folder = make.images("seq/r", ["x.png", "y.png", "z.png"])
    assert seen(make, with_right(source, folder, 0.2)) == [0, 1, 2]
    rows = make.text("right.txt", "0.01 seq/r/y.png\n0.19 seq/r/x.png\n")
    assert seen(make, with_right(source, rows, 0.2)) == [1, None, 0]


def test_the_calibration_states_the_distance_and_the_option_wins(make):
    make.images("clip/left", ["1.png", "2.png"])
    make.images("clip/right", ["1.png", "2.png"])
    make.text("clip/calib.yaml", "{fx: 50, fy: 51, cx: 31, cy: 23, baseline: 0.12}")
    source = open_source(make.root / "clip", fps=10)
    first = next(iter(source)).right
    assert first.baseline == next(iter(with_right(source))).right.baseline == 0.12
    assert next(iter(with_right(source, baseline=0.3))).right.baseline == 0.3
    assert next(iter(with_right(source, "right"))).right.baseline == 0.12


def test_right_images_in_the_layout_of_tum_where_the_calibration_states_the_distance(make):
    for folder in ("rgb", "right"):
        make.images(f"seq/{folder}", ["10.000000.png", "10.100000.png"])
    make.text("seq/rgb.txt", "10.0 rgb/10.000000.png\n10.1 rgb/10.100000.png")
    make.calib("seq/calib.txt")
    assert all(frame.right is None for frame in open_source(make.root / "seq"))
    (make.root / "seq/calib.txt").unlink()
    make.text("seq/calib.yaml", "{fx: 50, fy: 51, cx: 31, cy: 23, baseline: 0.12}")
    source = open_source(make.root / "seq")
    assert seen(make, source) == [0, 1] and next(iter(source)).right.baseline == 0.12


def test_of_a_video_a_folder_or_another_video(make):
    left = open_source(make.video("left.avi", "MJPG", frames=5), calib=make.calib())
    folder = make.images("r", [f"{k}.png" for k in range(5)], 160, 120)
    for frame in with_right(left, folder, 0.1):
        assert np.array_equal(frame.right.image, make.image(frame.index, 160, 120)[..., ::-1])
    both = with_right(left, make.video("right.avi", "MJPG", frames=5), 0.1)
    assert all(np.array_equal(frame.right.image, frame.image) for frame in both)
    part = open_source(make.root / "left.avi", calib=make.calib(), start="1f", stride=2)
    frames = list(with_right(part, "right.avi", 0.1))
    assert [frame.index for frame in frames] == [1, 3]
    assert all(np.array_equal(frame.right.image, frame.image) for frame in frames)
    with pytest.raises(DvoError, match="6 frames, the left video has 5"):
        with_right(left, make.video("long.avi", "MJPG", frames=6), 0.1)
    with pytest.raises(DvoError, match="4 right images for 5 frames"):
        with_right(left, make.images("few", [f"{k}.png" for k in range(4)]), 0.1)
    with pytest.raises(DvoError, match="--right FOLDER"):
        with_right(left, None, 0.1)


def test_what_cannot_be_a_stereo_pair_is_refused(make):
    source = images(make, folder="seq/rgb")
    with pytest.raises(DvoError, match="no right images of its own"):
        with_right(source, None, 0.2)
    with pytest.raises(DvoError, match="right: no such file"):
        with_right(source, "nothing", 0.2)
    (make.root / "empty").mkdir()
    with pytest.raises(DvoError, match="no right images in it"):
        with_right(source, make.root / "empty", 0.2)
    with pytest.raises(DvoError, match="2 right images for 3 images"):
        with_right(source, make.images("two", ["x.png", "y.png"]), 0.2)
    with pytest.raises(DvoError, match="--baseline: is -1"):
        with_right(source, make.root / "seq/rgb", -1.0)
    guessed = open_source(make.root / "seq/rgb", fps=10, guess=True)
    with pytest.raises(DvoError, match="focal length, which was guessed"):
        with_right(guessed, make.root / "seq/rgb", 0.2)
