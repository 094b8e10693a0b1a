"""The site's tables, which are CSV files in docs/data/."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def site(tmp_path, monkeypatch):
    """tools/site.py, with docs/ elsewhere."""
    pytest.importorskip("mkdocs")
    spec = importlib.util.spec_from_file_location("site_hook", ROOT / "tools/site.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "ROOT", tmp_path)
    data = tmp_path / "docs/data"
    data.mkdir(parents=True)
    (data / "errors.csv").write_text('case,error mm\na,1.5\n"b, <c>",2\n', "utf-8")
    return module


def shown(site, markdown: str, page: str = "decisions/page.md") -> str:
    return site.on_page_markdown(markdown, SimpleNamespace(file=SimpleNamespace(src_uri=page)))


def test_a_link_to_data_alone_in_its_paragraph_becomes_a_table(site):
    text = shown(site, "One.\n\n[Errors of `x`: 2 rows](../data/errors.csv)\n\nTwo.\n")
    assert text.startswith("One.\n\n\n<details")
    assert text.endswith("</details>\n\nTwo.\n")
    assert "<summary>Errors of <code>x</code>: 2 rows</summary>" in text
    assert "<td>b, &lt;c&gt;</td><td>2</td>" in text
    assert '<a href="../data/errors.csv" download>' in text
    assert shown(site, "[E](data/errors.csv)", "page.md").startswith("\n<details")
    between = shown(site, "<!-- a -->\n[E](data/errors.csv)\n<!-- /a -->\n", "page.md")
    assert between.startswith("<!-- a -->\n\n<details")
    assert between.endswith("</details>\n<!-- /a -->\n")
    assert "<details" in shown(site, "## Head\n[E](data/errors.csv)\n\nWords\n", "page.md")


@pytest.mark.parametrize(
    "markdown",
    [
        "See [E](data/errors.csv).\n",
        "- [E](data/errors.csv)\n",
        "Words\n[E](data/errors.csv)\n",
        "[E](data/errors.csv)\nwords\n",
        "[E](data/none.csv)\n",  # MkDocs says that it is not there
    ],
)
def test_any_other_link_stays_one(site, markdown):
    assert shown(site, markdown, "page.md") == markdown
