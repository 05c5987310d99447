"""ament_python package: colcon build --packages-select dvo_ros."""

from setuptools import setup

setup(
    name="dvo_ros",
    version="0.3.0",
    packages=["dvo_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/dvo_ros"]),
        ("share/dvo_ros", ["package.xml"]),
        ("share/dvo_ros/launch", ["launch/dvo.launch.xml"]),
        ("share/dvo_ros/config", ["config/dvo.yaml"]),
    ],
    entry_points={"console_scripts": ["node = dvo_ros.node:main"]},
)
