"""The film that classical odometries are tried on."""

from tests.support.flat_film import dark, film, path, rendered

__all__ = ["dark", "film", "path", "rendered"]
