"""Code and weights on which a system depends."""

from __future__ import annotations

from pathlib import Path

import pytest

from dvo.data.readers.registry import READERS
from dvo.odometry.registry import ODOMETRIES
from eval.execution.cache import system_facts
from eval.execution.versions import code_digest, depends_on_threads, reader_digest, source_files
from eval.suites.suite import ROOT
from eval.systems.registry import CATALOGUE, find_system


@pytest.mark.long
def test_code_of_a_system_is_what_it_imports(monkeypatch):
    names = {str(file.relative_to(ROOT)) for file in source_files(find_system("klt-pnp"))}
    folder = "dvo/odometry/classical"
    assert {f"{folder}/klt_pnp.py", f"{folder}/klt.py", f"{folder}/two_view.py", "dvo/map/keyframe_log.py"} <= names
    assert f"{folder}/null.py" not in names and not any("dvo/nets" in name for name in names)
    learned = {str(file.relative_to(ROOT)) for file in source_files(find_system("dvo-small"))}
    assert {"dvo/odometry/patch/tracker.py", "dvo/models/patch_vo.py", "dvo/ba/layer/layer.py"} <= learned
    assert depends_on_threads(find_system("dvo-small")) and not depends_on_threads(find_system("klt-pnp"))

    before = {name: code_digest(find_system(name)) for name in ("klt-pnp", "null")}
    read = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda file: read(file) + b"#" * (file.name == "two_view.py"))
    assert code_digest(find_system("klt-pnp")) != before["klt-pnp"]
    assert code_digest(find_system("null")) == before["null"]


def test_weights_are_part_of_the_version(tmp_path):
    torch = pytest.importorskip("torch")
    from dvo.models.weights import find_weights, weights_info

    first = tmp_path / "first.safetensors"
    first.write_bytes(find_weights("small").read_bytes())
    before = system_facts("dvo-small", str(first)).version
    assert before.endswith(weights_info(first).sha256[:8]) and torch
    content = bytearray(first.read_bytes())
    content[-1] ^= 1
    first.write_bytes(bytes(content))
    assert system_facts("dvo-small", str(first)).version != before


def test_every_system_of_the_catalogue_has_code():
    for system in CATALOGUE:
        files = source_files(system)
        assert any(file.stem == system.target.rpartition(":")[0].rpartition(".")[2] for file in files), system.name


def test_code_of_a_file_and_of_a_package(tmp_path, monkeypatch):
    (tmp_path / "own.py").write_text("import torch\nfrom dvo.odometry.classical.klt import detect\n")
    files = source_files(find_system(f"{tmp_path / 'own.py'}:Own"))
    assert {tmp_path / "own.py", ROOT / "dvo/odometry/classical/klt.py"} <= set(files)
    assert depends_on_threads(find_system(f"{tmp_path / 'own.py'}:Own"))
    package = tmp_path / "own_slam"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "system.py").write_text("from own_slam import parts\nfrom dvo.data.frame import Frame\n")
    (package / "parts.py").write_text("import numpy\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    system = find_system("own_slam.system:Own")
    assert {package / "system.py", package / "parts.py", ROOT / "dvo/data/frame.py"} <= set(source_files(system))
    assert not depends_on_threads(system)


def test_networks_and_readers_of_other_packages_are_followed(tmp_path, monkeypatch):
    """Code that weights may name counts for learned systems, not for classical ones; readers count for the data."""
    (tmp_path / "brought_along.py").write_text("import brought_further\n")
    (tmp_path / "brought_further.py").write_text("VALUE = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    before = reader_digest()
    ODOMETRIES.register("brought", "brought_along:build")
    READERS.register("brought", "brought_further:READER")
    try:
        learned = source_files(find_system("dvo-small"))
        assert tmp_path / "brought_along.py" in learned
        assert tmp_path / "brought_along.py" not in source_files(find_system("klt-pnp"))
        assert reader_digest() != before
    finally:
        ODOMETRIES.unregister("brought")
        READERS.unregister("brought")
    assert reader_digest() == before
