"""ROS 2 without ROS: its messages over Zenoh in the format of rmw_zenoh."""
