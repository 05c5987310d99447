"""Synthetic renderings: scenes, camera paths and frames with exact ground truth, endless, from a seed."""

from dvo.synth.families import FAMILIES, HELD_OUT, random_scene
from dvo.synth.mesh import MeshScene
from dvo.synth.mesh_files import load_mesh, mesh_scene
from dvo.synth.paths import KINDS, Path, random_path
from dvo.synth.renderer import Rendering, render, trace
from dvo.synth.scene import Scene

__all__ = [
    "FAMILIES", "HELD_OUT", "KINDS", "MeshScene", "Path", "Rendering", "Scene", "load_mesh", "mesh_scene",
    "random_path", "random_scene", "render", "trace",
]  # fmt: skip
