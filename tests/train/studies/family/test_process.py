"""A process of its own."""

import os
import signal
from pathlib import Path

import pytest

from dvo.core.yaml_files import read_yaml
from train.studies.family.process import apart


@pytest.mark.long
def test_errors_of_a_process_are_printed_by_it(tmp_path, capfd):
    apart(os.mkdir, tmp_path / "made")
    assert (tmp_path / "made").is_dir()
    with pytest.raises(SystemExit) as ended:
        apart(read_yaml, Path("absent.yaml"), "give a file")
    assert ended.value.code == 2
    assert capfd.readouterr().err.startswith("error: absent.yaml: ")


@pytest.mark.long
def test_an_end_by_a_signal_is_told(capfd):
    with pytest.raises(SystemExit) as ended:
        apart(os.abort)
    assert ended.value.code == 1
    assert f"error: signal {int(signal.SIGABRT)} ended abort; run it again to go on" in capfd.readouterr().err
