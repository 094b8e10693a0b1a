"""Recordings on disk: folders of frames, ROS bags, and what the sink ``recording`` writes."""
