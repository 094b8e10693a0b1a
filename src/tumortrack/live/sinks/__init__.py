"""Sinks of the live loop: one file per kind.

A sink's configuration is what the command line writes as ``kind:target?key=value``; its ``open``
makes the sink (``live.values.Sink``). To add one: write its file, add its configuration here.
"""

from tumortrack.live.sinks.openigtlink import OpenIgtLinkSinkConfig
from tumortrack.live.sinks.recording import RecordingSinkConfig
from tumortrack.live.sinks.ros1 import Ros1SinkConfig
from tumortrack.live.sinks.ros2 import Ros2SinkConfig
from tumortrack.live.sinks.ur import UrSinkConfig
from tumortrack.live.sinks.viewer import ViewerSinkConfig

SINKS = (
    ViewerSinkConfig,
    RecordingSinkConfig,
    Ros2SinkConfig,
    Ros1SinkConfig,
    OpenIgtLinkSinkConfig,
    UrSinkConfig,
)
