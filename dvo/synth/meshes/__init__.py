"""Meshes as scenes: triangles with textures of their own, and the free space around them. Begin with ``mesh.py``."""
