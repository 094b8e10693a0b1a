"""The laboratory's commands: `tumortrack` finds them by its entry points' names."""

from tumortrack_lab.cli.bench import Bench
from tumortrack_lab.cli.fleet import Fleet
from tumortrack_lab.cli.margins import Margins
from tumortrack_lab.cli.twin import Twin

bench, fleet, margins, twin = Bench, Fleet, Margins, Twin
