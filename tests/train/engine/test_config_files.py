"""Training configurations are checked before LightningCLI loads them."""

import sys

import pytest

from dvo.core.errors import DvoError
from train.__main__ import main
from train.engine.config_files import check_files

LAUGHS = "a0: &a0 [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"a{i}: &a{i} [{','.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 10)
)
BROKEN = {
    "aliases in aliases": (LAUGHS.encode(), "20,000 values"),
    "nested": (b"[" * 100_000, "32 levels"),
    "another encoding": ("task: Zürich".encode("latin-1"), "line 1: not UTF-8 text"),
    "an open bracket": (b"a: [", "line 1: not valid YAML"),
    "a huge number": (b"seed: " + b"9" * 5000, "longer than 100 digits"),
    "an impossible date": (b"name: 2024-13-45", "not a date"),
    "a key twice": (b"task: a\ntask: b", "the key 'task' twice"),
    "a call": (b"!!python/object/apply:os.system [ls]", "python/object/apply"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_configuration_is_one_line_and_code_2(case, tmp_path, monkeypatch, capsys):
    content, message = BROKEN[case]
    file = tmp_path / "broken.yaml"
    file.write_bytes(content)
    monkeypatch.setattr(sys, "argv", ["train", "fit", "--config", str(file)])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith(f"error: {file}: ") and message in line


@pytest.mark.parametrize("option", ["--config={}", "-c {}", "--config {}", "--model {}", "--data={}", "--config a {}"])
def test_files_are_found_on_the_command_line(option, tmp_path):
    file = tmp_path / "broken.yml"
    file.write_text("a: [")
    with pytest.raises(DvoError, match="not valid YAML"):
        check_files(["fit", *option.format(file).split()])


def test_a_configuration_of_any_name_and_other_files(tmp_path):
    (tmp_path / "settings").write_text("a: [")
    with pytest.raises(DvoError, match="not valid YAML"):
        check_files(["fit", f"--config={tmp_path / 'settings'}"])
    check_files(["fit", "--ckpt_path", str(tmp_path / "settings"), "--config", "none.yaml", "--config"])
    check_files(["--x=" + "y" * 10_000])
