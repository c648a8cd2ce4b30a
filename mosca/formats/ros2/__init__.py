"""ROS 2: bags (MCAP) of markers, poses, camera properties and images."""
