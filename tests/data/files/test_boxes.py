"""Boxes of containers, from bytes and from a file."""

import io
import struct

from hypothesis import given
from hypothesis import strategies as st

from dvo.data.files.boxes import boxes, read_head

contents = st.lists(st.tuples(st.sampled_from([b"moov", b"free", b"mdat"]), st.binary(max_size=40)), max_size=6)


@given(contents, st.booleans())
def test_what_is_written_is_read(parts, is_long):
    """A length of 64 bits is that of files alone."""
    short = b"".join(struct.pack(">I4s", len(data) + 8, kind) + data for kind, data in parts)
    assert list(boxes(short)) == parts
    file = b"".join(struct.pack(">I4sQ", 1, kind, len(data) + 16) + data for kind, data in parts) if is_long else short
    found, at = [], 0
    while at + 8 <= len(file):
        kind, head, length = read_head(io.BytesIO(file), at, len(file))
        found.append((kind, file[at + head : at + length]))
        at += length
    assert found == parts


def test_lengths_that_lead_nowhere():
    assert list(boxes(struct.pack(">I4s", 7, b"moov") + b"abc")) == []
    assert list(boxes(struct.pack(">I4s", 99, b"moov"))) == []
    assert read_head(io.BytesIO(struct.pack(">I4s", 99, b"moov")), 0, 8) is None
    assert read_head(io.BytesIO(struct.pack(">I4s", 0, b"moov")), 0, 8) == (b"moov", 8, 8)
