"""Rendering of scenes and meshes with exact ground truth: frames, lenses, shutters. Begin with ``renderer.py``."""
