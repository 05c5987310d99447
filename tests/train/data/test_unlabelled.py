"""Clips from recordings without ground truth, and their mixture with renderings."""

import cv2
import numpy as np
import pytest
import torch

from dvo.core.errors import DvoError
from train.data.mixture import LabelledRenderings, Mixture
from train.data.unlabelled import UnlabelledClips, UnlabelledData, apparent_motion

SIZE = (48, 64)


def recording(folder, shifts):
    """Images of a wall that moves by so many pixels, with a calibration and without poses."""
    folder.mkdir(parents=True)
    noise = np.random.default_rng(1).integers(0, 255, (60, 400, 3), dtype=np.uint8)
    wall = cv2.GaussianBlur(noise, (0, 0), 2.0)
    wall = cv2.normalize(wall, None, 0, 255, cv2.NORM_MINMAX)
    for number, left in enumerate(np.cumsum(shifts)):
        cv2.imwrite(str(folder / f"{number:04d}.png"), wall[4:52, left : left + 64])
    (folder / "calib.txt").write_text("50 50 31.5 23.5\n")
    return str(folder)


@pytest.fixture
def moving(tmp_path):
    return recording(tmp_path / "moving", [0] + [3] * 11)


def data(*folders, **changes):
    return UnlabelledData(list(folders), **({"hops": [1], "calib": "calib.txt"} | changes))


def test_motion_is_measured_in_pixels():
    wall = np.zeros((3, 60, 100), np.uint8) + cv2.GaussianBlur(
        np.random.default_rng(0).integers(0, 255, (60, 100), dtype=np.uint8), (0, 0), 2.0
    )
    images = np.stack([wall[:, :, 4 * i : 4 * i + 64] for i in range(3)])
    assert apparent_motion(images) == pytest.approx(4, rel=0.15)
    assert apparent_motion(images[:1].repeat(3, 0)) < 0.01


def test_an_index_is_a_clip_without_labels(moving):
    clips = UnlabelledClips(5, data(moving), 3, *SIZE)
    a, b = clips[4], clips[4]
    assert torch.equal(a["images"], b["images"]) and a["images"].shape == (3, 3, *SIZE)
    assert torch.isnan(a["depth"]).all() and torch.isnan(a["poses_cw"]).all()
    torch.testing.assert_close(a["intrinsics"], torch.tensor([50.0, 50, 31.5, 23.5]).expand(3, 4))
    assert len({clips[i]["images"].sum().item() for i in range(6)}) > 1


def test_clips_are_those_that_move(tmp_path):
    """A camera that stands still most of the time, moves, and then rushes."""
    folder = recording(tmp_path / "mixed", [0] * 20 + [3] * 6 + [25] * 6)
    clips = UnlabelledClips(0, data(folder, flow_low=2.0, flow_high=6.0), 3, *SIZE)
    flows = [apparent_motion(clips[i]["images"].numpy()) for i in range(12)]
    assert sum(2 <= flow <= 6 for flow in flows) >= 8 and len(clips.starts) == 30


def test_a_video_is_read_whole(tmp_path, moving):
    file = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    for image in sorted((tmp_path / "moving").glob("*.png")):
        writer.write(cv2.imread(str(image)))
    writer.release()
    calib = str(tmp_path / "moving" / "calib.txt")
    film = UnlabelledClips(5, data(str(file), calib=calib), 3, *SIZE)
    images = UnlabelledClips(5, data(moving, calib=calib), 3, *SIZE)
    assert film.starts == images.starts
    a, b = film[0]["images"].float(), images[0]["images"].float()
    assert (a - b).abs().mean() < 12  # MJPG


@pytest.mark.parametrize(
    ("folder", "changes", "frames", "message"),
    [("still", {}, 3, "data.real.folders: none of 32 clips moves"),
     ("moving", {}, 13, "data.real.folders: 12 frames are too few for a clip of 13"),
     ("moving", {"calib": None}, 3, "data.real.calib: no calibration.*--data.real.calib FILE"),
     ("nowhere", {}, 3, "no such file or folder")],
)  # fmt: skip
def test_what_cannot_be_trained_on_is_named(moving, tmp_path, folder, changes, frames, message):
    recording(tmp_path / "still", [0] * 12)
    with pytest.raises(DvoError, match=message) as refused:
        UnlabelledClips(0, data(str(tmp_path / folder), **changes), frames, *SIZE)
    assert folder in str(refused.value)


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"real": UnlabelledData()}, "data.real.folders: no recordings are named"),
     ({"real": UnlabelledData("a", share=2.0)}, "data.real.share"),
     ({"real": UnlabelledData("a", hops=[0])}, "data.real.hops"),
     ({"real": UnlabelledData("a", flow_low=5.0, flow_high=2.0)}, "data.real.flow_low"),
     ({"labelled": LabelledRenderings(share=-1.0)}, "data.labelled.share"),
     ({"low_light": 7.0}, "data.low_light"), ({"frames": 1}, "data.frames")],
)  # fmt: skip
def test_bad_settings_are_named(settings, message):
    with pytest.raises(DvoError, match=message):
        Mixture(**settings)


@pytest.mark.long
def test_a_batch_is_of_one_kind(moving):
    mixture = Mixture(
        seed=2, batch_size=2, frames=3, sizes=[SIZE], real=data(moving, share=0.5), workers=0,
        labelled=LabelledRenderings(share=0.4),
    )  # fmt: skip
    kinds = [mixture.kind(batch) for batch in range(400)]
    assert kinds == [mixture.kind(batch) for batch in range(400)]
    shares = [kinds.count(kind) / 400 for kind in ("labelled", "recorded", "rendered")]
    assert shares == pytest.approx([0.4, 0.3, 0.3], abs=0.07)
    clips = mixture.clips()
    for kind in ("labelled", "recorded", "rendered"):
        batch = kinds.index(kind)
        for index in (2 * batch, 2 * batch + 1):
            clip = clips[index]
            assert torch.isfinite(clip["poses_cw"]).all() == (kind == "labelled")
            assert torch.isfinite(clip["depth"]).any() == (kind == "labelled")
            assert clip["images"].float().std() > 1
        names = mixture.material(2 * batch).recordings
        assert names == (("moving",) if kind == "recorded" else ())
    said = "30% from the recordings moving without ground truth; 30% rendered, labels ignored; 40% rendered with labels"
    assert mixture.summary() == said
