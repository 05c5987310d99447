"""The garbage collector during a run, and free memory of the heap."""

import gc
import os
import platform
import weakref
from pathlib import Path

import numpy as np
import pytest

from dvo.core.allocator import release_free_memory, without_old_garbage

BLOCK = 2**16  # bytes: below the size from which an array gets a mapping of its own


class Node:
    """Object that can be part of a circle."""


def circle():
    node = Node()
    node.itself = node
    return weakref.ref(node)


def test_what_was_there_before_is_left_alone_for_the_time_of_a_run():
    gc.collect()
    before = circle()
    with pytest.raises(ValueError, match="a run"), without_old_garbage():
        within = circle()
        gc.collect()
        assert before() is not None and within() is None
        raise ValueError("a run that fails")
    gc.collect()
    assert before() is None and gc.get_freeze_count() == 0


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
