"""Nothing that the commands print or write holds a password, and nothing that they print steers the terminal."""

from __future__ import annotations

import json
import unicodedata
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import save_file

import dvo
from dvo.cli import main
from tests.support.command_line import arguments, summary
from tests.support.stand_in_camera import StandInCamera

ADDRESSES = [
    "rtmp://admin:Xq9@ss/w0rd@host/live", "ftp://admin:Xq9@host/clip.mp4", "rtps://admin:Xq9/@host",
    " rtsp://admin:Xq9@host", "http:/admin:Xq9@host/?token=Xq9", "file://host/clip.mp4?access_token=Xq9",
    "admin:Xq9@host/live",
]  # fmt: skip
HOSTILE = "a\x1b]0;owned\x07\u202e\u200b\x9bb"
ESCAPED = r"a\x1b]0;owned\x07\u202e\u200b\x9bb"


class Camera(StandInCamera):
    """Sends twelve images."""

    def grab(self):
        return super().grab() and self.index < 12

    def retrieve(self):
        return True, np.full((48, 64, 3), 20 * self.index, np.uint8)


def is_clean(text: str) -> bool:
    """Without characters that steer a terminal; line feeds and what the progress bar writes aside."""
    return not any(unicodedata.category(c) in ("Cc", "Cf") and c != "\n" for c in text)


@pytest.mark.long
@pytest.mark.parametrize("address", ADDRESSES)
def test_errors_hold_no_password(address, image_folder, tmp_path, capsys):
    lines = [
        ["run", address], ["calibrate", address], ["summary", address], ["export", address, "x", "--to", "tum"],
        ["merge", address, address, "--out", "x"], ["weights", "info", address], ["weights", "import", address],
        ["synth", "export", "--mesh", address, "--out", str(tmp_path / "mesh")], ["demo", "--weights", address],
        ["run", address, address], ["run", str(image_folder), "--calib", address], ["demo", "--device", address],
        [*arguments(image_folder, tmp_path / "out"), "--groundtruth", address], ["demo", "--set", address],
        [*arguments(image_folder, tmp_path / "out"), "--mask", address], ["run", "x", "--stride", address],
    ]  # fmt: skip
    for line in lines:
        assert main(line) == 2, line
        said = capsys.readouterr()
        assert "Xq9" not in said.out + said.err and "w0rd" not in said.err, line


def test_opencv_that_quotes_the_address(monkeypatch, capsys):
    def refuse(*arguments):
        raise cv2.error(f"OpenCV(4): can't open stream {arguments[0]}\n> in function 'open'")

    monkeypatch.setattr(cv2, "VideoCapture", refuse)
    assert main(["run", "rtsp://admin:Xq9@ss/word@host/live"]) == 2
    said = capsys.readouterr().err
    assert "Xq9" not in said and "can't open stream rtsp://host/live" in said
    with pytest.raises(dvo.DvoError) as raised:
        dvo.open("rtsp://admin:Xq9@ss/word@host/live")
    assert raised.value.__suppress_context__


def test_files_of_a_stream_hold_no_password(given, monkeypatch, tmp_path, capsys):
    """run.json, the page, the name of the folder, the printed report and warnings of what fails on the way."""

    def fail():
        raise OSError("cannot read rtsp://admin:Xq9@host: refused")

    given(at_frame={9: fail})
    monkeypatch.setattr(cv2, "VideoCapture", Camera)
    monkeypatch.chdir(tmp_path)
    address = "rtsp://admin:Xq9@w0rd/x@host:554/live?channel=1&token=Xq9"
    assert main(["run", address, "--device", "cpu", "--weights", address, "--queue", "0"]) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    assert summary(folder)["source"] == "rtsp://host:554/live?channel=1&token=***"
    assert "cannot read rtsp://host: refused" in summary(folder)["warnings"][-1]
    assert main(["summary", str(folder)]) == 0
    said = capsys.readouterr()
    texts = [said.out, said.err, str(folder), repr(dvo.open(address))]
    texts += [file.read_bytes().decode("latin-1") for file in folder.iterdir()]
    assert not any(secret in text for text in texts for secret in ("Xq9", "w0rd", "admin"))


@pytest.mark.long
def test_names_of_files_and_arguments_are_escaped(given, image_folder, tmp_path, monkeypatch, capsys):
    given()
    folder = tmp_path / f"{HOSTILE}\n\rdvo: forged"
    image_folder.rename(folder)
    monkeypatch.chdir(tmp_path)
    lines = {
        2: [["run", HOSTILE], ["run", HOSTILE, HOSTILE], ["weights", "info", HOSTILE],
            ["run", str(folder), "--stride", HOSTILE], ["run", "x", f"--{HOSTILE}"],
            ["summary", HOSTILE], ["synth", "preview", HOSTILE, "--out", "x.png"], ["demo", "--device", HOSTILE],
            ["run", str(folder), "--calib", HOSTILE], [HOSTILE]],
        0: [["run", str(folder), "--device", "cpu", "--calib", str(tmp_path / "clip" / "calib.txt"), "--fps", "10"],
            ["run", str(folder), "--device", "cpu", "--fps", "10", "--out", f"{HOSTILE}\nout"]],
    }  # fmt: skip
    for code, commands in lines.items():
        for line in commands:
            assert main(line) == code, line
            said = capsys.readouterr()
            assert is_clean(said.out) and is_clean(said.err), line
            assert not any(text.startswith("dvo: forged") for text in said.out.splitlines())
            assert code == 0 or ESCAPED in said.err or repr(HOSTILE)[1:-1] in said.err, said.err


def test_contents_of_files_are_escaped(image_folder, tmp_path, capsys):
    (tmp_path / "settings.yaml").write_text('"a\\e]0;owned\\a\\u202eb": 1\n')
    (tmp_path / "calib.yaml").write_text('"a\\e]0;owned\\a\\u202eb": 1\n')
    (tmp_path / "calib.txt").write_text(f"50 50 {HOSTILE} 1\n")
    (tmp_path / "truth.txt").write_text(f"1 2 3 4 5 6 7 {HOSTILE}\n")
    (tmp_path / "map.dvo").write_bytes(b"PK" + HOSTILE.encode())
    tensors = {HOSTILE: torch.zeros(2)}
    save_file(tensors, tmp_path / "weights.safetensors", {"dvo": json.dumps({HOSTILE: HOSTILE}), HOSTILE: HOSTILE})
    common = arguments(image_folder, tmp_path / "out")
    for line in (
        [*common, "--config", str(tmp_path / "settings.yaml")],
        ["run", str(image_folder), "--calib", str(tmp_path / "calib.yaml")],
        ["run", str(image_folder), "--calib", str(tmp_path / "calib.txt")],
        [*common, "--groundtruth", str(tmp_path / "truth.txt")],
        [*common, "--map", str(tmp_path / "map.dvo")],
        ["weights", "info", str(tmp_path / "weights.safetensors")],
    ):
        assert main(line) == 2, line
        said = capsys.readouterr()
        assert is_clean(said.out + said.err) and said.err.startswith("dvo: error: "), line


def test_a_card_of_weights_is_escaped(tmp_path, capsys):
    from dvo.models.weights import load_weights, save_weights

    model = load_weights("small").model
    card = {"origin": f"{HOSTILE} [red]", f"[bold]{HOSTILE}": [HOSTILE], "trained on": "Bäume 漢字"}
    save_weights(tmp_path / "w.safetensors", model, card)
    assert main(["weights", "info", str(tmp_path / "w.safetensors")]) == 0
    said = capsys.readouterr().out
    assert is_clean(said) and "[red]" in said and "[bold]" in said and "Bäume 漢字" in said


def test_names_in_a_results_folder_are_escaped(given, image_folder, tmp_path, capsys):
    given(lost=(7,), reason=f"{HOSTILE} [red]<b>")
    assert main(arguments(image_folder, tmp_path / "out")) == 0
    values = summary(tmp_path / "out")
    (tmp_path / "out" / "run.json").write_text(json.dumps({**values, "source": f"/data/<script>{HOSTILE}"}))
    assert main(["summary", str(tmp_path / "out")]) == 0
    values["segments"][0]["file"] = f"{HOSTILE}.txt"
    (tmp_path / "out" / "run.json").write_text(json.dumps(values))
    page = (tmp_path / "out" / "summary.html").read_text()
    assert "<script>a" not in page and "<b>" not in page
    assert main(["summary", str(tmp_path / "out")]) == 2
    said = capsys.readouterr()
    assert is_clean(said.out) and is_clean(said.err) and ESCAPED in said.err and f"{ESCAPED} [red]<b>" in said.out


@pytest.mark.long
def test_doctor_and_synth(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("DVO_DATA", HOSTILE)
    monkeypatch.setenv("DVO_CACHE", f"http://admin:Xq9@{HOSTILE}")
    for line in (["doctor"], ["doctor", "--json"]):
        assert main(line) == 0
        said = capsys.readouterr()
        assert is_clean(said.out + said.err) and "Xq9" not in said.out
    out = tmp_path / HOSTILE
    assert main(["synth", "export", "--out", str(out), "--frames", "2", "--size", "32x32"]) == 0
    said = capsys.readouterr()
    assert is_clean(said.out) and ESCAPED in said.out


def test_an_encoding_without_the_letters(given, image_folder, tmp_path, monkeypatch):
    """A terminal of ASCII gets escapes, not an error."""
    import io
    import sys

    stream = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    given()
    assert main(arguments(image_folder, tmp_path / "Grüße")) == 0
    assert rb"Gr\xfc\xdfe" in stream.buffer.getvalue()


def test_names_that_are_harmless_stay(given, image_folder, tmp_path, capsys):
    given()
    out = Path(tmp_path) / "Bäume 漢字 😀"
    assert main(arguments(image_folder, out)) == 0
    assert str(out) in capsys.readouterr().out
