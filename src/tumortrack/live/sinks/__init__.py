"""Sinks of the live loop: one file per kind.

A sink's configuration is what the command line writes as ``kind:target?key=value``; its ``open``
makes the sink (``live.values.Sink``). To add one: write its file, add its configuration here.
"""

from tumortrack.live.sinks.openigtlink import OpenIgtLink
from tumortrack.live.sinks.recording import Recording
from tumortrack.live.sinks.ros1 import Ros1
from tumortrack.live.sinks.ros2 import Ros2
from tumortrack.live.sinks.ur import Ur
from tumortrack.live.sinks.viewer import Viewer

SINKS = (Viewer, Recording, Ros2, Ros1, OpenIgtLink, Ur)
