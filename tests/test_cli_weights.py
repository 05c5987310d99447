"""Wrong and malicious weights on the command line: one line, exit code 2, no code run."""

import pickle
from pathlib import Path

import pytest
import torch

from dvo.cli import main


class Malicious:
    def __reduce__(self):
        return (print, ("executed",))


def refused(command: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert main(command) == 2
    said = capsys.readouterr()
    assert "executed" not in said.out + said.err
    (line,) = said.err.strip().splitlines()
    assert "error: " in line and "Traceback" not in line
    return line


@pytest.mark.parametrize("kind", ["absent", "noise", "pickle"])
def test_run_refuses_weights_that_are_none(kind, image_folder: Path, tmp_path, capsys):
    weights = tmp_path / "w.safetensors"
    if kind == "noise":
        weights.write_bytes(b"\x07" * 200)
    elif kind == "pickle":
        weights.write_bytes(pickle.dumps(Malicious()))
    out = tmp_path / "never"
    # ``image_folder`` is the clip or its images; both hold what is needed beside the weights.
    clip = image_folder if image_folder.name == "images" else image_folder / "images"
    command = ["run", str(clip), "--calib", str(clip.parent / "calib.txt"), "--times", str(clip.parent / "times.txt")]
    line = refused([*command, "--weights", str(weights), "--device", "cpu", "--out", str(out)], capsys)
    assert str(weights) in line
    assert not out.exists()


def test_import_refuses_a_malicious_checkpoint(tmp_path, capsys):
    file = tmp_path / "dpvo.pth"
    torch.save({"module.update.norm.weight": Malicious()}, file)
    assert str(file) in refused(["weights", "import", str(file)], capsys)


def test_info_of_the_shipped_weights(capsys):
    assert main(["weights", "info", "small"]) == 0
    assert "small" in capsys.readouterr().out
