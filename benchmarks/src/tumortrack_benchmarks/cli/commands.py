"""The benchmarks' commands, which `tumortrack` finds through entry points."""

from tumortrack_benchmarks.cli.bench import Bench
from tumortrack_benchmarks.cli.fleet import Fleet
from tumortrack_benchmarks.cli.margins import Margins
from tumortrack_benchmarks.cli.twin import Twin

bench, fleet, margins, twin = Bench, Fleet, Margins, Twin
