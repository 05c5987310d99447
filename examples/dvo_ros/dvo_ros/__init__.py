"""ROS 2 node of dvo."""
