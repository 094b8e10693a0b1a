"""Do the pages say what the tables say, and are the tables of today's method?

python tools/figures.py           fill the pages from docs/data (tumortrack_lab.study.document has
                                  the format); exit status 1 where a table is of another method
python tools/figures.py --check   write nothing; exit status 1 also where a page differs
"""

from __future__ import annotations

import sys
from pathlib import Path

from tumortrack.core.errors import InputError
from tumortrack.tracking.fingerprint import fingerprint
from tumortrack_lab.study.document import MeasuredTable, rendered

ROOT = Path(__file__).parents[1]
DATA = ROOT / "docs/data"
# Of what a table was measured, where it is not today's method: as the table says it.
OTHER = "version", "weights", "data"


def pages() -> list[Path]:
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def faults(check: bool) -> list[str]:
    found = []
    for page in pages():
        text = page.read_text(encoding="utf-8")
        try:
            new = rendered(text, DATA)
        except InputError as error:
            found.append(f"{page.relative_to(ROOT)}: {error}")
            continue
        if new == text:
            continue
        if check:
            found.append(f"{page.relative_to(ROOT)} differs from its tables: make figures")
        else:
            page.write_text(new, encoding="utf-8")
            print(f"{page.relative_to(ROOT)} written")
    for path in sorted(DATA.glob("*.csv")):
        about = MeasuredTable.read(path).about
        of = about.get("fingerprint")
        if of not in (None, fingerprint()):
            found.append(
                f"{path.relative_to(ROOT)} was measured with method {of}, and this is "
                f"{fingerprint()}: make it again ({about['command']}), or delete it with the "
                "sentences that rest on it"
            )
        elif about and of is None and not any(about.get(key) for key in OTHER):
            found.append(f"{path.relative_to(ROOT)} does not say of what it is: {', '.join(OTHER)}")
    return found


if __name__ == "__main__":
    wrong = faults("--check" in sys.argv[1:])
    print(*wrong, sep="\n", file=sys.stderr)
    sys.exit(bool(wrong))
