"""ROS 2 without ROS: its messages over Zenoh, as rmw_zenoh expects them."""
