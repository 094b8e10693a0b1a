"""Sources of the live loop: one file per kind.

A source's configuration is what the command line writes as ``kind:target?key=value``; its
``open`` makes the source (``live.values.Source``). To add one: write its file, add its
configuration here.
"""

from tumortrack.live.sources.realsense import RealSenseSourceConfig
from tumortrack.live.sources.recording import RecordingSourceConfig
from tumortrack.live.sources.ros1 import Ros1SourceConfig
from tumortrack.live.sources.ros2 import Ros2SourceConfig
from tumortrack.live.sources.virtual import VirtualSourceConfig

SOURCES = (
    VirtualSourceConfig,
    RealSenseSourceConfig,
    RecordingSourceConfig,
    Ros2SourceConfig,
    Ros1SourceConfig,
)
