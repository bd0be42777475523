"""HTML from the standard library: whatever is not marked as markup is text, and escaped."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from typing import Final

__all__ = ["Markup", "el", "join"]

_VOID: Final = {"meta", "br"}


class Markup(str):
    """Text that is markup already; only this module and drawings make it."""

    __slots__ = ()


Child = str | Iterable[str] | None


def el(tag: str, *children: Child, **attributes: str | bool | None) -> Markup:
    """Write an element.

    Parameters
    ----------
    tag
        Its name.
    children
        Text, which is escaped; markup, which is not; or several of either. None: nothing.
    attributes
        A trailing underscore goes, the others become hyphens. None and False: not there.
    """
    parts = [tag]
    for name, value in attributes.items():
        if value is None or value is False:
            continue
        key = name.rstrip("_").replace("_", "-")
        parts.append(key if value is True else f'{key}="{_text(value)}"')
    head = f"<{' '.join(parts)}>"
    return Markup(head if tag in _VOID else f"{head}{join(children)}</{tag}>")


def join(children: Iterable[Child]) -> Markup:
    """Write children one after the other."""
    out = []
    for child in children:
        if child is None:
            continue
        every = [child] if isinstance(child, str) else child
        out += [each if isinstance(each, Markup) else _text(each) for each in every]
    return Markup("".join(out))


def _text(text: str) -> str:
    """Escape; control characters become visible, directions cannot be turned around."""
    return escape("".join(c if _harmless(c) else "\ufffd" for c in text))


def _harmless(letter: str) -> bool:
    return (letter >= " " or letter == "\n") and not (
        "\x7f" <= letter <= "\x9f" or letter in "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"
    )
