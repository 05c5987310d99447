"""Frames that hang on keyframes, keyframes that go, and what comes out at the end."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.geometry import se3
from dvo.odometry.chronicle import Chronicle


def poses(seed: int, count: int) -> np.ndarray:
    generator = torch.Generator().manual_seed(seed)
    return se3.exp(torch.randn(count, 6, generator=generator, dtype=torch.float64)).numpy()


@settings(max_examples=20)
@given(st.integers(0, 1000))
def test_rehanging_keeps_every_frame_in_place(seed):
    """Three keyframes; the middle one goes twice over, and its frames stay where they were."""
    at = poses(seed, 3)
    kept, thinned = Chronicle(), Chronicle()
    for book in (kept, thinned):
        for time, anchor in ((0.0, 0), (0.1, 1), (0.2, 1), (0.3, 2)):
            book.add(time, anchor)
    for number in range(3):
        kept.settle(number, at[number])
    relative = [se3.relative(torch.from_numpy(at[i]), torch.from_numpy(at[i + 1])).numpy() for i in (0, 1)]
    thinned.rehang(2, 1, relative[1], oldest=0)
    thinned.rehang(1, 0, relative[0], oldest=0)
    thinned.settle(0, at[0])
    a, b = kept.trajectory(), thinned.trajectory()
    assert a.timestamps.tolist() == b.timestamps.tolist() == [0.0, 0.1, 0.2, 0.3]
    same = se3.log(se3.compose(torch.from_numpy(a.poses_wc), se3.inverse(torch.from_numpy(b.poses_wc))))
    assert same.abs().max() < 1e-9 and thinned.keyframes == 1


def test_lost_frames_and_those_without_a_keyframe_have_no_row():
    book = Chronicle()
    for time in (0.0, 0.1, 0.2):
        book.add(time, 0)
    book.frames[1].lost = True
    book.add(0.3, 7)
    assert len(book.trajectory()) == 0
    book.settle(0, np.array([0.0, 0, 0, 0, 0, 0, 1]))
    assert book.trajectory().timestamps.tolist() == [0.0, 0.2]


def test_an_empty_chronicle():
    assert len(Chronicle().trajectory()) == 0 and Chronicle().map().points.shape == (0, 3)
