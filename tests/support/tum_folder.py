"""A TUM RGB-D folder with depth images."""

from __future__ import annotations

import cv2
import numpy as np


def depth_image(make, name, metres, scale=5000, width=64, height=48):
    path = make.root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((height, width), round(metres * scale), np.uint16))
    return path


def tum(make, listing=True):
    rgb = [f"{10 + i / 10:.6f}" for i in range(4)]
    make.images("seq/rgb", [f"{stamp}.png" for stamp in rgb])
    make.text("seq/rgb.txt", "\n".join(f"{stamp} rgb/{stamp}.png" for stamp in rgb))
    make.calib("seq/calib.txt")
    stamps = [f"{10.004 + i / 10:.6f}" for i in (0, 1, 3)]  # none within 0.02 s of the third image
    for number, stamp in enumerate(stamps):
        depth_image(make, f"seq/depth/{stamp}.png", 1 + number)
    if listing:
        make.text("seq/depth.txt", "# depth maps\n" + "\n".join(f"{s} depth/{s}.png" for s in stamps))
    return make.root / "seq"
