"""Hook of the documentation site: formulas become drawings when it is built; reading needs no script and no font."""

from __future__ import annotations

import html
import re
import xml.etree.ElementTree as ElementTree
from typing import Any

import ziamath
from latex2mathml.converter import convert

_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
_SIZE = 16.0  # of the letters of a formula, and pixels of an em of the text
ziamath.config.svg2 = False  # outlines within each drawing: names of shared ones would clash between drawings
ziamath.config.precision = 2


def draw(formula: str, *, block: bool) -> str:
    """Draw a formula.

    Args:
        formula: LaTeX.
        block: on lines of its own, otherwise within the text.

    Returns:
        SVG in the colour of the text, with the LaTeX as its name for screen readers.

    Raises:
        ValueError: a command that the converter does not know, which it would show as it is written.
    """
    formula = " ".join(formula.split())
    if unknown := re.search(r"\\[A-Za-z]+|&#x0*5C;", convert(formula)):
        raise ValueError(f"cannot convert {unknown[0]} in the formula {formula}")
    drawing = ziamath.Latex(formula, size=_SIZE, color="currentColor", inline=not block).svgxml()
    width, height = (float(drawing.attrib.pop(side)) / _SIZE for side in ("width", "height"))
    _, top, _, tall = map(float, drawing.attrib["viewBox"].split())
    below = (top + tall) / _SIZE  # of the base line
    drawing.set("style", f"width:{width:.3f}em;height:{height:.3f}em;vertical-align:{-below:.3f}em")
    drawing.set("role", "img")
    drawing.set("aria-label", formula)
    return ElementTree.tostring(drawing, encoding="unicode")


def on_page_content(content: str, **_: Any) -> str:
    """Replace the formulas that ``pymdownx.arithmatex`` has marked.

    Formulas that ``\\qquad`` separates stand beside each other where there is room.

    Args:
        content: HTML of a page.

    Returns:
        HTML with drawings.
    """

    def replace(match: re.Match[str]) -> str:
        formula = html.unescape(match[3])
        if match[2] == "(":
            return f'<span class="inline-formula">{draw(formula, block=False)}</span>'
        parts = "".join(f"<span>{draw(part, block=True)}</span>" for part in formula.split(r"\qquad"))
        return f'<div class="formula">{parts}</div>'

    return _FORMULA.sub(replace, content)
