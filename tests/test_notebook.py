"""The notebook for learners: its form, its links, and its cells run in order, without Jupyter."""

from __future__ import annotations

import json
import re
from pathlib import Path

import matplotlib
import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOK = ROOT / "examples" / "first_steps.ipynb"


@pytest.fixture(scope="module")
def cells() -> list[dict]:
    return json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]


def source(cell: dict) -> str:
    return "".join(cell["source"])


def test_it_is_a_notebook_without_outputs(cells):
    """The parts of nbformat 4 that a reader asks for; nothing that a run has left."""
    whole = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert (whole["nbformat"], whole["nbformat_minor"]) == (4, 5) and set(whole) == {
        "cells", "metadata", "nbformat", "nbformat_minor"
    }  # fmt: skip
    assert whole["metadata"]["kernelspec"]["name"] == "python3"
    assert len({cell["id"] for cell in cells}) == len(cells)
    for cell in cells:
        code = {"execution_count", "outputs"} if cell["cell_type"] == "code" else set()
        assert set(cell) == {"cell_type", "id", "metadata", "source"} | code and cell["metadata"] == {}
        assert cell["cell_type"] in ("code", "markdown") and cell["source"]
        assert all(line.endswith("\n") for line in cell["source"][:-1]) and not cell["source"][-1].endswith("\n")
        if code:
            assert cell["execution_count"] is None and cell["outputs"] == []


def test_every_code_cell_is_explained_and_plain_python(cells):
    for before, cell in zip(cells[:-1], cells[1:], strict=True):
        if cell["cell_type"] == "code":
            assert before["cell_type"] == "markdown" and len(source(before)) > 150
            compile(source(cell), cell["id"], "exec")


def test_links_lead_to_pages_and_sections(cells):
    links = re.findall(r"\]\(([^)#]+)(?:#([\w-]+))?\)", "".join(map(source, cells)))
    assert sum(page.endswith("method.md") for page, _ in links) >= 5
    for page, anchor in links:
        text = (NOTEBOOK.parent / page).read_text(encoding="utf-8")
        titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
        assert not anchor or anchor in [re.sub(r"\W+", "-", title.lower()) for title in titles], (page, anchor)


@pytest.mark.slow
def test_the_cells_run_in_order(cells, monkeypatch, tmp_path, capsys):
    """In one namespace, and each figure shows something; the pictures stay in the folder of the test."""
    before = matplotlib.get_backend()
    matplotlib.use("Agg")
    from matplotlib import pyplot

    monkeypatch.chdir(tmp_path)
    names: dict = {"__name__": "first_steps"}
    try:
        for cell in cells:
            if cell["cell_type"] != "code":
                continue
            exec(compile(source(cell), cell["id"], "exec"), names)
            for number in pyplot.get_fignums():
                figure = pyplot.figure(number)
                figure.savefig(tmp_path / f"{cell['id']}-{number}.png", dpi=80)
                assert all(axis.has_data() for axis in figure.axes)
            pyplot.close("all")
    finally:
        pyplot.close("all")
        matplotlib.use(before)
    assert len(list(tmp_path.glob("*.png"))) == 5
    said = capsys.readouterr().out
    assert "poses for 24 of 24 frames" in said and len(set(re.findall(r"pixel \(.*\)", said))) == 1
    assert names["score"].ate_percent < 1 and names["rotation"][-1] < 0.1 * names["rotation"][0]
    assert names["found"].focal == pytest.approx(names["camera"].fx, rel=0.08)
