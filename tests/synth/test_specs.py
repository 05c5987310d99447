"""Specifications of sequences and clips."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import yaml

from dvo.core.errors import DvoError
from dvo.synth import CameraSpec, MotionSpec, SceneSpec, SequenceFormat, SequenceSpec, make_sequence, sequence_spec
from dvo.synth.clip import ClipSpec, make_clip

AXES = Path(__file__).parents[2] / "configs" / "eval" / "axes.yaml"


def test_flat_names_are_sorted_into_their_specifications() -> None:
    spec = sequence_spec(frames=20, fps=10.0, family="street", movers=2, kind="forward", shake=2.0, shutter=0.5, jpeg=9)
    assert spec == SequenceSpec(
        SequenceFormat(20, fps=10.0), SceneSpec("street", movers=2), MotionSpec("forward", shake=2.0),
        CameraSpec(shutter=0.5, jpeg=9),
    )  # fmt: skip
    assert sequence_spec(spec, family="room").format == spec.format
    assert sequence_spec() == SequenceSpec()


def test_flat_names_are_unique() -> None:
    names = [option.name for part in fields(SequenceSpec) for option in fields(getattr(SequenceSpec(), part.name))]
    assert len(names) == len(set(names)) and "seed" not in names and "device" not in names


def test_options_of_the_rendered_suites_are_known() -> None:
    table = yaml.safe_load(AXES.read_text(encoding="utf-8"))
    for axis in table["axes"].values():
        sequence_spec(**table["common"], **axis["options"])


@pytest.mark.long
def test_specification_and_flat_options_give_the_same_bytes() -> None:
    spec = SequenceSpec(SequenceFormat(3, 32, 48, 10.0), SceneSpec("room", texture=0.5), MotionSpec("fast"))
    flat = make_sequence(2, frames=3, height=32, width=48, fps=10.0, family="room", texture=0.5, kind="fast")
    assert np.array_equal(make_sequence(2, spec).frame(1).image, flat.frame(1).image)


def test_unknown_names() -> None:
    with pytest.raises(DvoError, match="'shuter'.*[Uu]se one of .*shutter"):
        make_sequence(0, shuter=0.5)
    with pytest.raises(DvoError, match="'flow'.*[Uu]se one of .*flow_range"):
        make_clip(0, 0, flow=(1.0, 2.0))
    assert ClipSpec(frames=4).frames == 4


@pytest.mark.parametrize(
    ("options", "message"),
    [({"frames": 10**9}, "frames: out of range: 1000000000. Give a whole number from 1 to 100000"),
     ({"frames": 0}, "frames: out of range"), ({"frames": 2.5}, "frames: out of range"),
     ({"frames": True}, "frames: out of range"), ({"frames": "many"}, "frames: out of range: 'many'"),
     ({"width": 100_000}, "width: out of range"), ({"height": 100_000}, "height: out of range"),
     ({"width": 8192, "height": 8192}, "height, width: too large: 67,108,864 rays"),
     ({"supersample": 100}, "supersample: out of range"), ({"supersample": 16, "width": 1000}, "too large"),
     ({"frames": 100_000, "fps": 0.01}, "frames, fps: too long: 10,000,000 s"), ({"fps": 1e-300}, "fps: out of range"),
     ({"fps": float("nan")}, "fps: out of range: nan"), ({"fps": float("inf")}, "fps: out of range: inf"),
     ({"movers": 10**9}, "movers: out of range"), ({"movers": -1}, "movers: out of range"),
     ({"speed": float("nan")}, "speed: out of range"), ({"speed": 1e300}, "speed: out of range"),
     ({"shake": -1.0}, "shake: out of range"), ({"lighting": 1e9}, "lighting: out of range"),
     ({"texture": float("nan")}, "texture: not a share"), ({"texture": "bare"}, "texture: not a share"),
     ({"jpeg": 101}, "jpeg: out of range"), ({"blackout": float("inf")}, "blackout: out of range")],
)  # fmt: skip
def test_numbers_beyond_any_use(options: dict[str, float], message: str) -> None:
    with pytest.raises(DvoError, match=message):
        make_sequence(0, **options)


def test_whole_numbers_of_numpy_are_whole_numbers() -> None:
    assert sequence_spec(frames=np.int64(4), width=np.int32(64)).format.frames == 4
