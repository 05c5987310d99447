"""Time of a training step by part."""

from train.studies import breakdown


def test_the_breakdown_names_where_the_time_goes(runs):
    seconds = breakdown.measure(runs.module(), runs.data().clips(), 1, steps=1, warm=0)
    parts = [name for name, _, _ in (*breakdown.FORWARD, *breakdown.LOSS, *breakdown.BACKWARD)]
    assert all(seconds[name] > 0 for name in parts)
    assert seconds["forward and loss"] + seconds["backward"] <= seconds["step"]
    inner = sum(seconds[name] for name, _, _ in (*breakdown.FORWARD, *breakdown.LOSS))
    assert inner <= seconds["forward and loss"]
    assert "bundle adjustment, backward" in breakdown.table(seconds)
