"""A sample of malformed inputs, and the mutations that make them."""

from __future__ import annotations

import os
import subprocess
import sys
import zlib

import numpy as np
import pytest

from tests.fuzz.__main__ import all_targets, cases_of, choose
from tests.fuzz.images import headers
from tests.fuzz.mutations import BYTES, PLACES, mutate_folder
from tests.fuzz.text import MUTATIONS as TEXT
from tests.fuzz.text import YAML

SAMPLE = ["--cases", "50", "--jobs", "1"]  # one of each reader


@pytest.mark.long
def test_a_sample_fails_nowhere(repository):
    done = subprocess.run(
        [sys.executable, "-m", "tests.fuzz", *SAMPLE],
        cwd=repository, env={**os.environ, "PYTHONPATH": str(repository)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    total = next(line.split() for line in done.stdout.splitlines() if line.startswith("total"))
    tried, refused, accepted, failed = (int(number) for number in total[1:])
    assert (tried, failed) == (50, 0)
    assert refused > 12 and accepted > 5  # else the inputs are not near to valid ones


def test_names_are_unique_and_chosen_by_their_beginnings():
    targets = all_targets()
    assert len({target.name for target in targets}) == len(targets)
    assert {target.name for target in choose(targets, ["tartanair", "tum"])} == {
        "tum", "tartanair", "tartanair_v2", "tartanair_test"
    }  # fmt: skip
    with pytest.raises(Exception, match="no reader 'x'"):
        choose(targets, ["x"])
    cases = [(target.name, seed) for target, seed in cases_of(targets[:2], 4, 10)]
    names = [target.name for target in targets[:2]]
    assert cases == [(name, -1) for name in names] + [(name, seed) for seed in (10, 11) for name in names]


def fill(folder, text="fx: 50\nfy: 51.5\n1 2, 3\n4 5, 6\n"):
    folder.mkdir()
    for name in ("a.txt", "b.yaml", "c.bin"):
        (folder / name).write_text(f"{text}# {name}\n", encoding="utf-8")
    return folder


def content(path):
    if path.is_symlink():
        return os.readlink(path)
    if not path.is_file():
        return path.stat().st_mode
    with path.open("rb") as file:
        return path.stat().st_size, file.read(10**6)


def state(folder):
    return {path.relative_to(folder): content(path) for path in folder.rglob("*")}


@pytest.mark.parametrize("mutation", sorted({*BYTES, *PLACES, *TEXT, *YAML}, key=lambda m: m.__name__))
def test_every_mutation_changes_its_file(mutation, tmp_path):
    changed = set()
    for seed in range(12):
        folder = fill(tmp_path / f"case{seed}")
        before = state(folder)
        said = mutation(folder / "b.yaml", np.random.default_rng(seed))
        assert said
        changed |= {said} if state(folder) != before else set()
    assert changed


def test_a_seed_is_a_case(tmp_path):
    found = []
    for name in ("one", "two", "three"):
        folder = fill(tmp_path / name)
        said = mutate_folder(folder, np.random.default_rng([zlib.crc32(b"x"), 7 if name != "three" else 8]))
        found.append((said.replace(str(folder), ""), state(folder)))
    assert found[0] == found[1] and found[0] != found[2]


def test_headers_state_their_sizes():
    from dvo.data.images.image_header import image_size

    stated = {name: image_size(data) for name, data in headers(30_000, 20_000).items()}
    for name in ("PNG", "PNG of 16 bit", "BMP", "PGM", "PPM", "PAM", "TIFF", "JPEG"):
        assert stated[name] == (30_000, 20_000), name
