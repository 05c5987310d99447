"""The garbage collector during a run."""

import gc
import weakref

import pytest

from dvo.core.allocator import without_old_garbage


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
