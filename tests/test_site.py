"""The documentation site: every page is reached, every link and picture exists, and it builds without a warning."""

from __future__ import annotations

import importlib.util
import os
import re
import runpy
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest
import yaml

import dvo

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
NEEDED = ("mkdocs", "material", "mkdocstrings", "mkdocstrings_handlers.python", "ziamath")


def pages_of(entry: Any) -> Iterator[str]:
    """Files that an entry of the navigation names."""
    if isinstance(entry, str):
        yield entry
    else:
        for value in entry.values() if isinstance(entry, dict) else entry:
            yield from pages_of(value)


def is_there(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # the package of a submodule
        return False


def test_every_page_is_in_the_navigation_once():
    listed = list(pages_of(yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]))
    assert sorted(listed) == sorted(str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md"))


def test_api_page_has_every_public_name():
    named = re.findall(r"^::: dvo\.(\w+)$", (DOCS / "api.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(named) == sorted(set(dvo.__all__) - {"__version__"})


@pytest.mark.parametrize("page", [ROOT / "README.md", *sorted(DOCS.glob("*.md"))], ids=lambda page: page.name)
def test_links_lead_somewhere_on_a_code_host(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
        assert re.match(r"https?:", link) or (page.parent / link).is_file(), link


@pytest.mark.parametrize(("folder", "page", "names"), [("footage", "footage", "CLIPS"), ("figures", "method", "NAMES")])
def test_pictures_are_small_and_those_of_their_script(folder, page, names):
    script = runpy.run_path(str(DOCS / folder / "make.py"))
    pictures = list((DOCS / folder).glob("*.png"))
    assert {picture.stem for picture in pictures} == set(script[names])
    assert max(picture.stat().st_size for picture in pictures) < 150_000
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    assert all(f"({folder}/{picture.name})" in text for picture in pictures)


@pytest.mark.long
def test_script_of_the_rooms_draws_them(tmp_path, monkeypatch):
    script = runpy.run_path(str(DOCS / "rooms" / "make.py"))
    monkeypatch.setattr(sys, "argv", ["make.py", "--out", str(tmp_path / "rooms.png")])
    script["main"]()
    drawn, kept = (cv2.imread(str(path)) for path in (tmp_path / "rooms.png", DOCS / "rooms" / "rooms.png"))
    assert drawn.shape == kept.shape and drawn.std() > 10


@pytest.mark.slow
def test_script_of_the_figures_draws_them(tmp_path, monkeypatch):
    """Of the first frames of the walk, on which the window has just been initialised."""
    script = runpy.run_path(str(DOCS / "figures" / "make.py"))
    monkeypatch.setattr(sys, "argv", ["make.py", "--frames", "10", "--out", str(tmp_path)])
    script["main"]()
    assert {path.name for path in tmp_path.iterdir()} == {f"{name}.png" for name in script["NAMES"]}
    for path in tmp_path.iterdir():
        picture = cv2.imread(str(path))
        assert min(picture.shape[:2]) > 200 and picture.std() > 10, path.name  # something is drawn


@pytest.mark.slow
def test_site_builds_without_a_warning(tmp_path):
    missing = [name for name in NEEDED if not is_there(name)]
    if missing:
        pytest.skip(f"no {', '.join(missing)}: pip install 'dvo[docs]'")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    page = {path.stem: path.read_text(encoding="utf-8") for path in (tmp_path / "site").glob("*.html")}
    assert page["method"].count("<svg") > 80 and "arithmatex" not in page["method"]
    assert all(f'id="dvo.{name}"' in page["api"] for name in dvo.__all__ if name != "__version__")
    assert ":class:" not in page["api"]
    assert (tmp_path / "site" / "first_steps.ipynb").is_file() and 'href="first_steps.ipynb"' in page["quick_start"]
    assert "kitti00_120" in page["accuracy"] and "make_sequence" in page["quick_start"]
    for name, text in page.items():  # reading needs no network
        assert not re.search(r'<(?:script|link|img)[^>]*(?:src|href)="(?:https?:)?//', text), name
