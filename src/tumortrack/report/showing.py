"""A page shown to whoever is there: within a notebook, in a browser, or as a path."""

from __future__ import annotations

import os
import sys
import webbrowser
from html import escape
from pathlib import Path

_HEIGHT_PX = 720  # of a notebook's frame


def show(page: Path) -> None:
    """Show a page that needs no other file; where there is no display, print where it is."""
    if _in_notebook():
        from IPython.display import HTML, display

        frame = f'width="100%" height="{_HEIGHT_PX}" frameborder="0"'
        display(HTML(f'<div><iframe srcdoc="{escape(page.read_text())}" {frame}></iframe></div>'))
    elif not (_has_display() and webbrowser.open(page.as_uri())):
        print(f"open {page}")


def _in_notebook() -> bool:
    if "IPython" not in sys.modules:
        return False
    from IPython import get_ipython

    return hasattr(get_ipython(), "kernel")  # of a terminal's shell there is none


def _has_display() -> bool:
    """Whether a browser would open a window: one of text alone would take over the terminal."""
    named = ("BROWSER", "DISPLAY", "WAYLAND_DISPLAY")
    return not sys.platform.startswith("linux") or any(map(os.environ.get, named))
