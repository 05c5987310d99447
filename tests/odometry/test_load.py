"""``dvo.load``: the odometry of an architecture, its settings and its name."""

import sys
from dataclasses import replace
from types import ModuleType

import pytest

import dvo
from dvo.core.errors import DvoError
from dvo.metrics import evaluate
from dvo.models.patch_vo import PatchVO
from dvo.models.registry import ARCHITECTURES, network_class
from dvo.models.weights import LoadedWeights
from dvo.nets.patch.config import ModelConfig, preset
from dvo.odometry.load import build_odometry
from dvo.odometry.patch.config import PRESETS, TRACKER_PRESETS, TrackerConfig
from dvo.odometry.patch.tracker import PatchOdometry
from dvo.odometry.registry import ODOMETRIES, SYSTEMS, build_system, odometry_builder
from dvo.synth.sequence import make_sequence


def test_shipped_weights_give_the_tracker_with_the_settings_of_their_preset():
    odometry = dvo.load("small", seed=3, patches=16)
    assert isinstance(odometry, PatchOdometry) and odometry.name == "dvo-small" and odometry.seed == 3
    assert odometry.config == TrackerConfig.from_dict({**TRACKER_PRESETS["small"].__dict__, "patches": 16})
    given = TrackerConfig(updates=2)
    assert dvo.load("small", config=given).config == given
    assert not odometry.model.training


def test_presets_change_the_settings_of_the_weights_and_single_settings_win():
    fast = dvo.load("small", preset="fast", patches=20).config
    assert (fast.pixels, fast.patches) == (PRESETS["fast"]["pixels"], 20)
    assert dvo.load("small", preset="default").config == TRACKER_PRESETS["small"]
    assert dvo.load("small", preset="accurate").config.updates == 2
    for name in ("slow", 3, None):
        with pytest.raises(DvoError, match="preset: unknown preset.*default, fast, accurate"):
            dvo.load("small", preset=name)


def test_a_network_in_memory():
    full = LoadedWeights.of(PatchVO(preset("tiny")), "mine")
    assert (full.architecture, full.preset, full.info) == ("patch_vo", "tiny", None)
    assert build_odometry(full).config == TRACKER_PRESETS["tiny"]
    custom = LoadedWeights.of(PatchVO(ModelConfig.from_dict({**preset("tiny").to_dict(), "radius": 2})), "mine")
    assert custom.preset == "custom" and build_odometry(custom).config == TrackerConfig()


@pytest.mark.parametrize("seed", [-1, 2**63, 1.5, True, "3", None])
def test_what_is_no_seed_is_refused(seed):
    with pytest.raises(DvoError, match="seed: not a seed"):
        dvo.load("small", seed=seed)


def test_the_largest_seed_is_one():
    assert dvo.load("small", seed=2**63 - 1).seed == 2**63 - 1


def test_unknown_settings_and_architectures_are_named():
    with pytest.raises(DvoError, match="colour"):
        dvo.load("small", colour=1)
    with pytest.raises(DvoError, match="no odometry.*'none'.*patch_vo"):
        odometry_builder("none")
    assert set(ODOMETRIES) == set(ARCHITECTURES)


@pytest.mark.parametrize("architecture", ["patch_vo", "deepvo", "tartanvo", "droid"])
def test_presets_and_single_settings_of_every_odometry(architecture):
    network = network_class(architecture)
    weights = LoadedWeights.of(network(network.presets["tiny"]), "tiny")
    given = replace(build_odometry(weights).config, max_gap=9.0)
    changed = build_odometry(weights, config=given, preset="accurate", max_gap=8.0).config
    assert changed.max_gap == 8.0 and given.max_gap == 9.0 and changed.pixels == 448 * 336
    assert build_odometry(weights, config=given).config == given
    with pytest.raises(DvoError, match="^preset: unknown preset 'slow'.*default, fast, accurate"):
        build_odometry(weights, preset="slow")
    with pytest.raises(DvoError, match="^colour: unknown setting"):
        build_odometry(weights, colour=1)
    with pytest.raises(DvoError, match="^max_gap: "):
        build_odometry(weights, max_gap=0.5)


def test_shipped_weights_win_over_a_system_of_their_name():
    SYSTEMS.register("small", "spare_package:Spare")
    try:
        assert isinstance(dvo.load("small"), PatchOdometry)
    finally:
        SYSTEMS.unregister("small")


@pytest.mark.long
def test_odometries_without_weights_are_loaded_by_name():
    sequence = make_sequence(4, frames=16, family="room", kind="sideways", height=120, width=160, fps=15.0)
    for name in ("keyframe", "klt-pnp", "direct", "monoslam", "msckf"):
        assert name in SYSTEMS and dvo.load(name).name == name
    result = dvo.run(dvo.load("keyframe", seed=2, corners=300), sequence).result
    assert len(result.trajectory) == 16
    assert evaluate(result.trajectory, sequence.groundtruth).ate_percent < 5
    with pytest.raises(DvoError, match="keyframe_points.*nonsense|nonsense.*keyframe_points"):
        dvo.load("keyframe", nonsense=3)
    with pytest.raises(DvoError, match="corners: must be a whole number"):
        dvo.load("klt-pnp", corners="many")
    with pytest.raises(DvoError, match="seed"):
        dvo.load("direct", seed=-1)


def test_a_system_of_another_package_takes_the_settings_that_it_names(monkeypatch):
    module = ModuleType("spare_package")
    module.Spare = Spare
    monkeypatch.setitem(sys.modules, "spare_package", module)
    SYSTEMS.register("spare", "spare_package:Spare")
    try:
        assert build_system("spare", 1, {"size": 3}).size == 3
        with pytest.raises(DvoError, match="colour: unknown setting of spare"):
            build_system("spare", 1, {"colour": 3})
    finally:
        SYSTEMS.unregister("spare")


class Spare:
    """Odometry that takes no seed."""

    name = "spare"

    def __init__(self, size=1):
        self.size = size


@pytest.mark.parametrize("sensors", [3, None, [["imu"]], {"imu": 1}])
def test_sensors_are_a_list_of_names(sensors):
    with pytest.raises(DvoError, match="sensors: not a list of names"):
        TrackerConfig(sensors=sensors)
