"""HTML in which every text is escaped: names in results and site files are not trusted."""

from __future__ import annotations

import re
from html import escape
from typing import Final

_EMPTY: Final = frozenset({"meta", "br"})
_OPTION: Final = re.compile(r"--[a-z][a-z-]*")


class Html(str):
    """Text that is HTML already; any other text is escaped before it becomes part of it."""

    __slots__ = ()


def tag(name: str, /, *children: str, **attributes: str) -> Html:
    """Return an element; `class_` is the attribute `class`, and plain text is escaped."""
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(value)}"'
        for key, value in attributes.items()
    )
    if name in _EMPTY:
        return Html(f"<{name}{written}>")
    return Html(f"<{name}{written}>{joined(*children)}</{name}>")


def joined(*children: str) -> Html:
    """Return several pieces joined; no line breaks before a % or within a command's option."""
    return Html("".join(c if isinstance(c, Html) else _unbroken(escape(c)) for c in children))


def _unbroken(text: str) -> str:
    return _OPTION.sub(
        r'<span class="option">\g<0></span>', text.replace(" %", "\N{NO-BREAK SPACE}%")
    )


def table(heads: list[str], rows: list[list[str]], classes: list[str] | None = None) -> Html:
    """Return a table that scrolls where it is too wide; `classes` has one class for each row."""
    body = [
        tag("tr", *(tag("td", cell) for cell in row), class_=classes[n] if classes else "")
        for n, row in enumerate(rows)
    ]
    head = tag("thead", tag("tr", *(tag("th", text) for text in heads)))
    return tag("div", tag("table", head, tag("tbody", *body)), class_="wide")


def inlined_svg(svg: bytes, prefix: str, description: str) -> Html:
    """Return an SVG of Matplotlib within a page; its names get a prefix, as pages have several."""
    text = svg.decode()
    text = text[text.index("<svg") :]
    text = re.sub(r'\bid="', f'id="{prefix}', text)
    text = text.replace("url(#", f"url(#{prefix}").replace(
        'xlink:href="#', f'xlink:href="#{prefix}'
    )
    label = f'<svg role="img" aria-label="{escape(description)}"'
    return Html(text.replace("<svg", label, 1))
