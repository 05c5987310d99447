"""Motion of cameras and bodies in continuous time, planned in free space. Begin with ``motion.py``."""
