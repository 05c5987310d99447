"""Arguments of the public functions that are of another type: one error, with the name of the argument."""

from __future__ import annotations

import inspect
import io

import cv2
import numpy as np
import pytest
import torch

import dvo
from dvo.core.arguments import checked_arguments, checked_device
from dvo.core.errors import DvoError
from dvo.odometry.load import build_odometry
from dvo.odometry.merging import merge_maps
from tests.support.tiny_members import SETTINGS, frames, network

CAMERA = dvo.Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
IMAGES = [np.zeros((48, 64, 3), np.uint8)] * 3
PNG = cv2.imencode(".png", IMAGES[0])[1].tobytes()
LINE = dvo.Trajectory(np.arange(5.0), np.c_[np.arange(5.0), np.zeros((5, 5)), np.ones(5)])


class Unknown:
    """Of no use for any argument."""


WRONG = [None, Unknown(), b"bytes", -1.5, 10**30, [Unknown()], {"a": 1}, "\0"]


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    """A finished odometry, and the folder with its map."""
    odometry = build_odometry(network("patch_vo"), seed=1, **SETTINGS["patch_vo"])
    for frame in frames(0):
        odometry.track(frame)
    odometry.finish()
    folder = tmp_path_factory.mktemp("arguments")
    odometry.save(folder / "map.dvo")
    return odometry, folder


def given(name, mapped, image_folder, fake_odometry):
    """The function of a name, and arguments that it takes."""
    odometry, folder = mapped
    pose = torch.tensor([0, 0, 0, 0, 0, 0, 1.0])
    edges = torch.zeros(5, dtype=torch.long), torch.ones(5, dtype=torch.long), torch.arange(5)
    problem = {
        "poses_cw": pose.repeat(1, 2, 1), "patches": torch.ones(1, 5, 3, 1, 1), "weights": torch.ones(1, 5, 2),
        "intrinsics": torch.tensor([50.0, 50, 32, 24]).repeat(1, 2, 1), "targets": torch.ones(1, 5, 2),
        **dict(zip(("ii", "jj", "kk"), edges, strict=True)),
    }  # fmt: skip
    seen = [dvo.Frame(i, 0.1 * i, image, CAMERA) for i, image in enumerate(IMAGES)]
    return {
        "load": (dvo.load, {"weights": "klt-pnp"}),
        "build_odometry": (build_odometry, {"weights": network("patch_vo")}),
        "load_model": (dvo.load_model, {}),
        "load_map": (dvo.load_map, {"file": folder / "map.dvo", "weights": network("patch_vo")}),
        "merge_maps": (merge_maps, {"first": folder / "map.dvo", "second": folder / "map.dvo"}),
        "open": (dvo.open, {"source": image_folder, "calib": image_folder.parent / "calib.txt", "fps": 10}),
        "stream": (dvo.stream, {"images": IMAGES, "camera": CAMERA, "fps": 10}),
        "open_stream": (dvo.open_stream, {"source": lambda: io.BytesIO(PNG)}),
        "LiveFrames": (dvo.LiveFrames, {"frames": [1, 2]}),
        "run": (dvo.run, {"odometry": fake_odometry(), "source": seen}),
        "calibrate": (dvo.calibrate, {"frames": seen}),
        "export_map": (dvo.export_map, {"source": odometry, "folder": image_folder / "new"}),
        "export_trajectory": (dvo.export_trajectory, {"trajectory": LINE, "folder": image_folder / "new"}),
        "evaluate": (dvo.evaluate, {"estimate": LINE, "reference": LINE}),
        "base_trajectory": (dvo.base_trajectory, {"trajectory": LINE, "T_base_camera": np.eye(4)}),
        "bundle_adjust": (dvo.bundle_adjust, problem),
        "save": (odometry.save, {"file": folder / "other.dvo"}),
    }[name]  # fmt: skip


NAMES = (
    "load", "build_odometry", "load_model", "load_map", "merge_maps", "open", "stream", "open_stream", "LiveFrames",
    "run", "calibrate", "export_map", "export_trajectory", "evaluate", "base_trajectory", "bundle_adjust", "save",
)  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_another_type_is_one_error(name, mapped, image_folder, fake_odometry):
    """Never a TypeError or an AttributeError from within; None is taken where the annotation says so."""
    function, base = given(name, mapped, image_folder, fake_odometry)
    for parameter in inspect.signature(function).parameters.values():
        if parameter.kind is parameter.VAR_KEYWORD:
            continue
        for value in WRONG:
            takes_none = any(part in parameter.annotation for part in ("None", "Any"))
            arguments = {**base, parameter.name: value}
            if callable(arguments.get("source")):  # a new pipe for each
                arguments["source"] = arguments["source"]()
            try:
                function(**arguments)
                assert value is not None or takes_none, f"{parameter.name}=None is not documented"
            except DvoError as error:
                if value is None:
                    assert parameter.name in str(error), f"{parameter.name}: {error}"


@pytest.mark.parametrize("device", ["meta", torch.device("meta"), None, "unknown", "cuda:77", "", 0, b"cpu", ["cpu"]])
@pytest.mark.parametrize("name", ["load", "build_odometry", "load_model", "load_map", "merge_maps", "calibrate"])
def test_a_device_without_values_is_one_error(name, device, mapped, image_folder, fake_odometry):
    function, base = given(name, mapped, image_folder, fake_odometry)
    with pytest.raises(DvoError, match="^device: .*cpu"):
        function(**{**base, "device": device})


def test_devices():
    assert checked_device("cpu") == checked_device(torch.device("cpu")) == torch.device("cpu")


@pytest.mark.parametrize("name", ["patch_vo", "droid", "tartanvo", "deepvo"])
@pytest.mark.parametrize("config", ["default", {}, [], 1, Unknown(), dvo.BAOptions()])
def test_settings_of_another_kind_are_one_error(name, config):
    with pytest.raises(DvoError, match="^config: "):
        build_odometry(network(name), config=config)


def test_a_decorated_function():
    @checked_arguments
    def function(text: str, number: float = 1.0, *more: int, flag: bool = False, other: Unknown | None = None) -> str:
        """Words."""
        return f"{text} {number} {more} {flag} {other is None}"

    assert function.__doc__ == "Words." and list(inspect.signature(function).parameters)[0] == "text"
    assert function("a") == "a 1.0 () False True"
    assert function("a", np.float32(2), 3, flag=np.bool_(True), other=Unknown()) == "a 2.0 (3,) True False"
    for wrong in ({"number": True}, {"number": "1"}, {"flag": 1}, {"other": 1}, {"flag": None}):
        with pytest.raises(DvoError, match=f"^{next(iter(wrong))}: must be .*, got"):
            function("a", **wrong)
    with pytest.raises(TypeError, match="missing.*text"):
        function()
    with pytest.raises(TypeError, match="unexpected keyword"):
        function("a", unknown=1)
