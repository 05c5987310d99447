"""Camera that OpenCV opens, in tests."""

from __future__ import annotations


class StandInCamera:
    """Stand-in for ``cv2.VideoCapture``: open, without properties; subclasses send images."""

    index = -1

    def __init__(self, *_):
        pass

    def isOpened(self):
        return True

    def set(self, key, value):
        return False

    def get(self, key):
        return 0.0

    def grab(self):
        self.index += 1
        return True

    def release(self):
        pass
