"""Readers of single files that a user names: calibrations, times, trajectories, ground truth; and streams."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.read import read_calibration
from dvo.data.files.stamps import read_times
from dvo.data.inertial_files.imu_calibration import read_imu_calibration
from dvo.data.inertial_files.tables import read_inertial_table
from dvo.data.open import open_source
from dvo.data.readers.groundtruth import read_groundtruth
from dvo.data.streams.streams import stream
from dvo.data.trajectory import Trajectory, read_kitti_poses, read_tum
from dvo.geometry.camera import Camera
from dvo.geometry.undistort import Undistorter
from tests.fuzz.readers_data import HEIGHT, MODULES, WIDTH, K, images, lines, picture, poses
from tests.fuzz.target import Target, check_frames, check_times, check_trajectory, require

CALIBRATIONS = {
    "line": ("calib.txt", [f"{K} -0.1 0.01 0.001 0.001 0.0001"]),
    "matrix": ("calib.txt", ["50 0 31.5", "0 51 23.5", "0 0 1"]),
    "keys": ("calib.yaml", ["fx: 50", "fy: 51", "cx: 31.5", "cy: 23.5", "width: 64", "height: 48", "model: fisheye",
                            "coefficients: [0.01, 0.002, 0.0003, 0.0001]", "depth_scale: 1000", "baseline: 0.1",
                            "readout: 0.02"]),
    "kalibr": ("calib.yaml", ["cam0:", "  camera_model: pinhole", "  intrinsics: [50, 51, 31.5, 23.5]",
                              "  distortion_model: radtan", "  distortion_coeffs: [-0.1, 0.01, 0.001, 0.001]",
                              "  resolution: [64, 48]"]),
    "opencv": ("calib.yml", ["%YAML:1.0", "---", "image_width: 64", "image_height: 48",
                             "camera_matrix: !!opencv-matrix", "   rows: 3", "   cols: 3", "   dt: d",
                             "   data: [50, 0, 31.5, 0, 51, 23.5, 0, 0, 1]",
                             "distortion_coefficients: !!opencv-matrix", "   rows: 1", "   cols: 5", "   dt: d",
                             "   data: [-0.1, 0.01, 0.001, 0.001, 0.0]"]),
    "orbslam": ("calib.yaml", ["Camera.fx: 50", "Camera.fy: 51", "Camera.cx: 31.5", "Camera.cy: 23.5",
                               "Camera.k1: -0.1", "Camera.k2: 0.01", "Camera.p1: 0.001", "Camera.p2: 0.001",
                               "Camera.width: 64", "Camera.height: 48", "Camera.bf: 5", "DepthMapFactor: 5000"]),
    "ini": ("calib.ini", ["[camera]", "fx = 50.0", "fy = 51.0", "cx = 31.5", "cy = 23.5 ; px", "k1 = -0.1", "k2 = 0.01",
                          "p1 = 0.0", "p2 = 0.0", "[image]", "width = 64", "height = 48"]),
    "toml": ("calib.toml", ["[cam_0]", "size = [64, 48]", "matrix = [[50.0, 0.0, 31.5], [0.0, 51.0, 23.5],",
                            "[0.0, 0.0, 1.0]]", "distortions = [0.1, -0.2, 0.003, 0.004]", "fisheye = true"]),
    "named": ("calib.txt", ["fx=50 fy=51 cx=31.5 cy=23.5"]),
    "euroc": ("sensor.yaml", ["sensor_type: camera", "T_BS:", "  cols: 4", "  rows: 4",
                              "  data: [1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]", "rate_hz: 20",
                              "resolution: [64, 48]", "camera_model: pinhole", "intrinsics: [50, 51, 31.5, 23.5]",
                              "distortion_model: radial-tangential",
                              "distortion_coefficients: [-0.1, 0.01, 0.001, 0.001]"]),
    "kitti": ("calib.txt", [f"P{k}: 50 0 31.5 {-5 * k} 0 50 23.5 0 0 0 1 0" for k in range(4)]),
    "ros": ("camera_info.yaml", ["image_width: 64", "image_height: 48", "camera_name: left",
                                 "camera_matrix: {rows: 3, cols: 3, data: [50, 0, 31.5, 0, 51, 23.5, 0, 0, 1]}",
                                 "distortion_model: plumb_bob",
                                 "distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.01, 0.001, 0.001, 0]}"]),
    "vins": ("calib.yaml", ["%YAML:1.0", "---", "model_type: MEI", "image_width: 64", "image_height: 48",
                            "mirror_parameters:", "   xi: 1.2", "distortion_parameters:", "   k1: -0.1", "   k2: 0.01",
                            "   p1: 0.001", "   p2: 0.001", "projection_parameters:", "   gamma1: 110",
                            "   gamma2: 112", "   u0: 31.5", "   v0: 23.5"]),
    "basalt": ("calib.json", ['{"value0": {"intrinsics": [{"camera_type": "ds",', '"intrinsics": {"fx": 50, "fy": 51,',
                              '"cx": 31.5, "cy": 23.5, "xi": -0.2, "alpha": 0.6}}],', '"resolution": [[64, 48]]}}']),
    "transforms": ("transforms.json", ['{"fl_x": 50, "fl_y": 51, "cx": 32, "cy": 24, "w": 64, "h": 48, "k1": 0.1,',
                                       '"camera_model": "OPENCV", "frames": [{"file_path": "a.png"}]}']),
    "opensfm": ("camera_models.json", ['{"v2 a b 64": {"projection_type": "brown", "width": 64, "height": 48,',
                                       '"focal_x": 0.8, "focal_y": 0.9, "c_x": 0.01, "c_y": 0, "k1": 0.1, "k2": 0.01,',
                                       '"k3": 0, "p1": 0.001, "p2": 0}}']),
    "xml": ("calib.xml", ['<?xml version="1.0"?>', "<opencv_storage>", "<fisheye_model>1</fisheye_model>",
                          '<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>',
                          "<data>50 0 31.5 0 51 23.5 0 0 1</data></camera_matrix>",
                          '<distortion_coefficients type_id="opencv-matrix"><rows>4</rows><cols>1</cols><dt>d</dt>',
                          "<data>0.01 0.001 0 0</data></distortion_coefficients>", "</opencv_storage>"]),
    "ost": ("ost.txt", ["# oST version 5.0 parameters", "[image]", "width", "64", "height", "48", "[camera]",
                        "camera matrix", "50 0 31.5", "0 51 23.5", "0 0 1", "distortion", "-0.1 0.01 0.001 0.001 0"]),
    "dso": ("camera.txt", ["FOV 0.8 1.0 0.5 0.5 0.9", "64 48", "crop", "64 48"]),
    "kitti_raw": ("calib_cam_to_cam.txt", ["calib_time: 09-Jan-2012 13:57:47", "S_rect_00: 64 48", "D_00: 0.1 0 0 0 0",
                                           "P_rect_00: 50 0 31.5 0 0 51 23.5 0 0 0 1 0"]),
    "colmap": ("cameras.txt", ["# Camera list", "1 OPENCV 64 48 50 51 32 24 -0.1 0.01 0.001 0.001"]),
    "colmap_of_two": ("cameras.txt", ["1 PINHOLE 64 48 50 51 32 24", "7 OPENCV_FISHEYE 64 48 50 51 32 24 0.01 0 0 0"]),
}  # fmt: skip
SELECTED = {"colmap_of_two": ":7"}


def _write(folder: Path, name: str, rows: list[str]) -> None:
    lines(folder / name, rows)


def _calibration(folder: Path, random: np.random.Generator | None, name: str) -> None:
    calibration = read_calibration(folder / name)
    camera = calibration.camera(WIDTH, HEIGHT)
    calibration.doubts(WIDTH, HEIGHT)
    if camera.needs_undistortion:
        undistorter = Undistorter(camera)
        require(np.isfinite(undistorter.camera.intrinsics).all(), "undistorted camera that is not finite")
        require(0 <= undistorter.camera.readout <= 1, "readout of the undistorted camera")
        undistorter(picture(0))
    for value in (calibration.depth_scale, calibration.baseline):
        require(value is None or (np.isfinite(value) and value > 0), "scale or baseline")


def _times(folder: Path, random: np.random.Generator | None) -> None:
    check_times(read_times(folder / "times.txt", None))


def _tum(folder: Path, random: np.random.Generator | None) -> None:
    check_trajectory(read_tum(folder / "trajectory.txt"))


def _kitti_poses(folder: Path, random: np.random.Generator | None) -> None:
    found = read_kitti_poses(folder / "poses.txt")
    check_trajectory(Trajectory(np.arange(len(found), dtype=np.float64), found))


def _truth(folder: Path, random: np.random.Generator | None, name: str) -> None:
    check_trajectory(read_groundtruth(folder / name, 0.05 * np.arange(4)))


PATHS = ["/dev/null", "/dev/zero", "/dev/stdin", "/", "", ".", "x" * 300, "a\0b", "\udcff", "~", "/proc/self/mem",
         "/proc/self/environ", "/dev/fd/0", "pipe", "loop", "/etc/passwd", "s/0.png", "calib.txt"]  # fmt: skip


def _places(folder: Path) -> None:
    images(folder / "s", [f"{i}.png" for i in range(3)])
    lines(folder / "calib.txt", [K])
    lines(folder / "times.txt", ["0", "0.1", "0.2"])
    lines(folder / "truth.txt", poses(3))


def _no_mutation(folder: Path, random: np.random.Generator) -> str:
    """Special files beside the valid ones; the options of the case are the mutation."""
    os.mkfifo(folder / "pipe")
    (folder / "loop").symlink_to("loop")
    return "odd paths and options"


def _options(folder: Path, random: np.random.Generator | None) -> None:
    """Open a source whose path and options are sometimes odd places or values."""
    given: dict[str, Any] = {"calib": "calib.txt", "times": "times.txt", "groundtruth": "truth.txt"}
    source = "s"
    if random is not None:
        odd = [str(PATHS[int(i)]) for i in random.integers(len(PATHS), size=4)]
        which = int(random.integers(6))
        if which == 0:
            source = odd[0]
        elif which < 4:
            given[("calib", "times", "groundtruth")[which - 1]] = odd[1]
        elif which == 4:
            given["reader"] = ["video", "tum", "euroc", "kitti", "tartanair", "icl_nuim", "sequence", "folder", "x", "",
                               "a:b", "os:system"][int(random.integers(12))]  # fmt: skip
            source = source if random.random() < 0.5 else odd[0]
        else:
            given |= {"times": None, "fps": [0, -1, float("nan"), 1e308, 1e-320, 10**400, 1][int(random.integers(7))]}
    opened = open_source(source, **given)
    if opened.groundtruth is not None:
        check_trajectory(opened.groundtruth)
    check_frames(opened)


def _odd_images(random: np.random.Generator) -> list[Any]:
    image = picture(0)
    return [image, image[..., 0], image.astype(np.float64), image.astype(np.uint16), image[:10], None, "image", 3.5,
            [], [[1, 2], [3]], {}, b"bytes", image.astype(object), np.zeros((0, 0, 3), np.uint8), image[..., None],
            np.ma.masked_array(image), (1.0,), (1.0, image, 2), ("one", image), (None, image), (np.nan, image),
            (10**400, image), ([1.0], image), (1.0, None), (True, image), np.datetime64("2024-01-01"),
            (np.float32(5), image), image.tolist(), np.zeros((HEIGHT, WIDTH, 4), np.uint8)]  # fmt: skip


def _nothing(folder: Path) -> None:
    lines(folder / "empty.txt", [])


def _odd_stream(folder: Path, random: np.random.Generator) -> str:
    return "odd elements of a stream"


def _stream(folder: Path, random: np.random.Generator | None) -> None:
    items: list[Any] = [picture(i) for i in range(4)]
    options: dict[str, Any] = {"fps": 10.0}
    if random is not None:
        odd = _odd_images(random)
        items[int(random.integers(4))] = odd[int(random.integers(len(odd)))]
        if random.random() < 0.3:
            times = [[0.0, 1.0], [0.0, np.nan, 1.0], ["a"], [None], 3, [2.0, 1.0, 0.0], [10**400], "0123", [[1], [2]]]
            options = {"timestamps": times[int(random.integers(len(times)))]}
        elif random.random() < 0.2:
            options = {"fps": [0, -1, np.nan, "30", None, 10**400, 1e-320][int(random.integers(7))]}
    check_frames(stream(items, Camera(50.0, 51.0, 31.5, 23.5, WIDTH, HEIGHT), **options))


SECRET = "S3cr3t"
SCHEMES = ["rtsp", "rtsps", "http", "https", "RTSP", " rtsp", "rtmp", "ftp", "rstp", "udp", "file", "h264+rtsp", ""]
USERS = ["", "user:{}@", "user:a@{}@", "user:a/{}@", "{}@", "user:{}%40@", "u@v:{}:w@", "user:{}#@", "user:?{}@"]
TAILS = ["", "/", "/live", "/a@b", "/live?token={}", "?access_token={}", "/x?a=1&sig={}&b=2", "/x?password={}#t",
         "/x?api_key={}", "/x;jsessionid={}"]  # fmt: skip


def _odd_address(folder: Path, random: np.random.Generator) -> str:
    scheme, user, tail = (str(part[int(random.integers(len(part)))]) for part in (SCHEMES, USERS, TAILS))
    separator = ["://", "://", "://", ":/", "//"][int(random.integers(5))]
    separator = "://" if scheme in ("", "file") else separator  # else a path, in which everything is a name
    text = f"{scheme}{separator}{user.format(SECRET)}127.0.0.1:1{tail.format(SECRET)}"
    (folder / "empty.txt").write_text(text)
    return text.replace(SECRET, "...")


def _address(folder: Path, random: np.random.Generator | None) -> None:
    """Open an address at which nobody answers: no message holds its secret."""
    address = (folder / "empty.txt").read_text()
    if not address.strip():
        return
    try:
        open_source(address)
    except DvoError as error:
        found: BaseException | None = error
        while found is not None:
            require(SECRET not in str(found), "a secret in a message")
            found = found.__cause__ or found.__context__
        raise


def _one(name: str, file: str, rows: list[str], read: Any) -> Target:
    return Target(name, partial(_write, name=file, rows=rows), read, modules=MODULES)


def _numpy(folder: Path) -> None:
    camera = np.array([[50, 0, 31.5], [0, 51, 23.5], [0, 0, 1]])
    np.savez(folder / "calib.npz", mtx=camera, dist=np.array([[-0.1, 0.01, 0.001, 0.001, 0.0]]), rvecs=np.ones((20, 3)))


def _samples(mark: str) -> list[str]:
    return [mark.join(f"{value:.4f}" for value in (0.01 * k, 0.1, 0.2 * k, 0.3, 0.1, 9.8, 0.2)) for k in range(30)]


def _inertial(folder: Path, random: np.random.Generator | None, name: str = "imu.csv") -> None:
    samples = read_inertial_table(folder / name)
    check_times(samples.timestamps)
    require(np.isfinite(samples.gyro).all() and np.isfinite(samples.accel).all(), "samples not finite")


IMU_CALIBRATIONS = {
    "kalibr": ["rostopic: /imu0", "update_rate: 200.0", "accelerometer_noise_density: 0.002",
               "accelerometer_random_walk: 0.003", "gyroscope_noise_density: 0.0001",
               "gyroscope_random_walk: 0.00002"],
    "camchain": ["cam0:", "  T_cam_imu: [[0, 1, 0, 0.1], [0, 0, 1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]]",
                 "  timeshift_cam_imu: 0.005", "  camera_model: pinhole", "  intrinsics: [50, 51, 31.5, 23.5]"],
    "plain": ["preset: phone", "noise:", "  gyro_bias: 0.5", "noise_factor: 10", "time_offset: -0.01",
              "T_camera_imu: [0.1, 0.2, 0.3, 0, 0, 0, 1]"],
}  # fmt: skip


def _imu_calibration(folder: Path, random: np.random.Generator | None) -> None:
    found = read_imu_calibration(folder / "imu.yaml")
    require(found.noise is None or np.isfinite(list(vars(found.noise).values())).all(), "noise not finite")
    require(found.T_camera_imu is None or np.isfinite(found.T_camera_imu).all(), "pose not finite")
    require(found.time_offset is None or np.isfinite(found.time_offset), "offset not finite")


TARGETS = (
    *(_one(f"calibration_{name}", file, rows, partial(_calibration, name=file + SELECTED.get(name, "")))
      for name, (file, rows) in CALIBRATIONS.items()),
    Target("calibration_numpy", _numpy, partial(_calibration, name="calib.npz"), modules=MODULES),
    _one("times", "times.txt", ["time", *(f"{0.1 * i:.3f}" for i in range(5))], _times),
    _one("times_ns", "times.txt", [str(1_403_636_579_763_555_584 + 50_000_000 * i) for i in range(5)], _times),
    _one("trajectory", "trajectory.txt", ["# text", *poses(6)], _tum),
    _one("kitti_poses", "poses.txt", [f"1 0 0 {0.1 * i} 0 1 0 0 0 0 1 {i}" for i in range(4)], _kitti_poses),
    _one("truth_tum", "t.txt", poses(), partial(_truth, name="t.txt")),
    _one("truth_icl", "t.freiburg", [f"{i + 1} {row.split(maxsplit=1)[1]}" for i, row in enumerate(poses())],
         partial(_truth, name="t.freiburg")),
    _one("truth_kitti", "t.txt", [f"1 0 0 {0.1 * i} 0 1 0 0 0 0 1 {i}" for i in range(4)],
         partial(_truth, name="t.txt")),
    _one("truth_ned", "t.txt", [row.split(maxsplit=1)[1] for row in poses()], partial(_truth, name="t.txt")),
    _one("inertial_table", "imu.csv", ["time [s],gx,gy,gz,ax,ay,az", *_samples(",")], _inertial),
    _one("inertial_rows", "imu.csv", _samples(" "), _inertial),
    _one("inertial_long", "imu.csv", ["sensor,time,x,y,z", *(
        f"{kind},2024-05-01T12:00:00.{10 * k:03}Z,0.1,9.8,0.2" for k in range(20) for kind in ("gyroscope", "acc")
    )], _inertial),
    _one("inertial_export", "log.json", ["[", *(
        f'{{"sensor": "{kind}", "time": "{10**18 + 10**7 * k}", "seconds_elapsed": "0", "z": "0", "y": "9", "x": "1"}},'
        for k in range(20) for kind in ("Gyroscope", "TotalAcceleration")
    ), '{"sensor": "Metadata", "platform": "ios"}]'], partial(_inertial, name="log.json")),
    _one("inertial_json", "data.jsonl", [
        f'{{"time": {0.01 * k}, "sensor": {{"type": "{kind}", "values": [0.1, 9.8, 0.2]}}}}'
        for k in range(20) for kind in ("gyroscope", "accelerometer")
    ], partial(_inertial, name="data.jsonl")),
    *(_one(f"imu_calibration_{name}", "imu.yaml", rows, _imu_calibration) for name, rows in IMU_CALIBRATIONS.items()),
    Target("addresses", _nothing, _address, _odd_address, MODULES),
    Target("options", _places, _options, _no_mutation, MODULES),
    Target("stream", _nothing, _stream, _odd_stream, MODULES),
)  # fmt: skip
