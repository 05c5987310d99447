"""Positions in a stream of clips."""

from itertools import islice

from train.data.stream import StreamSampler


def test_processes_share_every_batch():
    whole = list(islice(StreamSampler(8, batch=6), 12))
    parts = [list(islice(StreamSampler(8, 3, processes=2, rank=r), 6)) for r in (0, 1)]
    assert whole == list(range(8, 20))
    assert [parts[0][:3] + parts[1][:3], parts[0][3:] + parts[1][3:]] == [whole[:6], whole[6:]]
