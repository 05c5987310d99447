"""Pictures in motion, and interlaced images of them."""

import cv2
import numpy as np


def moving(count, step, noise=0.0):
    """Pictures of a texture that passes by ``step`` pixels a picture, and down by a third of it."""
    random = np.random.default_rng(2)
    texture = cv2.GaussianBlur(random.uniform(0, 255, (400, 900, 3)).astype(np.float32), (0, 0), 2.5)
    texture = (texture - texture.mean()) * 4 + 128
    for index in range(count):
        shift = np.float32([[1, 0, -step * index], [0, 1, -step * index / 3]])
        picture = cv2.warpAffine(texture, shift, (320, 240)) + random.normal(0, noise, (240, 320, 3))
        yield np.clip(picture, 0, 255).astype(np.uint8)


def woven(pictures, top_first):
    """Interlaced images at half the rate."""
    pictures = list(pictures)
    for first, second in zip(pictures[::2], pictures[1::2], strict=True):
        image = first.copy()
        image[int(top_first) :: 2] = second[int(top_first) :: 2]
        yield image
