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


def faults(root: Path, check: bool) -> list[str]:
    """Of the pages and tables of a checkout; ``check``: the pages are left as they are."""
    found, data = [], root / "docs/data"
    for page in [root / "README.md", *sorted((root / "docs").rglob("*.md"))]:
        text, name = page.read_text(encoding="utf-8"), page.relative_to(root)
        try:
            new = rendered(text, data)
        except InputError as error:
            found.append(f"{name}: {error}")
            continue
        if new != text and check:
            found.append(f"{name} differs from its tables: make figures")
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
    wrong = faults(Path(__file__).parents[1], "--check" in sys.argv[1:])
    print(*wrong, sep="\n", file=sys.stderr)
    sys.exit(bool(wrong))
