"""Clips with other images in some places."""

from __future__ import annotations

from dataclasses import replace


def with_images(frames, images, start):
    """The frames with other images from position ``start`` on."""
    changed = list(frames)
    for position, image in enumerate(images, start):
        changed[position] = replace(frames[position], image=image)
    return changed
