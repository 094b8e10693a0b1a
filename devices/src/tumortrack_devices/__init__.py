"""Cameras, ROS 2, viewers and recordings for tumortrack: kinds of sources, sinks and poses."""
