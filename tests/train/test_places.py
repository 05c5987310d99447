"""Fitting of the descriptor of places: from training families alone, and the same file for the same seed."""

import numpy as np
import pytest

import train.places
from dvo.core.errors import DvoError
from dvo.odometry.loops.place_descriptors import load_descriptor
from dvo.synth.scenes.families import HELD_OUT, SHARES


@pytest.mark.long
def test_the_command_writes_the_same_file_again(tmp_path, monkeypatch):
    families = []
    make = train.places.make_sequence

    def small(seed, family, **options):
        families.append(family)
        return make(seed, family=family, **{**options, "frames": 1, "height": 48, "width": 64})

    assert {*train.places.SHARES} == {*SHARES} and not {*SHARES} & {*HELD_OUT}
    monkeypatch.setattr(train.places, "make_sequence", small)
    monkeypatch.setattr(train.places, "SHARES", ("room", "planes"))
    for name in ("a", "b"):
        train.places.main(["--out", str(tmp_path / name), "--scenes", "1", "--channels", "8"])
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert families == ["room", "planes"] * 2
    fitted = load_descriptor(tmp_path / "a")
    assert fitted.mean.shape == (3, 4, 64) and fitted.projection.shape == (64, 8)
    assert np.isfinite(fitted.mean).all()


def test_no_scenes_are_refused(tmp_path):
    with pytest.raises(DvoError, match="--scenes"):
        train.places.main(["--scenes", "0", "--out", str(tmp_path / "a")])
