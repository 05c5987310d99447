"""Settings: every wrong value is refused with its name."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

import dvo
from dvo.errors import DvoError
from dvo.odometry.config import TrackerConfig
from dvo.settings import parse_settings, read_settings


@pytest.mark.parametrize(
    "name, value",
    [("patches", -3), ("patches", 0), ("patches", 2.5), ("patches", True), ("patches", "many"), ("pixels", -1),
     ("lifetime", 0), ("optimisation", 0), ("initial_frames", 1), ("updates", 0), ("keyframe_index", 1),
     ("motion_damping", 1.5), ("motion_damping", float("nan")), ("lost_confidence", -0.1), ("initial_motion", None),
     ("keyframe_motion", float("inf"))],
)  # fmt: skip
def test_a_value_out_of_range_is_refused_by_name(name, value):
    with pytest.raises(DvoError, match=name):
        TrackerConfig(**{name: value})
    with pytest.raises(DvoError, match=name):
        dvo.load("small", **{name: value})


@given(st.integers(1, 500), st.floats(0, 1, allow_subnormal=False))
def test_text_and_values_agree(patches, damping):
    found = parse_settings([f"patches={patches}", f" motion_damping = {damping:.6f}"])
    assert found == {"patches": patches, "motion_damping": pytest.approx(damping, abs=1e-6)}
    assert TrackerConfig.from_dict(found).patches == patches


@pytest.mark.parametrize("text", ["patches", "patches=", "=3", "a b=3", "a=[", "", "a=2026-13-45", "a=" + "9" * 5000])
def test_text_that_is_no_setting(text):
    with pytest.raises(DvoError, match="NAME=VALUE"):
        parse_settings([text])


@pytest.mark.parametrize("text", ["patch=3", "patches=3.5", "motion_damping=fast"])
def test_settings_that_the_tracker_has_not(text):
    with pytest.raises(DvoError, match=text.split("=")[0]):
        dvo.load("small", **parse_settings([text]))


def test_settings_of_a_file(tmp_path):
    file = tmp_path / "tracker.yaml"
    file.write_text("patches: 48\nupdates: 2\n")
    assert read_settings(file) == {"patches": 48, "updates": 2}
    for text, message in (("- 1\n", "table"), ("a: [\n", "YAML"), ("3: 4\n", "table"), ("a: " + "9" * 5000, "YAML")):
        file.write_text(text)
        with pytest.raises(DvoError, match=message) as error:
            read_settings(file)
        assert str(file) in str(error.value)
    with pytest.raises(DvoError, match="no such file"):
        read_settings(tmp_path / "none.yaml")
