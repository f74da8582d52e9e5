"""Text in HTML and SVG."""

from __future__ import annotations

from html import escape

from gknet.io.text import printable


def escaped(text: object) -> str:
    """A text from outside as the content of an element or of a quoted attribute."""
    return escape(printable(text))
