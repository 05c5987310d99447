"""Hook of the documentation site: a line that is only a link to a section of the README, or to Python becomes its text.

On a code host the line is the link; files outside ``docs/`` are no pages of the site. Notebooks are files of the site,
to be downloaded.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
_SECTION = re.compile(r"^\[[^\]]*\]\(\.\./README\.md#([\w-]+)\)$", re.MULTILINE)
_NOTEBOOK = re.compile(r"\]\(\.\./examples/(\w+\.ipynb)\)")
_PYTHON = re.compile(r"^\[[^\]]*\]\(\.\./([\w/]+\.py)\)$", re.MULTILINE)


def section(anchor: str) -> str:
    """Text of a section of the README, without its heading, as a page of ``docs/`` would have it.

    Args:
        anchor: of the heading, such as ``how-well-it-tracks``.

    Returns:
        Markdown; links and pictures are relative to ``docs/``.

    Raises:
        KeyError: no such section.
    """
    parts = re.split(r"^## (.*)\n", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    sections = {re.sub(r"\W+", "-", title.lower()): text for title, text in zip(parts[1::2], parts[2::2], strict=True)}
    return sections[anchor].replace("](docs/", "](").strip()


def on_files(files: Files, config: Any) -> Files:
    """Add the notebooks of ``examples/``.

    Args:
        files: of the site.
        config: of the site.

    Returns:
        The same files, with the notebooks.
    """
    for notebook in sorted((ROOT / "examples").glob("*.ipynb")):
        files.append(File.generated(config, notebook.name, abs_src_path=str(notebook)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put the texts into a page.

    Args:
        markdown: of the page.

    Returns:
        Markdown with the texts.
    """
    markdown = _NOTEBOOK.sub(r"](\1)", markdown)
    markdown = _SECTION.sub(lambda link: section(link[1]), markdown)
    return _PYTHON.sub(lambda link: f"```python\n{(ROOT / link[1]).read_text(encoding='utf-8')}```", markdown)
