"""Clips of a study on disk."""

from itertools import islice

import torch

from train.studies.clips import DiskClips, StudyClips
from train.studies.config import StudyConfig

CONFIG = StudyConfig(frames=3, size=(48, 64))


def test_clips_are_rendered_once_and_used_in_turn(tmp_path, monkeypatch):
    clips = DiskClips(tmp_path, 5, 2, CONFIG)
    first = clips[0]
    assert first["images"].shape == (3, 3, 48, 64)
    monkeypatch.setattr(clips, "rendered", None)
    again = clips[2]
    assert all(torch.equal(first[name], again[name]) for name in ("images", "poses_cw"))
    assert [file.name for file in clips.folder.iterdir()] == ["000000.pt"] and clips.missing() == [1]
    assert DiskClips(tmp_path, 5, 2, CONFIG, {"movers": 1.0}).folder != clips.folder


def test_batches_from_a_position_on(tmp_path):
    clips = DiskClips(tmp_path, 5, 3, CONFIG)
    batches = list(islice(StudyClips(clips, batch=2, start=2).train_dataloader(), 2))
    wanted = [(2, 0), (1, 2)]
    for batch, indices in zip(batches, wanted, strict=True):
        assert torch.equal(batch["images"], torch.stack([clips[index]["images"] for index in indices]))
