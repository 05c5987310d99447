"""A study of a few steps."""

from __future__ import annotations

import pytest

from train.studies.family.config import FamilyConfig, HeldOut, Member, Phase

FORM = {"count": 2, "families": ("planes",), "frames": 8, "size": (48, 64), "gaps": (1, 2)}
PHASES = (Phase(0.5, 1e-3), Phase(0.5, 2e-3, {"both_ways": True}))


@pytest.fixture(scope="session")
def rendered(tmp_path_factory):
    """Folder of clips and held-out sequences for all tests."""
    return tmp_path_factory.mktemp("family")


@pytest.fixture
def family(tmp_path, rendered):
    """Makes small studies: one member, whose training is four steps."""

    def make(**changes):
        options = {
            "members": {"deepvo": Member("deepvo", PHASES, "regression", batch=2, steps=4)},
            "folder": str(tmp_path / "runs"), "out": str(tmp_path / "docs" / "family"), "seeds": (0,), "frames": 3,
            "size": (48, 64), "clips": 3, "points": 2, "curve_sequences": 1, "held_out": HeldOut(**FORM),
        }  # fmt: skip
        for name in ("clips", "sequences"):
            (rendered / name).mkdir(exist_ok=True)
            link = tmp_path / "runs" / name
            link.parent.mkdir(exist_ok=True)
            if not link.exists():
                link.symlink_to(rendered / name)
        return FamilyConfig(**(options | changes))

    return make
