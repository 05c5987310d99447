"""Scenes: flat textured surfaces with baked light, laid out by families; moving bodies. Begin with ``scene.py``."""
