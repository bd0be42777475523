"""Links of the documents: each relative target exists, and each anchor is a heading of its target."""

from __future__ import annotations

import re
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
LINK = re.compile(r"\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)


def anchor(heading: str) -> str:
    """Anchor that GitHub gives to a heading: lower case, punctuation removed, hyphens for spaces."""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading.strip())
    return re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-")


def anchors(text: str) -> set[str]:
    """Anchors of all headings of a page; a repeated heading has a number."""
    counts: Counter[str] = Counter()
    found = set()
    for heading in re.findall(r"^#{1,6} (.+)$", FENCE.sub("", text), re.MULTILINE):
        name = anchor(heading)
        found.add(f"{name}-{counts[name]}" if counts[name] else name)
        counts[name] += 1
    return found


@cache
def anchors_of(page: Path) -> set[str]:
    """Anchors of a file."""
    return anchors(page.read_text(encoding="utf-8"))


def broken(page: Path, text: str) -> list[str]:
    """Relative links of a page without their file or heading."""
    out = []
    for target in LINK.findall(FENCE.sub("", text)):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, section = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        if not file.exists() or (section and section not in anchors_of(file)):
            out.append(target)
    return out


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_and_anchors_exist(page: Path) -> None:
    assert broken(page, page.read_text(encoding="utf-8")) == []


def test_anchors_follow_the_rules_of_github() -> None:
    text = "# A `code`, and: more\n## The bank's one\n## The bank's one\n```\n# no heading\n```\n"
    assert anchors(text) == {"a-code-and-more", "the-banks-one", "the-banks-one-1"}


def test_broken_links_are_found() -> None:
    page = ROOT / "README.md"
    text = "[a](docs/none.md) [b](docs/README.md#none) [c](docs/README.md#documents) [d](https://x.y/z.md)"
    assert broken(page, text) == ["docs/none.md", "docs/README.md#none"]


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("theory-*.md")), ids=lambda page: page.stem)
def test_theory_pages_start_with_a_short_summary(page: Path) -> None:
    """Problem, model, result, guarantee and what is only measured or not proven, in at most ten lines."""
    title, label, summary = page.read_text(encoding="utf-8").split("\n\n")[:3]
    assert title.startswith("# ")
    assert label == "**Summary.**"
    assert len(summary.splitlines()) <= 10
    words = set(re.findall(r"^- \*([A-Za-z ]+)\.\*", summary, re.MULTILINE))
    assert {"Problem", "Model", "Result", "Guarantee"} < words
    assert words & {"Only measured", "Not proven"}


def test_the_glossary_is_in_alphabetical_order() -> None:
    rows = re.findall(
        r"^\| ([^|]+?) \|", (ROOT / "docs/glossary.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    terms = [term.lower() for term in rows[1:] if not term.startswith("---")]
    assert terms == sorted(terms)
    assert len(set(terms)) == len(terms) > 60
