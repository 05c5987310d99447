"""Registry of systems: names, targets, settings, files, other packages."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from dataclasses import replace
from importlib import metadata
from io import StringIO

import pytest

import dvo
from dvo.core.errors import DvoError
from dvo.odometry.protocol import Odometry
from dvo.odometry.registry import SYSTEMS as WITHOUT_WEIGHTS
from eval.execution.cache import digest_of, job_key, system_facts
from eval.execution.predict import predict_here
from eval.suites.suite import ROOT
from eval.systems.registry import add_system, find_system, list_systems, remove_system
from eval.systems.system import System

TARGET = "dvo.odometry.classical.klt_pnp:KltPnp"


def test_registry():
    names = [system.name for system in list_systems()]
    assert {"dvo-small", "klt-pnp", "null"} <= set(names)
    for name, target in WITHOUT_WEIGHTS.registered.items():
        assert find_system(name).target == target and "dvo." not in find_system(name).about
    for name in ("klt-pnp", "null"):
        system = find_system(name)
        assert system.missing() is None
        odometry = system.build(0, "cpu")
        assert isinstance(odometry, Odometry) and odometry.name == name
    with pytest.raises(DvoError, match="orb-slam9"):
        find_system("orb-slam9")


def test_missing_weights_are_a_reason_not_an_error(tmp_path):
    reason = find_system(f"dvo:{tmp_path / 'none.safetensors'}").missing()
    assert reason is not None and "no such weights" in reason


def test_weights_that_cannot_be_read_are_a_reason(tmp_path):
    file = tmp_path / "cut.safetensors"
    file.write_bytes(b"\x10\0\0")
    reason = find_system("dvo-small", str(file)).missing()
    assert reason is not None and reason.startswith(f"{file}: not a safetensors file")


@pytest.mark.parametrize(
    ("value", "message"),
    [("2024-13-45", "not a date"), ("9" * 5000, "longer than 100 digits"),
     ("[" * 500, "32 levels"), ("!!python/name:os.system", "python/name"), ("{a,a}", "'a' twice")],
)  # fmt: skip
def test_values_that_no_setting_has(value, message):
    with pytest.raises(DvoError, match=message) as error:
        find_system(f"klt-pnp+corners={value}")
    assert "klt-pnp+corners: " in str(error.value) and len(str(error.value)) < 300


def test_a_date_stays_text():
    assert find_system("klt-pnp+corners=2024-01-31").settings == {"corners": "2024-01-31"}


def test_settings_are_arguments_and_part_of_the_name(tmp_path):
    system = find_system("klt-pnp+corners=400+refill=0.5")
    assert (system.name, system.settings) == ("klt-pnp+corners=400+refill=0.5", {"corners": 400, "refill": 0.5})
    odometry = system.build(3, "cpu")
    assert (odometry.config.corners, odometry.config.refill, odometry.seed) == (400, 0.5, 3)
    for name in ("monoslam+fewest=7", "keyframe+corners=300", "direct+patience=3", "msckf+clones=9"):
        assert isinstance(find_system(name).build(0, "cpu"), Odometry)
    assert find_system("klt-pnp+seed=5").build(0, "cpu").seed == 5
    with pytest.raises(DvoError, match="colour: unknown setting"):
        find_system("klt-pnp+colour=red").build(0, "cpu")
    with pytest.raises(DvoError, match="setting"):
        find_system("klt-pnp+corners=[1")


def test_same_class_with_other_settings_has_another_key(job):
    def key(name: str, weights: str | None = None) -> str:
        return digest_of(job_key(job, system_facts(name, weights), "data", {}))

    one, two = System("few", TARGET, {"corners": 100}), System("many", TARGET, {"corners": 900})
    for system in (one, two):
        add_system(system)
    try:
        keys = {key("few"), key("many"), key("klt-pnp"), key("klt-pnp+corners=101")}
        assert len(keys) == 4
        assert key("klt-pnp+corners=100") == key("few")  # the same class and settings, by whatever name
        assert system_facts("few").code == system_facts("many").code
    finally:
        for system in (one, two):
            remove_system(system.name)
    with pytest.raises(DvoError, match="no system 'few'"):
        find_system("few")


def test_a_setting_that_names_a_file_counts_by_its_content(tmp_path):
    for name, text in (("a", "1"), ("b", "1"), ("c", "2")):
        (tmp_path / name).write_text(text)
    a, b, c = (System("x", TARGET, {"file": str(tmp_path / name)}).identity() for name in "abc")
    assert a == b != c


def test_weights_from_a_file_are_named_by_it(tmp_path):
    file = str(tmp_path / "night.safetensors")
    assert find_system("dvo-small").name == "dvo-small"
    assert find_system("dvo-small", file).name == find_system(f"dvo:{file}").name == "dvo:night"
    assert find_system("dvo-small+patches=48", file).name == "dvo:night+patches=48"
    assert find_system("dvo-small", file).settings == {"weights": file}
    assert find_system("klt-pnp", file).name == "klt-pnp"


def test_shipped_weights_need_no_prefix():
    assert find_system("small") == find_system("dvo-small")
    assert find_system("small+patches=48").name == "dvo-small+patches=48"
    assert find_system("null").target != find_system("dvo-small").target
    with pytest.raises(DvoError, match="no system 'smal'"):
        find_system("smal")


@pytest.mark.long
def test_a_class_of_another_package_needs_no_registration(job):
    assert find_system("no_such_package.slam:Slam").missing() == (
        "no module no_such_package.slam; install it, or set PYTHONPATH"
    )
    system = find_system("eval.systems.null:NullMotion")
    assert system.missing() is None and system.version() == dvo.__version__
    assert predict_here(replace(job, system=system.name)).status == "ok"
    assert find_system("numpy:ndarray").version() == metadata.version("numpy")


@pytest.mark.slow
def test_a_package_announces_a_system_by_name(tmp_path, image_folder, suite_file):
    """As ``pip install`` leaves it: a module, its metadata, an entry point. The worker process finds it too."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site/outside.py").write_text(
        "from eval.systems.null import NullMotion\nclass Outside(NullMotion):\n    name = 'outside'\n"
    )
    info = tmp_path / "site/outside-1.5.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: outside\nVersion: 1.5\nSummary: from elsewhere\nLicense: Apache-2.0\n"
    )
    (info / "top_level.txt").write_text("outside\n")
    (info / "entry_points.txt").write_text("[dvo.systems]\noutside = outside:Outside\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(tmp_path / "site")])}

    def run(*arguments: str) -> str:
        command = [sys.executable, "-m", "eval", *arguments]
        done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "outside        Apache-2.0 available\n      from elsewhere" in run("list")
    pytest.importorskip("evo", reason="evo is in the extra 'eval'")
    options = ["--suite", str(suite_file), "--data", str(tmp_path), "--out", "o", "--no-report", "--threads", "1"]
    assert "| clip | outside | 0/1 |" in run("run", "--systems", "outside", *options)
    (row,) = csv.DictReader(StringIO((tmp_path / "o/results.csv").read_text()))
    assert row["version"] == "1.5" and row["status"] == "ok"
