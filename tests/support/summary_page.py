"""Reader of what summary.html holds."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path

import numpy as np


def data_of(file: Path) -> dict:
    return json.loads(re.search(r'id="data">(.*?)</script>', file.read_text(encoding="utf-8"), re.DOTALL)[1])


def floats(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4")
