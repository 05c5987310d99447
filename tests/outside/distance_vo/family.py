"""Scene family: a small room."""

from dvo.synth.scenes.indoor import room


def shed(rng, pool):
    """Draw a shed."""
    return room(rng, pool)
