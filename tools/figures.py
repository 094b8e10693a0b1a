"""Do the pages say what the tables say, and are the tables of today's method?

python tools/figures.py           fill the pages from docs/data (tumortrack_benchmarks.document has
                                  the format); exit status 1 where a table is of another method
python tools/figures.py --check   write nothing; exit status 1 also where a page differs
"""

from __future__ import annotations

import re
import sys
from itertools import groupby
from pathlib import Path

import pandas as pd

from tumortrack.assessment.fingerprint import fingerprint
from tumortrack.core import renamed, store
from tumortrack.core.errors import InputError
from tumortrack.simulation.sensors import FIGURES, simulated
from tumortrack_benchmarks.document import MeasuredTable, rendered, table_of

_RENAMED = re.compile(r"(<!-- renamed -->\n).*?(<!-- /renamed -->)", re.DOTALL)
_WHERE = {  # by section of renamed.toml
    "modules": "Python: modules",
    "names": "Python: names",
    "commands": "commands",
    "options": "options",
    "choices": "options' values",
    "keys": "keys of `--config` files, options of sinks",
    "report": "report.json",
    "values": "values in report.json",
    "plan": "plan.json",
    "manifest": "a model's manifest.json",
    "variables": "environment variables",
    "entry_points": "groups of entry points",
    "distributions": "distributions",
    "targets": "`make`",
}


def sensors() -> str:
    """sensors.toml as CSV: every figure with its grade, and what follows at some distances."""
    rows = []
    for name, known in FIGURES.items():
        camera = simulated(name)
        for part, of in enumerate(("temporal", "frozen")):
            law = " / ".join(
                f"{camera.noise_mm(z)[part]:.2f}" if z >= camera.nearest_mm else "–"
                for z in (150.0, 300.0, 500.0)
            )
            key = f"{of}_px" if f"{of}_px" in known else f"{of}_mm"
            at = f"{of} noise at 150 / 300 / 500, mm"
            rows.append((name, at, law, known[key][1], f"from {key}"))
        for key, (value, grade, source) in known.items():
            shown = ", ".join(map(str, value)) if isinstance(value, list) else value
            rows.append((name, key, shown, grade, source))
    columns = ["sensor", "figure", "value", "grade", "source"]
    return pd.DataFrame(rows, columns=columns).to_csv(index=False, lineterminator="\n")


def changes() -> str:
    """renamed.toml as Markdown: old names with one replacement share a row."""
    rows = list[tuple[str, str, str]]()
    for section, where in _WHERE.items():
        for new, some in groupby(renamed.table()[section].items(), key=lambda item: item[1]):
            rows.append((where, ", ".join(f"`{old}`" for old, _ in some), new))
    return table_of(pd.DataFrame(rows, columns=["where", "gone", "use instead"]))


def _filled(begin: str, end: str) -> str:
    return f"{begin}\n{changes()}\n\n{end}"


def differs(table: Path, check: bool) -> list[str]:
    """Whether the table of sensors is not what sensors.toml says; without ``check`` it is made."""
    if not check:
        store.write_atomically(table, sensors().encode())
    same = table.is_file() and table.read_text(encoding="utf-8") == sensors()
    return [] if same else [f"{table.name} differs from sensors.toml: make pages"]


def faults(root: Path, check: bool) -> list[str]:
    """Of the pages and tables of a checkout; ``check``: the pages are left as they are."""
    found, data = [], root / "docs/data"
    above = [root / "README.md", *root.glob("CHANGELOG.md")]
    for page in [*above, *sorted((root / "docs").rglob("*.md"))]:
        text, name = page.read_text(encoding="utf-8"), page.relative_to(root)
        try:
            new = _RENAMED.sub(lambda found: _filled(*found.groups()), rendered(text, data))
        except InputError as error:
            found.append(f"{name}: {error}")
            continue
        if new != text and check:
            found.append(f"{name} differs from its tables: make pages")
        elif new != text:
            page.write_text(new, encoding="utf-8")
            print(f"{name} written")
    for path in sorted(data.glob("*.csv")):
        about, name = MeasuredTable.read(path).about, path.relative_to(root)
        of = about.get("fingerprint")
        if of not in (None, fingerprint()):
            found.append(
                f"{name} was measured with method {of}, and this is {fingerprint()}: make it again "
                f"({about.get('command')}), or delete it with the sentences that rest on it"
            )
        elif about and of is None and "version" not in about:
            found.append(f"{name} says neither a fingerprint nor a version")
    return found


if __name__ == "__main__":
    root, check = Path(__file__).parents[1], "--check" in sys.argv[1:]
    wrong = differs(root / "docs/data/sensors.csv", check) + faults(root, check)
    print(*wrong, sep="\n", file=sys.stderr)
    sys.exit(bool(wrong))
