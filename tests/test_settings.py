"""Settings: every wrong value is refused with its name."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

import dvo
from dvo.errors import DvoError
from dvo.odometry.config import TRACKER_PRESETS, TrackerConfig
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


@given(st.sampled_from(sorted(TRACKER_PRESETS)), st.integers(1, 500), st.floats(0, 1))
def test_text_and_values_agree(preset, patches, damping):
    found = parse_settings(TrackerConfig, [f"patches={patches}", f" motion_damping = {damping!r}"])
    assert found == {"patches": patches, "motion_damping": damping}


@pytest.mark.parametrize("text", ["patches", "patch=3", "patches=3.5", "patches=", "=3", "motion_damping=fast"])
def test_text_that_is_no_setting(text):
    with pytest.raises(DvoError):
        parse_settings(TrackerConfig, [text])


def test_settings_of_a_file(tmp_path):
    file = tmp_path / "tracker.yaml"
    file.write_text("patches: 48\nupdates: 2\n")
    assert read_settings(TrackerConfig, file) == {"patches": 48, "updates": 2}
    for text, message in (("patch: 3\n", "no setting 'patch'"), ("- 1\n", "table"), ("a: [\n", "YAML")):
        file.write_text(text)
        with pytest.raises(DvoError, match=message) as error:
            read_settings(TrackerConfig, file)
        assert str(file) in str(error.value)
    with pytest.raises(DvoError, match="no such file"):
        read_settings(TrackerConfig, tmp_path / "none.yaml")
