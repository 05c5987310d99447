"""The encoder as an ONNX file; without the packages of the extra ``onnx``, the message that names it."""

import builtins
import sys

import numpy as np
import pytest
import torch

import dvo
from dvo.cli import main
from dvo.core.errors import DvoError
from dvo.models import onnx_export


@pytest.fixture(scope="module")
def encoder(tmp_path_factory):
    for name in ("onnx", "onnxruntime"):
        pytest.importorskip(name, reason=f"no {name}: pip install 'dvo[onnx]'")
    return onnx_export.export_encoder("small", tmp_path_factory.mktemp("onnx") / "encoder.onnx")


def test_outputs_are_those_of_torch(encoder):
    """On sizes that were not traced, of images with structure."""
    import onnxruntime

    assert encoder.relative < 1e-5 and encoder.outputs == {"matching": 64, "context": 128}
    session = onnxruntime.InferenceSession(str(encoder.file), providers=["CPUExecutionProvider"])
    assert [node.name for node in session.get_inputs()] == ["images"]
    y, x = np.mgrid[:88, :152]
    images = np.stack([np.stack([x % 97, y % 53, (x * y) % 256])] * 2).astype(np.float32)
    found = session.run(["matching", "context"], {"images": images})
    with torch.no_grad():
        expected = dvo.load_model("small").encoder(torch.from_numpy(images))
    for values, reference in zip(found, expected, strict=True):
        assert values.shape == tuple(reference.shape) == (2, values.shape[1], 22, 38)
        np.testing.assert_allclose(values, reference.numpy(), atol=1e-5 * float(reference.abs().max()))


def test_facts_are_in_the_file(encoder):
    import onnx

    facts = {entry.key: entry.value for entry in onnx.load(str(encoder.file)).metadata_props}
    assert facts["weights"] == '"small"' and "0 to 255" in facts["input"]


def test_command(encoder, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["weights", "onnx", "small"]) == 0
    said = capsys.readouterr().out
    assert (
        "encoder in small-encoder.onnx" in said and "matching (64 channels)" in said and "difference to torch" in said
    )
    assert main(["weights", "onnx", "small"]) == 2
    assert "already exists" in capsys.readouterr().err


def test_outputs_that_differ_leave_no_file(encoder, tmp_path, monkeypatch):
    monkeypatch.setattr(onnx_export, "TOLERANCE", 0.0)
    with pytest.raises(DvoError, match="differs from torch"):
        onnx_export.export_encoder("small", tmp_path / "encoder.onnx")
    assert not list(tmp_path.iterdir())


def test_the_extra_is_named_if_a_package_is_missing(tmp_path, monkeypatch, capsys):
    load = builtins.__import__

    def refuse(name, *args, **options):
        if name == "onnx":
            raise ModuleNotFoundError("No module named 'onnx'", name="onnx")
        return load(name, *args, **options)

    monkeypatch.delitem(sys.modules, "onnx", raising=False)
    monkeypatch.setattr(builtins, "__import__", refuse)
    assert main(["weights", "onnx", "small", "--out", str(tmp_path / "encoder.onnx")]) == 2
    assert "no module onnx. Pip install 'dvo[onnx]'." in capsys.readouterr().err


def test_weights_of_another_architecture_are_refused(tmp_path, monkeypatch):
    from types import SimpleNamespace

    other = SimpleNamespace(model=SimpleNamespace(architecture="deepvo"), name="x")
    monkeypatch.setattr(onnx_export, "load_weights", lambda name: other)
    monkeypatch.setattr(onnx_export, "check_installed", lambda: None)
    with pytest.raises(DvoError, match="deepvo has no such encoder"):
        onnx_export.export_encoder("x", tmp_path / "encoder.onnx")
