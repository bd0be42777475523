"""The Python on the pages for researchers runs as it stands there, and prints what they say."""

from __future__ import annotations

import ast
import io
import re
import warnings
from contextlib import redirect_stdout
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES = ("your-own-system.md",)
BLOCK = re.compile(r"```python\n(.*?)```(?:\n```text\n(.*?)```)?", re.DOTALL)
LINES, WIDTH = 10, 110


def blocks(page: str) -> list[tuple[str, str, str | None]]:
    """Heading, code and output of every block of a page."""
    text = (DOCS / page).read_text()
    found = [(m.start(), m[1], m[2]) for m in BLOCK.finditer(text)]
    return [(re.findall(r"^##+ (.*)$", text[:at], re.MULTILINE)[-1], code, out) for at, code, out in found]


EVERY = [
    pytest.param(code, out, id=f"{page.removesuffix('.md')}: {head}")
    for page in PAGES
    for head, code, out in blocks(page)
]


@pytest.mark.parametrize(("code", "printed"), EVERY)
def test_a_block_prints_what_stands_below_it(code: str, printed: str | None) -> None:
    out = io.StringIO()
    with warnings.catch_warnings(), redirect_stdout(out):
        warnings.simplefilter("error")
        exec(compile(code, "block", "exec"), {"__name__": "block"})
    assert out.getvalue() == printed


def test_every_method_takes_ten_lines_besides_the_imports() -> None:
    long = {}
    for head, code, _ in blocks("your-own-system.md"):
        imports = sum(isinstance(one, (ast.Import, ast.ImportFrom)) for one in ast.parse(code).body)
        count = sum(bool(line.strip()) for line in code.splitlines()) - imports
        if count > LINES or max(map(len, code.splitlines())) > WIDTH:
            long[head] = count
    assert not long


def test_every_paper_and_method_has_a_block() -> None:
    text = (DOCS / "your-own-system.md").read_text()
    for name in ("lee2018", "kim2018", "yang2019", "yang2021", "chong2020", "Algorithm 4.1", "Algorithm 4.2"):
        assert name in text
    assert len(blocks("your-own-system.md")) == text.count("\n### ")
