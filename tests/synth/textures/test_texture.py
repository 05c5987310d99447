"""The texture pool: patterns, photographs, mip levels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.synth.textures.patterns import SPECIAL
from dvo.synth.textures.texture import TexturePool, texture_pool


def test_without_photographs_the_pool_is_procedural(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dvo.synth.textures.photographs.importlib.util.find_spec", lambda name: None)
    pool = TexturePool(0, 20, 32)
    assert "photo" not in pool.tags
    colours = np.stack([pool.use(i) for i in range(20)])
    assert np.isfinite(colours).all() and colours.std(0).min() > 0.05
    top, left = pool.cell(7)
    levels = pool.atlas[:, top : top + 48, left : left + 32]
    assert levels[:, :32].mean() == pytest.approx(float(levels[:, 32:48, :16].mean()), abs=1e-4), (
        "level 1 is not the mean"
    )


def test_special_patterns_leave_other_textures_alone() -> None:
    """Those that scenes without special tags can get are the first ``count``."""
    pool = texture_pool(11, count=24, size=64)
    assert not {pool.tags[i] for i in range(pool.count)} & {tag for _, tag in SPECIAL.values()}
    assert len(pool.tags) == pool.count + len(SPECIAL)


def test_textures_from_a_folder(tmp_path: Path) -> None:
    (tmp_path / "wall").mkdir()
    for index, name in enumerate(("a.png", "b.jpg", "wall/c.png")):
        picture = np.zeros((40, 60, 3), np.uint8)
        picture[..., index] = 255
        cv2.imwrite(str(tmp_path / name), picture[..., ::-1])
    pool = TexturePool(0, 18, 32, tmp_path)
    photos = [i for i in range(18) if i % 3 == 2]
    assert {pool.tags[i] for i in photos} == {"photo", "wall"}
    assert all(sorted(pool.use(i).round(1).tolist()) == [0, 0, 1] for i in photos), "not the pictures of the folder"
    assert texture_pool(0, 18, 32, folder=str(tmp_path)) is not texture_pool(0, 18, 32)
    (tmp_path / "broken.png").write_bytes(b"not a picture")
    with pytest.raises(DvoError, match="broken.png.*cannot be read"):
        TexturePool(0, 18, 32, tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(DvoError, match="no pictures"):
        TexturePool(0, 18, 32, tmp_path / "empty")
    with pytest.raises(DvoError, match="no such folder"):
        TexturePool(0, 18, 32, tmp_path / "nowhere")
