"""Elements of patterns: colours, noise of a given spectrum, colour ramps, grain."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Rng = np.random.Generator
Pattern = Callable[[Rng, int], np.ndarray]


def colour(rng: Rng, saturation: float = 0.3, low: float = 0.1, high: float = 0.9) -> np.ndarray:
    """Draw a plausible colour: mostly earthy, at times of any hue, of moderate saturation.

    Args:
        rng: draws it.
        saturation: standard deviation of the saturation.
        low, high: range of the value (brightness).

    Returns:
        ``(3,)`` RGB in [0, 1].
    """
    hue = rng.uniform(0, 6) if rng.random() < 0.4 else rng.normal(0.6, 0.4)
    sat, value = min(0.9, abs(rng.normal(0, saturation))), rng.uniform(low, high)
    ramp = np.clip(np.abs((hue + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    return value * (1 - sat * (1 - ramp))


def noise(rng: Rng, size: int, beta: float, stretch: float = 1.0, low_cut: float = 0.0) -> np.ndarray:
    """Draw a tileable Gaussian field of spectrum ``1 / f^beta``.

    Args:
        rng: draws it.
        size: edge length S.
        beta: exponent; larger is smoother.
        stretch: anisotropy; above 1 the field is longer along x.
        low_cut: frequencies up to this one are removed, cycles per edge.

    Returns:
        ``(S, S)`` float32 of zero mean and unit deviation.
    """
    fy = np.fft.fftfreq(size)[:, None] * size * stretch
    fx = np.fft.rfftfreq(size)[None] * size / stretch
    f = np.sqrt(fx**2 + fy**2)
    amplitude = np.where(f > low_cut, 1 / np.maximum(f, 0.5) ** beta, 0)
    amplitude[0, 0] = 0
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) * amplitude, s=(size, size))
    return (field / (field.std() + 1e-9)).astype(np.float32)


def shade(field: np.ndarray, colours: list[np.ndarray]) -> np.ndarray:
    """Map a field through a colour ramp.

    Args:
        field: ``(S, S)`` in [0, 1].
        colours: two ``(3,)`` colours or more, evenly spaced.

    Returns:
        ``(S, S, 3)`` float32.
    """
    stops = np.linspace(0, 1, len(colours))
    table = np.stack(colours)
    return np.stack([np.interp(field, stops, table[:, k]) for k in range(3)], -1).astype(np.float32)


def grain(rng: Rng, image: np.ndarray, amount: float) -> np.ndarray:
    """Overlay fine and coarse grain, so that no area is exactly constant.

    Args:
        rng: draws it.
        image: ``(S, S, 3)`` in [0, 1].
        amount: relative deviation.

    Returns:
        ``(S, S, 3)`` float32 in [0, 1].
    """
    size = image.shape[0]
    field = noise(rng, size, rng.uniform(0.3, 1.4)) * 0.7 + noise(rng, size, 1.8) * 0.5
    # Contiguous, because broadcasting leaves layouts that OpenCV cannot draw on.
    return np.ascontiguousarray(np.clip(image * (1 + amount * field[..., None]), 0, 1), np.float32)
