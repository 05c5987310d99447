"""Synthetic renderings: scenes, camera paths and frames with exact ground truth, endless, from a seed."""

from dvo.synth.families import FAMILIES, random_scene
from dvo.synth.paths import KINDS, Path, random_path
from dvo.synth.renderer import Rendering, render, trace
from dvo.synth.scene import Scene

__all__ = ["FAMILIES", "KINDS", "Path", "Rendering", "Scene", "random_path", "random_scene", "render", "trace"]
