"""Textures of scenes: a mip-mapped pool of procedural patterns and photographs. Begin with ``texture.py``."""
