"""Memory that a tracker holds, against the keyframes that it keeps."""

import gc
import mmap
import types
from dataclasses import replace

import numpy as np
import pytest
import torch

import dvo
from dvo.synth.sequence import make_sequence

THERE = 32
SHORT = {"keyframe_motion": 0.5, "removal": 5, "lifetime": 4, "optimisation": 5}  # keyframes leave the window soon
BOUND = 150_000  # bytes a keyframe


def owner(array):
    """Object that owns the memory of an array, and its size."""
    while isinstance(array, np.ndarray) and array.base is not None:
        array = array.base
    if isinstance(array, torch.Tensor):
        return array.untyped_storage().data_ptr(), array.untyped_storage().nbytes()
    if isinstance(array, memoryview):
        return id(array.obj), len(array.obj)
    return id(array), array.nbytes if isinstance(array, np.ndarray) else len(array)


def held_bytes(root):
    """Memory of all tensors and arrays that an object refers to, each storage once and as a whole."""
    skipped = type, types.ModuleType, types.FunctionType, types.BuiltinFunctionType
    seen, found, waiting = set(), {}, [root]
    while waiting:
        thing = waiting.pop()
        if id(thing) in seen or isinstance(thing, skipped):
            continue
        seen.add(id(thing))
        if isinstance(thing, torch.Tensor | np.ndarray | mmap.mmap):
            key, size = owner(thing)
            found[key] = size
        elif gc.is_tracked(thing):
            waiting += gc.get_referents(thing)
    return sum(found.values())


@pytest.mark.parametrize("keep", [0, 2**20])
def test_storages_are_found_once_and_as_a_whole(keep):
    class Holder:
        pass

    holder, tensor = Holder(), torch.zeros(1000)
    holder.parts = [{"a": tensor[:10], "b": (tensor[3],)}, np.ones(80, np.uint8)[::2], tensor.numpy()[5:]]
    if keep:
        holder.parts.append(np.zeros(keep, np.uint8)[:1])
    assert held_bytes(holder) == 4000 + 80 + keep


@pytest.mark.slow
def test_a_keyframe_takes_less_than_its_share_of_memory():
    walk = make_sequence(
        63, frames=THERE, family="room", kind="handheld", speed=5.0, height=120, width=160, fps=15.0, sensor=False
    )
    clip, order = list(walk), [*range(THERE), *range(THERE - 2, -1, -1)]
    odometry = dvo.load("small", device="cpu", loop={"seconds": 1.0, "every": 2, "steps": 4, "delay": 4}, **SHORT)
    held = {}
    for number, index in enumerate(order):
        odometry.track(replace(clip[index], timestamp=number / 15.0))
        kept = odometry.graph.log.keyframes
        if kept not in held:
            odometry.loops.drain()  # what a search needs meanwhile is not kept
            held[kept] = held_bytes(odometry)
    first, last = 6, max(held)
    assert last > 2 * first
    assert len(odometry.loops.finder.matcher.maps) == 0
    growth = (held[last] - held[first]) / (last - first)
    assert 20_000 < growth < BOUND
