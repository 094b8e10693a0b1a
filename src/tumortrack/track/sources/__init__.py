"""Sources of the live loop: one file per kind.

A source's configuration is what the command line writes as ``kind:target?key=value``; its
``open`` makes the source (``track.live.Source``). To add one: write its file, add its
configuration here.
"""

from tumortrack.track.sources.realsense import RealSense
from tumortrack.track.sources.recording import Recording
from tumortrack.track.sources.ros1 import Ros1
from tumortrack.track.sources.ros2 import Ros2
from tumortrack.track.sources.virtual import Virtual

SOURCES = (Virtual, RealSense, Recording, Ros2, Ros1)
