"""The laboratory's commands: `tumortrack` finds them by its entry points' names."""

from tumortrack_lab.cli.bench import Bench
from tumortrack_lab.cli.twin import Twin

bench, twin = Bench, Twin
