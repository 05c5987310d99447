"""Node: images and ``camera_info`` in; odometry, pose, path, transform and status out. docs/live.md describes them.

    python -m dvo_ros.node --ros-args -r image:=/camera/image_raw -r camera_info:=/camera/camera_info

One thread receives messages, the main thread tracks the newest image.
"""

from __future__ import annotations

import os
import queue
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from functools import partial
from pathlib import Path as FilePath

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Transform, TransformStamped, Twist, Vector3
from nav_msgs.msg import Odometry, Path
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data as camera_qos  # best effort
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from std_srvs.srv import Trigger

import dvo
from dvo.data.images.images import used_bits
from dvo.data.readers.ros_images import decode_message, raw_levels
from dvo.data.readers.rosbag import calibration_of_info
from dvo.geometry.undistort import Undistorter
from dvo_ros.base_motion import BaseMotion, BaseState

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # PyPI has no wheel of it
    TFMessage = None

PARAMETERS = {
    "weights": "small",
    "preset": "fast",
    "device": "cpu",
    "image_transport": "raw",
    "odom_frame": "odom",
    "base_frame": "base_link",
    "publish_tf": True,
    "T_base_camera": [0.0, 0.0, 0.0, -0.5, 0.5, -0.5, 0.5],
}
"""Defaults; config/dvo.yaml explains them."""
UNKNOWN = np.eye(6) * 9999.0  # covariance of what is not known
PATH_POSES = 1000
HEADERS = 10  # kept; dvo.stream holds fewer frames back
GRACE = 1.0  # seconds from SIGINT or SIGTERM to the end
LEVELS = {
    dvo.Status.TRACKING: DiagnosticStatus.OK,
    dvo.Status.INITIALISING: DiagnosticStatus.WARN,
    dvo.Status.LOST: DiagnosticStatus.ERROR,
}


class Lens:
    """Camera of a ``camera_info``, and the camera of its images without distortion.

    Args:
        info: the message.
        topic: of the images: those of a topic with ``rect`` in its last part have the projection matrix P.
        image: one of them.

    Raises:
        DvoError: a camera that is not calibrated, a distortion model that is not known, or another size.
    """

    def __init__(self, info: CameraInfo, topic: str, image: np.ndarray) -> None:
        calibration = calibration_of_info(info, topic.rpartition("/")[2], FilePath("camera_info"))
        self.size = image.shape
        camera = calibration.camera(image.shape[1], image.shape[0])
        self._undistorter = Undistorter(camera) if camera.needs_undistortion else None
        self.camera = self._undistorter.camera if self._undistorter else camera
        self._numbers = numbers_of(info)

    def fits(self, info: CameraInfo, image: np.ndarray) -> bool:
        """True for images of this size with the same calibration."""
        return image.shape == self.size and numbers_of(info) == self._numbers

    def undistorted(self, image: np.ndarray) -> np.ndarray:
        """Image of :attr:`camera`."""
        return self._undistorter(image) if self._undistorter else image


class Tracker(Node):
    """The node. Weights are loaded before anything is subscribed to.

    Raises:
        DvoError: parameters that are not valid.
    """

    def __init__(self) -> None:
        super().__init__("dvo")
        given = {name: self.declare_parameter(name, default).value for name, default in PARAMETERS.items()}
        kinds = {"raw": (Image, ""), "compressed": (CompressedImage, "/compressed")}
        transport = given["image_transport"]
        if transport not in kinds:
            raise dvo.DvoError(f"unknown: {transport}", field="image_transport", remedy="give raw or compressed")
        self.odom_frame, self.base_frame = given["odom_frame"], given["base_frame"]
        self.motion = BaseMotion(given["T_base_camera"])
        preset = {"preset": given["preset"]} if given["preset"] else {}
        self.load = partial(dvo.load, given["weights"], device=given["device"], **preset)
        self.odometry = self.load()
        self.lock = threading.Lock()  # a reset is between two frames
        self.info: CameraInfo | None = None
        self.lens: Lens | None = None
        self.bits = 0
        self.path: deque[PoseStamped] = deque(maxlen=PATH_POSES)
        self.headers: dict[int, Header] = {}
        self.arrived: queue.SimpleQueue = queue.SimpleQueue()
        # The only queue, of one image: DDS hands on all at once, so that it is known what was received and dropped.
        self.live = dvo.LiveFrames(iter(self.arrived.get, None), interrupt=lambda: self.arrived.put(None))

        self.odometries = self.create_publisher(Odometry, "~/odom", 10)
        self.poses = self.create_publisher(PoseStamped, "~/pose", 10)
        self.paths = self.create_publisher(Path, "~/path", 1)
        self.statuses = self.create_publisher(DiagnosticArray, "~/status", 10)
        self.transforms = self.create_publisher(TFMessage, "/tf", 100) if TFMessage and given["publish_tf"] else None
        if given["publish_tf"] and TFMessage is None:
            self.get_logger().warning("no package tf2_msgs: the transform is not published")
        self.create_service(Trigger, "~/reset", self.on_reset)
        # As in image_transport, one remapping of the base topic serves both kinds.
        self.topic = self.resolve_topic_name("image")
        kind, ending = kinds[transport]
        self.create_subscription(CameraInfo, "camera_info", self.on_info, camera_qos)
        self.create_subscription(kind, self.topic + ending, self.on_image, camera_qos)
        topics = f"{self.topic}{ending} and {self.resolve_topic_name('camera_info')}"
        self.get_logger().info(f"waiting for {topics}")

    def on_info(self, info: CameraInfo) -> None:
        self.info = info

    def on_image(self, message: Image | CompressedImage) -> None:
        if not seconds(message.header):  # the driver states no time
            message.header.stamp = self.get_clock().now().to_msg()
        self.arrived.put((seconds(message.header), message))

    def on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.reset()
        response.success = True
        return response

    def reset(self) -> None:
        """Begin a new recording: ``odom`` is where ``base_link`` is at the next pose."""
        with self.lock:
            self.odometry = self.load()
            self.motion.reset()
            self.path.clear()

    def run(self) -> None:
        """Track the newest images until the node is stopped."""
        for frame in dvo.stream(self.frames()):
            header = self.headers[frame.index]
            try:
                with self.lock:
                    estimate = self.odometry.track(frame)
                    state = self.motion.update(estimate)
                    if state is not None:
                        self.publish(header, state)
            except dvo.DvoError as error:
                self.refuse(header, error)
                continue
            text = f"{estimate.status}: {estimate.reason}" if estimate.reason else f"{estimate.status}"
            confidence = f"{estimate.confidence:.3f}"
            self.tell(header, LEVELS[estimate.status], text, segment=estimate.segment, confidence=confidence)

    def frames(self) -> Iterator[dvo.Frame]:
        """Frames of the newest images; images that cannot be used are told."""
        index = -1
        for stamp, message in self.live:
            reception = self.live.reception
            index += 1 + reception.dropped
            try:
                image, lens = self.decoded(message)
            except dvo.DvoError as error:
                self.refuse(message.header, error)
                continue
            self.headers[index] = message.header
            if len(self.headers) > HEADERS:
                del self.headers[next(iter(self.headers))]
            silence = reception.silence if reception.dropped else None
            yield dvo.Frame(index, stamp, lens.undistorted(image), lens.camera, silence=silence)

    def decoded(self, message: Image | CompressedImage) -> tuple[np.ndarray, Lens]:
        """RGB image and its lens. Another calibration begins a new recording."""
        info = self.info
        if info is None:
            raise dvo.DvoError("no camera_info yet")
        if isinstance(message, Image):
            self.bits = max(self.bits, used_bits([raw_levels(message, self.topic)]))
        image = decode_message(message, self.topic, self.bits or 16)
        if image is None:
            raise dvo.DvoError("damaged image")
        if self.lens is None or not self.lens.fits(info, image):
            lens = Lens(info, self.topic, image)
            if self.lens is not None:
                self.get_logger().warning("another calibration: a new recording begins")
                self.reset()
            self.lens = lens
        return image, self.lens

    def publish(self, header: Header, state: BaseState) -> None:
        """Odometry, pose, path and transform of ``base_link``."""
        x, y, z, *quaternion = state.T_odom_base.tolist()
        pose = Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(**dict(zip("xyzw", quaternion, strict=True))))
        here = Header(stamp=header.stamp, frame_id=self.odom_frame)
        odometry = Odometry(header=here, child_frame_id=self.base_frame)
        odometry.pose.pose = pose
        odometry.pose.covariance = (UNKNOWN if state.covariance is None else state.covariance).ravel()
        if state.twist is not None:
            linear, angular = (Vector3(**dict(zip("xyz", v.tolist(), strict=True))) for v in np.split(state.twist, 2))
            odometry.twist.twist = Twist(linear=linear, angular=angular)
        odometry.twist.covariance = UNKNOWN.ravel()  # the errors of the two poses are not independent
        self.odometries.publish(odometry)
        self.path.append(PoseStamped(header=here, pose=pose))
        self.poses.publish(self.path[-1])
        if self.paths.get_subscription_count():
            self.paths.publish(Path(header=here, poses=list(self.path)))
        if self.transforms is not None:
            move = Transform(translation=Vector3(x=x, y=y, z=z), rotation=pose.orientation)
            transform = TransformStamped(header=here, child_frame_id=self.base_frame, transform=move)
            self.transforms.publish(TFMessage(transforms=[transform]))

    def refuse(self, header: Header, error: dvo.DvoError) -> None:
        """Tell of an image that is not tracked."""
        self.get_logger().warning(error.message, throttle_duration_sec=5.0)
        self.tell(header, DiagnosticStatus.ERROR, f"image not used: {error.message}")

    def tell(self, header: Header, level: bytes, message: str, **values: object) -> None:
        """Publish the status at an image."""
        counts = self.live.counts
        values |= {"received": counts.received, "dropped": counts.dropped}
        status = DiagnosticStatus(level=level, name=self.get_fully_qualified_name(), message=message)
        status.hardware_id = header.frame_id
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        self.statuses.publish(DiagnosticArray(header=header, status=[status]))


def numbers_of(info: CameraInfo) -> tuple[object, ...]:
    """What a calibration consists of."""
    return info.width, info.height, info.distortion_model, *info.d, *info.k, *info.p


def seconds(header: Header) -> float:
    """Time of a message."""
    return header.stamp.sec + header.stamp.nanosec * 1e-9


def receive(node: Tracker) -> None:
    """Take messages until the end of the process: SIGINT or SIGTERM."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        while rclpy.ok():
            executor.spin_once(timeout_sec=0.5)  # rclpy wakes a waiting thread before the context is shut down
    except ExternalShutdownException:
        pass
    finally:
        node.live.stop()


def leave(ended: threading.Event) -> None:
    """End the process after SIGINT or SIGTERM, whatever it is doing: it has nothing to write."""
    while rclpy.ok():
        time.sleep(0.1)
    if not ended.wait(GRACE):
        os._exit(0)


def main() -> None:
    """Run the node."""
    rclpy.init()
    ended = threading.Event()
    threading.Thread(target=leave, args=(ended,), daemon=True).start()
    try:
        node = Tracker()
        receiving = threading.Thread(target=receive, args=(node,), daemon=True)
        receiving.start()
        node.run()
        receiving.join(1.0)
        if rclpy.ok():
            sys.exit(1)  # an error has ended that thread
    except dvo.DvoError as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        pass
    except Exception:
        if rclpy.ok():  # otherwise a message of the last frame came too late
            raise
    finally:
        ended.set()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
