"""Release of free memory of the heap, and its times."""

import os
import platform
from pathlib import Path

import numpy as np
import pytest
import torch

from dvo.map import keyframe_graph
from dvo.map.heap import release_free_memory
from dvo.map.keyframe_graph import RELEASE_INTERVAL, KeyframeGraph
from dvo.map.window import Keyframe

BLOCK = 2**16  # bytes: below the size from which an array gets a mapping of its own


def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs glibc")
def test_pages_between_memory_in_use_are_returned():
    blocks = [np.ones(BLOCK, np.uint8) for _ in range(400)]
    kept = blocks[1::2]
    before = resident()
    del blocks  # every other one is free, and none of them is at the end of the heap
    assert resident() > before - 50 * BLOCK
    release_free_memory()
    assert resident() < before - 150 * BLOCK
    assert all((block == 1).all() for block in kept)


def test_memory_is_released_after_a_number_of_frames_kept_or_dropped(monkeypatch):
    calls = []
    monkeypatch.setattr(keyframe_graph, "release_free_memory", lambda: calls.append(len(graph.archive)))
    graph, m = KeyframeGraph(2, 3, 5, torch.device("cpu")), 2
    pose, patches = torch.tensor([0, 0, 0, 0, 0, 0, 1.0]), torch.ones(m, 3, 3, 3)
    features = torch.zeros(m, 4, 3, 3), torch.zeros(m, 5), torch.zeros(m, 3, dtype=torch.uint8), torch.ones(4)
    for number in range(3 * RELEASE_INTERVAL):
        graph.window.append(Keyframe(number, 0.1 * number, 0, *features), pose, patches)
        if number % 3 == 1:
            graph.drop(1)
        elif len(graph.window) > 1:
            graph.archive_oldest()
    assert calls == [RELEASE_INTERVAL, 2 * RELEASE_INTERVAL]
