"""HTML in which every text is escaped: names in results and site files may be anybody's."""

from __future__ import annotations

import re
from html import escape
from typing import Final

_EMPTY: Final = frozenset({"meta", "br"})


class Html(str):
    """Text that is HTML already; any other text is escaped before it becomes part of it."""

    __slots__ = ()


def tag(name: str, /, *children: str, **attributes: str) -> Html:
    """An element. `class_` is the attribute `class`; children that are no `Html` are escaped."""
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(value)}"'
        for key, value in attributes.items()
    )
    if name in _EMPTY:
        return Html(f"<{name}{written}>")
    return Html(f"<{name}{written}>{joined(*children)}</{name}>")


def joined(*children: str) -> Html:
    """Several pieces, one after the other."""
    return Html("".join(c if isinstance(c, Html) else escape(c) for c in children))


def table(heads: list[str], rows: list[list[str]], classes: list[str] | None = None) -> Html:
    """A table; `classes` has one for each row."""
    body = [
        tag("tr", *(tag("td", cell) for cell in row), class_=classes[n] if classes else "")
        for n, row in enumerate(rows)
    ]
    head = tag("thead", tag("tr", *(tag("th", text) for text in heads)))
    return tag("table", head, tag("tbody", *body))


def inlined_svg(svg: bytes, prefix: str, description: str) -> Html:
    """An SVG of Matplotlib as part of a page: its names get a prefix, as pages hold several."""
    text = svg.decode()
    text = text[text.index("<svg") :]
    text = re.sub(r'\bid="', f'id="{prefix}', text)
    text = text.replace("url(#", f"url(#{prefix}").replace(
        'xlink:href="#', f'xlink:href="#{prefix}'
    )
    label = f'<svg role="img" aria-label="{escape(description)}"'
    return Html(text.replace("<svg", label, 1))
