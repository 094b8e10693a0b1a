"""What MkDocs asks while it builds the site (`hooks` in mkdocs.yml).

Makes reference/cli.md of the commands' own parsers, takes CONTRIBUTING.md and CHANGELOG.md in as
pages, turns links that leave docs/ into plain text (the site must work without the repository),
and shows a table that is a CSV file in docs/data/ where a link to it is a paragraph by itself.
"""

from __future__ import annotations

import argparse
import posixpath
import re
import warnings
from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Any

import tyro
from mkdocs.structure.files import File, Files

from tumortrack.cli.main import _commands as all_commands
from tumortrack_lab.study.document import MeasuredTable

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
    """Every command with its options, as `--help` has them."""
    text = [
        "# Command line\n",
        "This page is generated from the code: it says what `tumortrack COMMAND --help` says.\n",
        "| command | |\n|---|---|",
    ]
    parsers = [
        (f"tumortrack {name}", parser)
        for name, command in all_commands("").items()
        for parser in [_parser(command, name)]
    ]
    text += [
        f"| [`{words}`](#{words.replace(' ', '-')}) | {_first(parser)} |"
        for words, parser in parsers
    ]
    for words, parser in parsers:
        text += _section(words, parser, 2)
    return "\n".join(text) + "\n"


def _parser(command: Any, name: str) -> argparse.ArgumentParser:
    with warnings.catch_warnings():
        # tyro means to drop it; what it would be replaced by is the text of --help, in boxes.
        warnings.simplefilter("ignore", DeprecationWarning)
        return tyro.extras.get_parser(command, prog=f"tumortrack {name}")


def _first(parser: argparse.ArgumentParser) -> str:
    return " ".join((parser.description or "").split("\n\n")[0].split())


def _section(words: str, parser: argparse.ArgumentParser, level: int) -> Iterator[str]:
    yield f"\n{'#' * level} {words}\n"
    yield (parser.description or "").strip() + "\n"
    rows, below = [], []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            below += [(f"{words} {name}", subparser) for name, subparser in action.choices.items()]
        elif action.dest != "help":
            rows.append(_row(action))
    places = [_place(action) for action in parser._actions if _positional(action)]
    places += ["KIND"] * bool(below)
    yield f"```text\n{' '.join([words, *places, '[OPTIONS]'])}\n```\n"
    if rows:
        yield "| | value | meaning |\n|---|---|---|"
        yield from rows
    for name, subparser in below:
        yield from _section(name, subparser, level + 1)


def _positional(action: argparse.Action) -> bool:
    return not action.option_strings and not isinstance(action, argparse._SubParsersAction)


def _place(action: argparse.Action) -> str:
    """The name of what stands there: a bare PATH would not tell the input from the output."""
    name = action.dest.upper().replace("_", "-")
    return f"[{name} ...]" if action.nargs == "*" else name


def _row(action: argparse.Action) -> str:
    name = ", ".join(f"`{option}`" for option in action.option_strings)
    value = re.sub(r"\{None\}\||None,", "", str(action.metavar or ""))
    meaning = " ".join((action.help or "").split()).replace(" (default: None)", "")
    if not action.option_strings:
        name, value = f"`{_place(action)}`", ""
    cells = (name, f"`{value}`" if value else "", meaning)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
