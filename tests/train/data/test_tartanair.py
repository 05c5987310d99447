"""TartanAir's folders, and the configuration that trains on them."""

from pathlib import Path

import pytest
import torch
import yaml

from dvo.core.errors import DvoError
from dvo.data.files.root import data_root
from dvo.synth.export import export_sequence
from dvo.synth.sequence import make_sequence
from train.data.real import RealClips, RealData
from train.data.tartanair import with_trajectories
from train.engine.checkpoint import read_state

CONFIG = Path(__file__).resolve().parents[3] / "configs" / "train" / "tartanair.yaml"
DATA = data_root(required=False)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Two environments with a trajectory each, in the layout of v1."""
    root = tmp_path_factory.mktemp("tartanair")
    for seed, place in enumerate(("hall/hall/Easy/P000", "yard/Hard/P001")):
        sequence = make_sequence(seed, frames=6, height=48, width=64, fps=10, family="room", sensor=False)
        export_sequence(sequence, root / place, "tartanair")
    return root


def test_trajectories_below_a_folder(root, tmp_path):
    both = [str(root / "hall/hall/Easy/P000"), str(root / "yard/Hard/P001")]
    assert with_trajectories([str(root)]) == both
    assert with_trajectories([str(root / "yard"), both[0]]) == [both[1], both[0]]
    assert with_trajectories([str(tmp_path)]) == [str(tmp_path)]  # for the reader to complain about


def test_clips_of_all_trajectories_with_flow_in_the_range(root):
    wide = RealClips(0, RealData([str(root)], hops=[1], flow_low=0.0, flow_high=1e9), 3, 48, 64)
    assert {number for number, _, _ in wide.starts} == {0, 1} and len(wide.starts) == 8
    clip = wide[0]
    assert clip["images"].shape == (3, 3, 48, 64) and clip["depth"].median() > 0.5
    drawn = []
    none = RealClips(0, RealData([str(root)], hops=[1], flow_low=1e6, flow_high=1e9), 3, 48, 64)
    read = none.read
    none.read = lambda *place: drawn.append(place) or read(*place)
    none[0]
    assert torch.isfinite(clip["depth"]).all() and len(drawn) == 8


def test_a_folder_without_recordings_is_told(tmp_path):
    with pytest.raises(DvoError, match=str(tmp_path)):
        RealClips(0, RealData([str(tmp_path)]), 3, 48, 64)


def settings_for(folder, steps=1, **data):
    settings = yaml.safe_load(CONFIG.read_text())
    saver = settings["trainer"]["callbacks"][0]
    saver["init_args"]["every_n_train_steps"] = 1
    settings["trainer"] |= {
        "accelerator": "cpu", "max_steps": steps, "default_root_dir": str(folder), "callbacks": [saver],
        "enable_progress_bar": False, "enable_model_summary": False, "logger": False,
    }  # fmt: skip
    settings["model"] |= {"model": "tiny", "updates": 4, "initial": 3, "settle": 1}
    settings["data"] |= {"workers": 0, **data}
    file = folder / "settings.yaml"
    file.write_text(yaml.safe_dump(settings))
    return file


def test_the_shipped_configuration_trains(root, tmp_path, command):
    """One step with sizes for a test, on the folder above the environments."""
    pytest.importorskip("kornia")
    file = settings_for(tmp_path, frames=4, sizes=[[48, 64]])
    command("fit", "--config", file, "--data.real.folders", root, "--data.real.hops", "[1]")
    state = read_state(tmp_path / "tartanair" / "last.ckpt")
    assert state["global_step"] == 1 and state["Renderings"] == {"clips_seen": 1}
    assert all(torch.isfinite(value).all() for value in state["state_dict"].values() if value.is_floating_point())


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_dir(), reason="set DVO_DATA to the folder of real sequences")
def test_the_shipped_configuration_trains_on_an_excerpt(tmp_path, command):
    """Three steps of the shipped sizes; the excerpt has depth maps of three frames only, so that
    there is no warm-up by the flow loss."""
    pytest.importorskip("kornia")
    place = tmp_path / "data" / "env" / "Easy" / "P000"
    place.parent.mkdir(parents=True)
    place.symlink_to(DATA / "tartanair_v1_60", target_is_directory=True)
    file = settings_for(tmp_path, 3)
    command("fit", "--config", file, "--data.real.folders", tmp_path / "data", "--model.warmup_until", 0)
    assert read_state(tmp_path / "tartanair" / "last.ckpt")["global_step"] == 3
