"""Sources of the live loop: one file per kind.

A source's configuration is what the command line writes as ``kind:target?key=value``; its
``open`` makes the source (``live.values.Source``). To add one: write its file, add its
configuration here.
"""

from tumortrack.live.sources.realsense import RealSense
from tumortrack.live.sources.recording import Recording
from tumortrack.live.sources.ros1 import Ros1
from tumortrack.live.sources.ros2 import Ros2
from tumortrack.live.sources.virtual import Virtual

SOURCES = (Virtual, RealSense, Recording, Ros2, Ros1)
