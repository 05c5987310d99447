import numpy as np
import pytest

from dvo.data import open_source
from dvo.data.clips import fit, read_clips
from dvo.errors import DvoError
from dvo.geometry.camera import Camera


def test_fit_crops_to_the_aspect_and_carries_the_intrinsics():
    u, _ = np.meshgrid(np.arange(124.0), np.arange(40.0))
    image = np.repeat(u[..., None].astype(np.uint8), 3, 2)  # the grey value is the column
    camera = Camera(70, 70, 60, 20, 124, 40)
    small, fitted = fit(image, camera, 20, 15)
    assert small.shape == (15, 20, 3) and (fitted.width, fitted.height) == (20, 15)
    # the same ray has the same column, before and after
    column = np.interp(9.5, np.arange(20), small[7, :, 0].astype(float))
    assert (9.5 - fitted.cx) / fitted.fx == pytest.approx((column - camera.cx) / camera.fx, abs=0.5 / 70)


def test_clips_do_not_span_frames_without_truth(make):
    folder = make.images("clip", [f"{i}.png" for i in range(10)])
    rows = [f"{i / 10} {i} 0 0 0 0 0 1\n" for i in range(10) if i != 4]
    source = open_source(folder, calib=make.calib(), fps=10, groundtruth=make.text("gt.txt", "".join(rows)))
    clips = list(read_clips(source, length=2, width=32, height=24))
    assert [clip.name for clip in clips] == ["clip@0", "clip@2", "clip@5", "clip@7"]
    assert clips[2].poses_wc[:, 0].tolist() == [5, 6] and clips[2].timestamps == pytest.approx([0.5, 0.6])
    overlapping = read_clips(source, length=3, width=32, height=24, hop=1)
    assert [clip.name for clip in overlapping] == [f"clip@{i}" for i in (0, 1, 5, 6, 7)]


def test_clips_need_truth(make):
    source = open_source(make.images("clip", ["0.png"]), calib=make.calib(), fps=1)
    with pytest.raises(DvoError, match="no ground truth"):
        list(read_clips(source, length=2, width=32, height=24))
