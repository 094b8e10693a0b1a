"""The laboratory's commands, which `tumortrack` finds through entry points."""

from tumortrack_lab.cli.bench import Bench
from tumortrack_lab.cli.fleet import Fleet
from tumortrack_lab.cli.margins import Margins
from tumortrack_lab.cli.twin import Twin

bench, fleet, margins, twin = Bench, Fleet, Margins, Twin
