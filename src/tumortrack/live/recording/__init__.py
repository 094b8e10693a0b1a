"""Recordings on disk: folders of frames, ROS bags, and what the sink ``recording`` writes.

``folders`` and ``bags`` read shots, ``mcap_file`` and ``frame_folders`` write updates.
"""
