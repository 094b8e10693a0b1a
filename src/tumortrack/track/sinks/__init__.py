"""Sinks of the live loop: one file per kind.

A sink's configuration is what the command line writes as ``kind:target?key=value``; its ``open``
makes the sink (``track.live.Sink``). To add one: write its file, add its configuration here.
"""

from tumortrack.track.sinks.openigtlink import OpenIgtLink
from tumortrack.track.sinks.recording import Recording
from tumortrack.track.sinks.ros1 import Ros1
from tumortrack.track.sinks.ros2 import Ros2
from tumortrack.track.sinks.ur import Ur
from tumortrack.track.sinks.viewer import Viewer

SINKS = (Viewer, Recording, Ros2, Ros1, OpenIgtLink, Ur)
