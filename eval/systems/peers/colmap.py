"""COLMAP (Schoenberger, Frahm 2016), from the package ``pycolmap`` (BSD-3): incremental structure from motion, offline.

All frames are reconstructed at the end, or of a long sequence every second, third ... one; frames between two that were
placed are interpolated (which costs a hand-held camera its shake). Frames that the largest model lacks have no row.
"""

from __future__ import annotations

from contextlib import ExitStack

import cv2
import numpy as np

from dvo.data.files.output import scratch_folder
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory, interpolate
from dvo.geometry.poses import poses_from_matrices
from dvo.odometry.protocol import Estimate, Result, SparseMap, Status
from eval.systems.peers.common import Pictures, missing_module, version_of

MOST_IMAGES = 60  # of a sequence; one takes about half a second of a core at 320x240, and more the more there are
version = version_of("pycolmap")


def missing() -> str | None:
    """Reason why it cannot run here, or None."""
    return missing_module("pycolmap", "pip install pycolmap (BSD-3)")


class Colmap:
    """See the module."""

    name = "colmap"

    def __init__(self, seed: int = 0, most_images: int = MOST_IMAGES) -> None:
        self._seed, self._most = seed, most_images
        self._scratch = ExitStack()
        self._folder = self._scratch.enter_context(scratch_folder("dvo-colmap"))
        self._images = self._folder / "images"
        self._images.mkdir()
        self._pictures = Pictures(smallest=0)
        self._times: list[float] = []
        self._kept: dict[str, float] = {}

    def track(self, frame: Frame) -> Estimate:
        cv2.imwrite(str(self._images / self._file(len(self._times))), self._pictures(frame))
        self._times.append(frame.timestamp)
        return Estimate(frame.timestamp, None, Status.INITIALISING)

    def finish(self) -> Result:
        count = len(self._times)
        stride = max(1, -(-count // self._most))
        # The last one too, so that the end is interpolated, not lost.
        chosen = sorted({*range(0, count, stride), count - 1} - {-1})
        self._kept = {self._file(index): self._times[index] for index in chosen}
        poses: dict[float, np.ndarray] = {}
        sparse_map, models = SparseMap(), 0
        if len(self._kept) > 1:
            poses, sparse_map, models = self._reconstruct()
        stamps = np.array(sorted(poses))
        placed = Trajectory(stamps, np.array([poses[t] for t in stamps]).reshape(-1, 7))
        steps = np.diff(self._times)
        gap = 1.5 * stride * float(np.median(steps)) if len(steps) else 0.0
        trajectory = interpolate(placed, np.array(self._times), max_gap=gap)
        self._scratch.close()
        info = {**self._pictures.facts(), "stride": stride, "placed": len(placed), "models": models}
        return Result(trajectory, sparse_map, len(self._times), len(self._times) - len(trajectory), info)

    @staticmethod
    def _file(index: int) -> str:
        return f"{index:06d}.png"

    def _reconstruct(self) -> tuple[dict[float, np.ndarray], SparseMap, int]:
        """Poses ``(7,)`` by time and points of the largest model, and how many models there are."""
        import pycolmap

        camera = self._pictures.camera
        assert camera is not None
        pycolmap.set_random_seed(self._seed)
        folder = self._folder
        database = folder / "database.db"
        fx, fy, cx, cy = camera.intrinsics
        # COLMAP counts from the corner of the first pixel, not from its centre.
        reader = pycolmap.ImageReaderOptions(camera_model="PINHOLE", camera_params=f"{fx},{fy},{cx + 0.5},{cy + 0.5}")
        threads = cv2.getNumThreads()
        extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
        pairing, mapping = pycolmap.SequentialPairingOptions(), pycolmap.IncrementalPipelineOptions()
        for options in (extraction, matching, pairing, mapping):
            options.num_threads = threads
        mapping.random_seed = self._seed
        mapping.min_model_size = 3
        mapping.ba_refine_focal_length = mapping.ba_refine_extra_params = False
        pycolmap.extract_features(
            database,
            self._images,
            image_names=list(self._kept),
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
        pycolmap.match_sequential(
            database, matching_options=matching, pairing_options=pairing, device=pycolmap.Device.cpu
        )
        models = pycolmap.incremental_mapping(database, self._images, folder, options=mapping)
        if not models:
            return {}, SparseMap(), 0
        best = max(models.values(), key=lambda model: model.num_reg_images())
        poses = {}
        for image in best.images.values():
            if image.has_pose:
                T_wc = np.eye(4)
                T_wc[:3] = image.cam_from_world().inverse().matrix()
                poses[self._kept[image.name]] = poses_from_matrices(T_wc)
        points = list(best.points3D.values())
        where = np.array([point.xyz for point in points], np.float32).reshape(-1, 3)
        colors = np.array([point.color for point in points], np.uint8).reshape(-1, 3)
        return poses, SparseMap(where, colors), len(models)
