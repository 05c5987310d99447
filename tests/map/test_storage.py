"""Storage of long-lived arrays."""

import gc
import weakref

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dvo.map.storage import ArrayStorage

KINDS = st.sampled_from([np.uint8, np.int16, np.float16, np.float32, np.float64])
ARRAYS = KINDS.flatmap(lambda kind: hnp.arrays(kind, hnp.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=9)))


@pytest.mark.long
@given(st.lists(ARRAYS, max_size=12), st.sampled_from([64, 256, 4096]))
def test_arrays_are_kept_as_they_are(arrays, chunk):
    storage = ArrayStorage(chunk)
    kept = [storage.keep(array) for array in arrays]
    for array, copy in zip(arrays, kept, strict=True):
        assert copy.dtype == array.dtype and copy.flags.c_contiguous
        np.testing.assert_array_equal(copy, array)
    for array, copy in zip(arrays, kept, strict=True):  # none shares memory with another one, or with its original
        copy[...] = 0
        array[...] = 1
    assert not any(copy.any() for copy in kept)


def test_an_array_that_is_not_contiguous_is_copied_in_order():
    array = np.arange(12, dtype=np.float32).reshape(3, 4)[:, ::2].T
    np.testing.assert_array_equal(ArrayStorage().keep(array), array)


def test_a_mapping_is_released_with_its_last_array():
    storage = ArrayStorage(chunk=1024)
    first, second = storage.keep(np.zeros(512, np.uint8)), storage.keep(np.zeros(512, np.uint8))
    base = first
    while isinstance(base, np.ndarray) and base.base is not None:
        base = base.base
    mapping = weakref.ref(base.obj if isinstance(base, memoryview) else base)
    del base
    storage.keep(np.zeros(8, np.uint8))  # begins the next mapping
    del first
    gc.collect()
    assert mapping() is not None
    del second
    gc.collect()
    assert mapping() is None
