"""The ROS 2 package ``examples/dvo_ros``: its node plays a clip in a process of its own; the rest needs no ROS."""

from __future__ import annotations

import ast
import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
import xml.etree.ElementTree as ET
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st

import dvo
from dvo.geometry.undistort import Undistorter
from dvo.synth import make_sequence
from dvo_ros.base_motion import BaseMotion

PACKAGE = Path(__file__).resolve().parents[1] / "examples" / "dvo_ros"
NODE = PACKAGE / "dvo_ros" / "node.py"
FORWARD = np.array([0.0, 0, 0, -0.5, 0.5, -0.5, 0.5])
"""Camera (z forward) to base (x forward)."""
LEVER = np.array([0.3, -0.1, 0.2, -0.5, 0.5, -0.5, 0.5])
DOMAIN = 1 + os.getpid() % 100
PATIENCE = 300.0  # seconds; machines are shared, and the first run compiles
vectors = st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6).map(np.array)


def pose(xi: np.ndarray) -> np.ndarray:
    return dvo.se3.exp(torch.from_numpy(xi)).numpy()


def compose(*poses: np.ndarray) -> np.ndarray:
    total = torch.from_numpy(poses[0])
    for one in poses[1:]:
        total = dvo.se3.compose(total, torch.from_numpy(one))
    return total.numpy()


def tangent(one: np.ndarray) -> np.ndarray:
    return dvo.se3.log(torch.from_numpy(one)).numpy()


def inverse(one: np.ndarray) -> np.ndarray:
    return dvo.se3.inverse(torch.from_numpy(one)).numpy()


def tracked(seconds: float, pose_wc: np.ndarray | None, **more: object) -> dvo.Estimate:
    return dvo.Estimate(seconds, pose_wc, dvo.Status.LOST if pose_wc is None else dvo.Status.TRACKING, **more)


# --- frames and covariance -------------------------------------------------------------------------------------------


@pytest.mark.long
@given(first=vectors, step=vectors, extrinsics=vectors)
def test_base_moves_as_the_camera_does(first, step, extrinsics):
    """The first pose is the identity; the mean velocity leads from one pose to the next."""
    T_base_camera, motion = pose(extrinsics), BaseMotion(pose(extrinsics))
    assert np.allclose(motion.update(tracked(1.0, pose(first))).T_odom_base, [0, 0, 0, 0, 0, 0, 1])
    state = motion.update(tracked(1.5, compose(pose(first), pose(step))))
    truth = compose(T_base_camera, pose(step), inverse(T_base_camera))
    assert np.allclose(tangent(compose(inverse(truth), state.T_odom_base)), 0, atol=1e-6)
    assert np.allclose(pose(0.5 * state.twist)[:3], truth[:3], atol=1e-6)


def test_forward_is_x_left_is_y_and_up_is_z():
    motion = BaseMotion(FORWARD)
    motion.update(tracked(0.0, np.array([0.0, 0, 0, 0, 0, 0, 1])))
    state = motion.update(tracked(1.0, np.array([-2.0, -3, 1, 0, -np.sin(0.1), 0, np.cos(0.1)])))
    assert np.allclose(state.T_odom_base, [1, 2, 3, 0, 0, np.sin(0.1), np.cos(0.1)])  # a turn to the left


@pytest.mark.long
@given(xi=vectors, extrinsics=vectors, direction=vectors)
def test_covariance_is_that_of_position_and_turn_in_the_axes_of_odom(xi, extrinsics, direction):
    """The covariance of one known error is its outer product."""
    small = 1e-4 * direction
    start, T_wc = pose(np.zeros(6)), pose(xi)
    states = []
    for T_wc_found in (T_wc, compose(T_wc, pose(small))):
        motion = BaseMotion(pose(extrinsics))
        motion.update(tracked(0.0, start))
        states.append(motion.update(tracked(1.0, T_wc_found, covariance=np.outer(small, small))))
    found, moved = (state.T_odom_base for state in states)
    turn = compose(np.r_[np.zeros(3), moved[3:]], inverse(np.r_[np.zeros(3), found[3:]]))
    error = np.concatenate([moved[:3] - found[:3], tangent(turn)[3:]])
    assert np.allclose(states[0].covariance, np.outer(error, error), atol=3e-11)  # 1e-4 cubed, times some


def test_a_new_segment_goes_on_where_the_last_ended():
    motion = BaseMotion(LEVER)
    motion.update(tracked(0.0, pose(np.zeros(6))))
    last = motion.update(tracked(1.0, pose(np.full(6, 0.2))))
    assert motion.update(tracked(2.0, None, reason="black image")) is None
    begun = motion.update(tracked(3.0, pose(np.full(6, -1.0)), segment=1))
    assert np.allclose(begun.T_odom_base, last.T_odom_base) and begun.twist is None
    joined = motion.update(tracked(4.0, pose(np.full(6, 0.7)), segment=1, recovered=True))
    assert np.allclose(joined.T_odom_base, last.T_odom_base) and joined.twist is None
    motion.reset()
    assert np.allclose(motion.update(tracked(5.0, pose(np.full(6, 0.4)))).T_odom_base, [0, 0, 0, 0, 0, 0, 1])


def test_extrinsics_that_are_no_pose_are_refused():
    with pytest.raises(dvo.DvoError, match="T_base_camera: the quaternion has the length 2"):
        BaseMotion([0, 0, 0, 0, 0, 0, 2])


# --- package ---------------------------------------------------------------------------------------------------------


def test_the_files_of_the_package_agree():
    """There is no colcon here: what one file names is in the others."""
    tree = ast.parse(NODE.read_text(encoding="utf-8"))
    manifest = ET.parse(PACKAGE / "package.xml").getroot()
    name, depends = manifest.findtext("name"), {tag.text for tag in manifest.iter("exec_depend")}
    assert manifest.findtext("version") == dvo.__version__
    imported = {node.module.partition(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert {each for each in imported if each.endswith(("_msgs", "_srvs"))} | {"rclpy"} <= depends | {"std_msgs"}
    setup = ast.parse((PACKAGE / "setup.py").read_text(encoding="utf-8"))
    said = {k.arg: ast.literal_eval(k.value) for call in ast.walk(setup) if isinstance(call, ast.Call)
            for k in call.keywords}  # fmt: skip
    assert said["name"] == name and said["version"] == dvo.__version__ and (PACKAGE / "resource" / name).is_file()
    assert all((PACKAGE / file).is_file() for _, files in said["data_files"] for file in files)
    assert f"$base/lib/{name}" in (PACKAGE / "setup.cfg").read_text()
    (script,) = said["entry_points"]["console_scripts"]
    launch = ET.parse(PACKAGE / "launch" / "dvo.launch.xml").getroot().find("node")
    assert launch.get("pkg") == name and script == f"{launch.get('exec')} = dvo_ros.node:main"
    used = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
    assert {remap.get("from") for remap in launch.iter("remap")} <= used
    defaults = next(node.value for node in tree.body if isinstance(node, ast.Assign)
                    and ast.unparse(node.targets[0]) == "PARAMETERS")  # fmt: skip
    config = yaml.safe_load((PACKAGE / "config" / "dvo.yaml").read_text())
    assert config["/**"]["ros__parameters"] == ast.literal_eval(defaults)


# --- node ------------------------------------------------------------------------------------------------------------


class Robot:
    """Camera and listener of a node ``dvo`` that runs in a process of its own."""

    def __init__(self, folder: Path, lens: dvo.Camera) -> None:
        import diagnostic_msgs.msg
        import geometry_msgs.msg
        import nav_msgs.msg
        import rclpy
        import sensor_msgs.msg
        import std_srvs.srv
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import qos_profile_sensor_data as camera_qos
        from rclpy.signals import SignalHandlerOptions

        self.lens, self.messages = lens, sensor_msgs.msg
        environment = {**os.environ, "ROS_DOMAIN_ID": str(DOMAIN), "ROS_LOG_DIR": str(folder)}
        environment["PYTHONPATH"] = os.pathsep.join(map(str, (PACKAGE, PACKAGE.parents[1])))
        self.log = folder / "node.txt"
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "dvo_ros.node", "--ros-args", "--params-file", PACKAGE / "config" / "dvo.yaml",
                 "-r", "image:=/camera/image", "-r", "camera_info:=/camera/camera_info"],
                env=environment, stdout=log, stderr=log,
            )  # fmt: skip
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=DOMAIN, signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node("robot", context=self.context)
        self.images = self.node.create_publisher(sensor_msgs.msg.Image, "/camera/image", camera_qos)
        self.infos = self.node.create_publisher(sensor_msgs.msg.CameraInfo, "/camera/camera_info", camera_qos)
        self.heard: dict[str, list] = {"odom": [], "pose": [], "path": [], "status": []}
        for topic, kind in (("odom", nav_msgs.msg.Odometry), ("pose", geometry_msgs.msg.PoseStamped),
                            ("path", nav_msgs.msg.Path), ("status", diagnostic_msgs.msg.DiagnosticArray)):  # fmt: skip
            self.node.create_subscription(kind, f"/dvo/{topic}", self.heard[topic].append, 50)
        self.reset_client = self.node.create_client(std_srvs.srv.Trigger, "/dvo/reset")
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.thread = threading.Thread(target=self.spin, daemon=True)
        self.thread.start()

    def spin(self) -> None:
        from rclpy.executors import ExternalShutdownException

        with contextlib.suppress(ExternalShutdownException):
            while self.context.ok():
                self.executor.spin_once(timeout_sec=0.2)

    def close(self) -> int:
        """End the node as a container does, and give its exit status."""
        self.process.send_signal(signal.SIGTERM)
        try:
            return self.process.wait(PATIENCE)
        finally:
            self.process.kill()
            self.context.try_shutdown()
            self.thread.join(PATIENCE)

    def until(self, done, what: str):
        """Wait for a value that is true."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            if found := done():
                return found
            assert self.process.poll() is None, self.log.read_text()
            time.sleep(0.005)
        raise AssertionError(f"no {what}\n{self.log.read_text()}")

    def show(self, seconds: float, image: np.ndarray) -> str:
        """Send an image, and give the message of the status that belongs to it."""
        height, width = image.shape[:2]
        message = self.messages.Image(height=height, width=width, encoding="rgb8", step=3 * width)
        message.data = image.tobytes()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(round(seconds * 1e9), 10**9)
        again = 0.0

        def answers():
            nonlocal again
            if time.monotonic() > again:  # best effort: a message may be lost
                self.images.publish(message)
                again = time.monotonic() + 20.0
            return [told for told in list(self.heard["status"]) if told.header.stamp == message.header.stamp]

        return self.until(answers, f"status at {seconds} s")[0].status[0].message

    def calibrate(self) -> None:
        """Send the calibration until the node has it."""
        camera = self.lens
        info = self.messages.CameraInfo(width=camera.width, height=camera.height, distortion_model="plumb_bob")
        info.d, info.k = [*camera.coefficients, 0.0], camera.matrix.ravel()
        self.until(lambda: self.images.get_subscription_count() and self.infos.get_subscription_count(), "node")
        blank = np.zeros((camera.height, camera.width, 3), np.uint8)
        for attempt in range(1000):
            if "no camera_info yet" not in self.show(1 + 0.01 * attempt, blank):
                return
            self.infos.publish(info)


@pytest.fixture(scope="module")
def ros(tmp_path_factory):
    """Robots, each with a node, that are closed in the end."""
    for package in ("rclpy", "diagnostic_msgs.msg", "nav_msgs.msg", "sensor_msgs.msg", "std_srvs.srv"):
        pytest.importorskip(package, reason="ROS 2 is not installed: pip install 'dvo[ros2]' (Python 3.11)")
    before = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE")
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    yield lambda lens: Robot(tmp_path_factory.mktemp("ros"), lens)
    if before is None:
        del os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"]


@pytest.mark.ros
def test_a_clip_played_through_the_node_comes_back_as_poses(ros):
    """Images of a lens with distortion; poses of the base, the reset, and the end by SIGTERM."""
    clip = make_sequence(3, frames=24, height=120, width=160, fps=8.0, family="room", kind="handheld", lens="radtan")
    images = [(10.0 + frame.timestamp, frame.image, frame.camera) for frame in clip]
    robot = ros(images[0][2])
    try:
        robot.calibrate()
        told = [robot.show(seconds, image) for seconds, image, _ in images]
        assert told[0].startswith("initialising: ") and set(told[12:]) == {"tracking"}
        count = told.count("tracking")
        for topic in ("odom", "pose", "path"):
            robot.until(lambda topic=topic: len(robot.heard[topic]) == count, topic)
        assert len(robot.heard["path"][-1].poses) == count
        check_odometry(robot.heard["odom"], clip, count)
        for odometry, stamped in zip(robot.heard["odom"], robot.heard["pose"], strict=True):
            assert stamped.pose == odometry.pose.pose and stamped.header == odometry.header

        assert robot.show(13.5, images[0][1][:60]).startswith("image not used: calibration is for 160x120")
        answer = robot.reset_client.call_async(robot.reset_client.srv_type.Request())
        assert robot.until(lambda: answer.done() and answer.result(), "answer").success
        assert robot.show(14.0, images[0][1]).startswith("initialising")
    finally:
        status = robot.close()
    assert status == 0, robot.log.read_text()


@pytest.mark.ros
def test_the_node_ends_whatever_it_is_doing(ros, tmp_path):
    """A frame that never ends stands for one that takes long, or for weights that are being loaded."""
    waiting = """
import os, signal, threading
import rclpy
from dvo_ros import node
def wait_for_ever(self):
    os.kill(os.getpid(), signal.SIGTERM)
    threading.Event().wait()
node.Tracker.__init__ = wait_for_ever
node.main()
"""
    environment = {**os.environ, "ROS_DOMAIN_ID": str(DOMAIN), "ROS_LOG_DIR": str(tmp_path)}
    environment["PYTHONPATH"] = os.pathsep.join(map(str, (PACKAGE, PACKAGE.parents[1])))
    assert subprocess.run([sys.executable, "-c", waiting], env=environment, timeout=PATIENCE).returncode == 0


def check_odometry(odometries, clip, count):
    """Against the truth, aligned by the first pose and a scale."""
    headers = {(odometry.header.frame_id, odometry.child_frame_id) for odometry in odometries}
    assert headers == {("odom", "base_link")}
    times = np.array([o.header.stamp.sec + o.header.stamp.nanosec * 1e-9 for o in odometries]) - 10.0
    truth = clip.groundtruth
    assert np.allclose(times, truth.timestamps[-count:], atol=1e-8)
    right = dvo.base_trajectory(dvo.Trajectory(times, truth.poses_wc[-count:]), FORWARD)
    poses = np.array([[getattr(part, axis) for part, axes in ((o.pose.pose.position, "xyz"),
                                                              (o.pose.pose.orientation, "xyzw")) for axis in axes]
                      for o in odometries])  # fmt: skip
    turns = [tangent(compose(inverse(a), b))[3:] for a, b in zip(poses, right.poses_wc, strict=True)]
    assert np.rad2deg(np.linalg.norm(turns, axis=1)).max() < 2.0
    found, wanted = poses[:, :3], right.positions
    scale = (found * wanted).sum() / (found**2).sum()
    assert np.linalg.norm(scale * found - wanted) < 0.2 * np.linalg.norm(wanted)
    covariances = np.array([o.pose.covariance for o in odometries]).reshape(-1, 6, 6)
    assert np.allclose(covariances, covariances.swapaxes(1, 2)) and np.linalg.eigvalsh(covariances).min() >= 0
    assert np.median(np.sqrt(covariances[:, 5, 5])) < 0.05  # radians, of the heading
    assert odometries[0].twist.twist.linear.x == 0 and odometries[-1].twist.twist.linear.x != 0


@pytest.fixture
def tracker(ros, given):
    """Node in this process, for compressed images; its odometry knows the answer."""
    import rclpy

    from dvo_ros.node import Tracker

    given(motion=lambda seconds: [0.0, 0, seconds, 0, 0, 0, 1], lost=(4,))
    remapped = ["-r", "image:=/front/image", "-r", "camera_info:=/front/camera_info"]
    rclpy.init(args=["--ros-args", "-p", "image_transport:=compressed", *remapped], domain_id=DOMAIN)
    yield Tracker()
    rclpy.shutdown()


def play(tracker, *messages):
    """Status of each image, which are tracked one after the other."""
    told, rest = [], iter(messages)

    def go_on():
        message = next(rest, None)
        if hasattr(message, "distortion_model"):
            tracker.on_info(message)
            go_on()
        else:
            tracker.arrived.put(message) if message is None else tracker.on_image(message)

    def hear(array):
        told.append(array.status[0])
        go_on()

    tracker.statuses = SimpleNamespace(publish=hear)
    go_on()
    tracker.run()
    return told


@pytest.mark.ros
def test_compressed_images_the_transform_and_what_is_not_tracked(tracker, monkeypatch):
    """There is no tf2_msgs here: what would be published is looked at."""
    from diagnostic_msgs.msg import DiagnosticStatus
    from sensor_msgs.msg import CameraInfo, CompressedImage
    from std_msgs.msg import Header

    from dvo_ros import node

    jpeg = cv2.imencode(".jpg", np.full((48, 64, 3), 99, np.uint8))[1].tobytes()

    def image(seconds, data=jpeg):
        header = Header(frame_id="lens")
        header.stamp.sec = seconds
        return CompressedImage(header=header, format="jpeg", data=data)

    def info(focal):
        return CameraInfo(width=64, height=48, k=[focal, 0.0, 31.5, 0.0, focal, 23.5, 0.0, 0.0, 1.0])

    assert {each.topic_name for each in tracker.subscriptions} >= {"/front/image/compressed", "/front/camera_info"}
    moves, odometries = [], []
    monkeypatch.setattr(node, "TFMessage", lambda transforms: transforms)
    tracker.transforms = SimpleNamespace(publish=moves.extend)
    tracker.odometries = SimpleNamespace(publish=odometries.append)
    told = play(tracker, image(1), info(50.0), image(2), image(3, b"\xff\xd8 cut"), image(4), image(5), info(60.0),
                image(6), image(0))  # fmt: skip
    assert [each.message for each in told] == [
        "image not used: no camera_info yet", "tracking", "image not used: damaged image", "tracking",
        "lost: black image", "tracking", "tracking",
    ]  # fmt: skip
    assert [each.level for each in told][1:5] == [
        DiagnosticStatus.OK, DiagnosticStatus.ERROR, DiagnosticStatus.OK, DiagnosticStatus.ERROR,
    ]  # fmt: skip
    assert {each.hardware_id for each in told} == {"lens"}
    assert [move.transform.translation.x for move in moves[:3]] == [0.0, 2.0, 0.0]  # from 60.0 on a new recording
    assert len(tracker.path) == 2 and moves[-1].header.stamp.sec > 1_000_000_000  # without a stamp: that of arrival
    for move, odometry in zip(moves, odometries, strict=True):
        there, turn = odometry.pose.pose.position, odometry.pose.pose.orientation
        assert (move.header, move.child_frame_id) == (odometry.header, "base_link")
        assert (move.transform.translation.x, move.transform.rotation) == (there.x, turn)
    assert odometries[1].twist.twist.linear.x == pytest.approx(1.0) and odometries[1].pose.covariance[0] == 9999


@pytest.mark.ros
@pytest.mark.parametrize(("model", "d", "lens"), [
    ("plumb_bob", [-0.1, 0.01, 0.001, 0.002, 0.0], ("radtan", (-0.1, 0.01, 0.001, 0.002, 0.0))),
    ("equidistant", [0.01, -0.006, 0.003, -0.001], ("fisheye", (0.01, -0.006, 0.003, -0.001))),
    ("rational_polynomial", [0.1, 0.0, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0], ("radtan", (0.1, 0, 0, 0, 0, 0.2, 0, 0))),
])  # fmt: skip
def test_images_lose_their_distortion(ros, model, d, lens):
    """By the model of ``camera_info``; those of a rectified topic have the projection matrix, and none."""
    from sensor_msgs.msg import CameraInfo

    from dvo_ros.node import Lens

    info = CameraInfo(width=160, height=120, distortion_model=model, d=d)
    info.k = [80.0, 0, 79, 0, 81, 60, 0, 0, 1]
    info.p = [70.0, 0, 78, 0, 0, 71, 59, 0, 0, 0, 1, 0]
    image = np.random.default_rng(0).integers(0, 255, (120, 160, 3), dtype=np.uint8)
    right = Undistorter(dvo.Camera(80.0, 81.0, 79.0, 60.0, 160, 120, *lens))
    found = Lens(info, "/camera/image_raw", image)
    assert found.camera == right.camera and np.array_equal(found.undistorted(image), right(image))
    assert found.fits(info, image) and not found.fits(info, image[:60])
    rectified = Lens(info, "/camera/image_rect_color", image)
    assert rectified.camera == dvo.Camera(70.0, 71.0, 78.0, 59.0, 160, 120)
    assert np.array_equal(rectified.undistorted(image), image)
    info.k = [0.0] * 9
    assert not found.fits(info, image)
    with pytest.raises(dvo.DvoError, match="is not calibrated"):
        Lens(info, "/camera/image_raw", image)
