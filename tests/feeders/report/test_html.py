"""HTML: text in is text out, whatever it is."""

from __future__ import annotations

from html.parser import HTMLParser

from hypothesis import given
from hypothesis import strategies as st

from feeders.report.html import _environment


class Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, list[tuple[str, str | None]]]] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, attrs))

    def handle_data(self, data: str) -> None:
        self.text += data


def visible(text: str) -> str:
    hidden = "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"
    return "".join(
        "\ufffd" if (c < " " and c != "\n") or "\x7f" <= c <= "\x9f" or c in hidden else c for c in text
    )


@given(st.text(st.characters(exclude_categories=["Cs"])), st.text(st.characters(exclude_categories=["Cs"])))
def test_text_stays_text(text: str, title: str) -> None:
    reader = Reader()
    template = _environment().from_string('<p title="{{ title }}">{{ text }}</p>')
    reader.feed(template.render(text=text, title=title))
    reader.close()
    assert reader.tags == [("p", [("title", visible(title))])]
    assert reader.text == visible(text)
