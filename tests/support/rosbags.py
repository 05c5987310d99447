"""Writer of small ROS bags."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

K = [50.0, 0, 31, 0, 51, 23, 0, 0, 1]
P = [40.0, 0, 30, 0, 0, 41, 22, 0, 0, 0, 1, 0]
PLUMB = [-0.1, 0.01, 0.0, 0.0, 0.0]


class Bag:
    """Writer of a bag: messages of six images ten frames a second from 100 s on, and what is asked for beside them."""

    def __init__(self, path, kind):
        rosbags = pytest.importorskip("rosbags.typesys")
        self.is1 = kind == "bag"
        self.store = rosbags.get_typestore(rosbags.Stores.ROS1_NOETIC if self.is1 else rosbags.Stores.ROS2_JAZZY)
        if self.is1:
            from rosbags.rosbag1 import Writer

            self.writer, self.path = Writer(path), path
        else:
            from rosbags.rosbag2 import StoragePlugin, Writer

            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self.writer, self.path = Writer(path, version=9, storage_plugin=plugin), path
        self.connections = {}

    def __enter__(self):
        self.writer.open()
        return self

    def __exit__(self, *_):
        self.writer.close()

    def header(self, seconds):
        nanoseconds = round(seconds * 1e9)
        stamp = self.store.types["builtin_interfaces/msg/Time"](sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        more = {"seq": 0} if self.is1 else {}
        return self.store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera", **more)

    def write(self, topic, kind, stamp, recorded=None, **fields):
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        message = self.store.types[kind](header=self.header(stamp), **fields)
        pack = self.store.serialize_ros1 if self.is1 else self.store.serialize_cdr
        recorded = stamp + 5 if recorded is None else recorded
        self.writer.write(self.connections[topic], round(recorded * 1e9), pack(message, kind))

    def image(self, topic, rgb, stamp, recorded=None):
        data = np.ascontiguousarray(rgb[..., ::-1]).ravel()
        self.write(topic, "sensor_msgs/msg/Image", stamp, recorded, height=rgb.shape[0], width=rgb.shape[1],
                   encoding="bgr8", is_bigendian=0, step=3 * rgb.shape[1], data=data)  # fmt: skip

    def compressed(self, topic, rgb, stamp):
        data = cv2.imencode(".png", rgb[..., ::-1])[1].ravel()
        self.write(topic, "sensor_msgs/msg/CompressedImage", stamp, format="png", data=data)

    def depth(self, topic, pixels, stamp, encoding):
        self.write(topic, "sensor_msgs/msg/Image", stamp, height=pixels.shape[0], width=pixels.shape[1],
                   encoding=encoding, is_bigendian=0, step=pixels.strides[0],
                   data=pixels.view(np.uint8).ravel())  # fmt: skip

    def info(self, topic, k=K, model="plumb_bob", d=PLUMB, p=P):
        region = self.store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        values = {"d": np.array(d), "k": np.array(k), "r": np.eye(3).ravel(), "p": np.array(p)}
        values = {name.upper() if self.is1 else name: value for name, value in values.items()}
        self.write(topic, "sensor_msgs/msg/CameraInfo", 100.0, height=48, width=64, distortion_model=model,
                   binning_x=0, binning_y=0, roi=region, **values)  # fmt: skip

    def imu(self, topic, stamp):
        vector, turn = self.store.types["geometry_msgs/msg/Vector3"], self.store.types["geometry_msgs/msg/Quaternion"]
        none = np.zeros(9)
        self.write(topic, "sensor_msgs/msg/Imu", stamp,
                   orientation=turn(0.0, 0.0, 0.0, 1.0), orientation_covariance=none,
                   angular_velocity=vector(stamp, 0.2, 0.3), angular_velocity_covariance=none,
                   linear_acceleration=vector(0.0, 0.0, 9.8), linear_acceleration_covariance=none)  # fmt: skip
