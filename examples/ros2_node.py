"""ROS 2 node: rectified images in, poses out on `pose` (needs rclpy, cv_bridge; it was not run where it was written).

python examples/ros2_node.py --ros-args -r image:=/camera/image_rect -r camera_info:=/camera/camera_info
"""

import cv_bridge
import rclpy.node
from geometry_msgs.msg import PoseStamped
from rclpy.qos import qos_profile_sensor_data as newest  # best effort, few messages kept
from sensor_msgs.msg import CameraInfo, Image

import dvo


class Tracker(rclpy.node.Node):
    def __init__(self) -> None:
        super().__init__("dvo")
        self.odometry, self.camera, self.index = dvo.load("small", preset="fast"), None, 0
        self.poses = self.create_publisher(PoseStamped, "pose", 10)
        self.create_subscription(CameraInfo, "camera_info", self.on_info, newest)
        self.create_subscription(Image, "image", self.on_image, newest)

    def on_info(self, info: CameraInfo) -> None:  # P is that of rectified images
        self.camera = dvo.Camera(info.p[0], info.p[5], info.p[2], info.p[6], info.width, info.height)

    def on_image(self, image: Image) -> None:
        if self.camera is not None:
            stamp, rgb = image.header.stamp, cv_bridge.CvBridge().imgmsg_to_cv2(image, "rgb8")
            estimate = self.odometry.track(dvo.Frame(self.index, stamp.sec + stamp.nanosec / 1e9, rgb, self.camera))
            self.index += 1
            if estimate.status == dvo.Status.TRACKING:
                found = PoseStamped(header=image.header)
                found.header.frame_id, p, q = f"dvo_{estimate.segment}", found.pose.position, found.pose.orientation
                p.x, p.y, p.z, q.x, q.y, q.z, q.w = estimate.pose_wc.tolist()
                self.poses.publish(found)


rclpy.init()
rclpy.spin(Tracker())
