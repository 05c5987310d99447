"""Specifications of sequences and clips."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import yaml

from dvo.errors import DvoError
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
