"""What MkDocs asks while it builds the site (`hooks` in mkdocs.yml).

Makes reference/cli.md of what `--help` says, takes CONTRIBUTING.md and CHANGELOG.md in as
pages, turns links that leave docs/ into plain text (the site must work without the repository),
and shows a table that is a CSV file in docs/data/ where a link to it is a paragraph by itself.
"""

from __future__ import annotations

import io
import os
import posixpath
import re
from collections.abc import Iterator
from contextlib import redirect_stdout, suppress
from html import escape
from pathlib import Path
from textwrap import fill
from typing import Any

from mkdocs.structure.files import File, Files

from tumortrack.cli.main import run
from tumortrack_benchmarks.document import MeasuredTable

ROOT = Path(__file__).parents[1]
TAKEN_IN = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changes.md"}


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are not files in docs/."""
    pages = {page: (ROOT / name).read_text("utf-8") for name, page in TAKEN_IN.items()}
    pages = {page: text.replace("](docs/", "](") for page, text in pages.items()}
    pages["reference/cli.md"] = command_line()
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links into the repository become the text that they stand on, links to data its table."""
    for name, taken in TAKEN_IN.items():
        markdown = markdown.replace(f"](../{name}", f"]({taken}")
    here = posixpath.dirname(page.file.src_uri)

    def kept(link: re.Match[str]) -> str:
        inside = not posixpath.normpath(posixpath.join(here, link[2])).startswith("..")
        return link[0] if inside else link[1]

    lines = markdown.splitlines(keepends=True)
    for number, line in enumerate(lines):
        # Alone in its paragraph; headings and comments end one, too.
        around = (lines[max(number - 1, 0) : number], lines[number + 1 : number + 2])
        alone = all(not text or text[0].strip()[:1] in ("", "#", "<") for text in around)
        if alone and (link := _DATA_LINK.fullmatch(line.strip())):
            path = ROOT / "docs" / posixpath.normpath(posixpath.join(here, link[2]))
            if path.exists():  # else MkDocs tells
                lines[number] = "\n" + data_table(path, link[1], link[2]) + "\n"
    markdown = "".join(lines)
    return re.sub(r"(?<!!)\[([^\]]+)\]\((\.\./[^)]*)\)", kept, markdown)


_DATA_LINK = re.compile(r"\[([^\]]+)\]\(((?:\.\./)*data/[\w.-]+\.csv)\)")


def data_table(path: Path, text: str, link: str) -> str:
    """A CSV file as a table that opens, and that site.js sorts by the column clicked."""
    table = MeasuredTable.read(path)
    header, rows = table.header, table.rows
    head = "".join(f'<th scope="col"><button>{escape(name)}</button></th>' for name in header)
    body = "\n".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    summary = "".join(  # of Markdown, a link's text has code at most
        f"<code>{escape(part)}</code>" if odd % 2 else escape(part)
        for odd, part in enumerate(text.split("`"))
    )
    made = escape(table.caption.replace("`", "")) if table.about else ""
    figures = any(cell[:1].isdigit() for row in rows for cell in row)  # words can be searched for
    return f"""<details class="data"{" data-search-exclude" * figures}><summary>{summary}</summary>
<div class="data" tabindex="0"><table class="data">
<thead><tr>{head}</tr></thead>
<tbody>
{body}
</tbody></table></div>
<p>{made} <a href="{escape(link)}" download>{escape(path.name)}</a></p>
</details>"""


def command_line() -> str:
    """What `--help` says of every command."""
    os.environ.update(COLUMNS="100", NO_COLOR="1", TERM="dumb")
    return "# Command line\n" + "".join(section())


def section(*words: str) -> Iterator[str]:
    """Of one command, and of those below it, which its usage names at its end."""
    output = io.StringIO()
    with redirect_stdout(output), suppress(SystemExit):
        run([*words, "--help"])
    lines = output.getvalue().strip().splitlines()
    text = "\n".join(line.rstrip() if len(line) <= 100 else fill(line, 100) for line in lines)
    yield f"\n{'#' * min(2 + len(words), 4)} {' '.join(['tumortrack', *words])}\n"
    yield f"\n```text\n{text}\n```\n"
    if below := re.search(r"\{([a-z,-]+)\}$", lines[0]):
        for name in below[1].split(","):
            yield from section(*words, name)
