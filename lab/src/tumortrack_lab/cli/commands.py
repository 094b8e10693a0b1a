"""The laboratory's commands: `tumortrack` finds them by its entry points' names."""

from tumortrack_lab.cli.bench import Bench
from tumortrack_lab.cli.margins import GenericMargins
from tumortrack_lab.cli.twin import Twin

bench, generic_margins, twin = Bench, GenericMargins, Twin
