"""Style of docstrings, comments, messages and documents: that of a data sheet.

Titles of docstrings are nouns or imperatives, no indirect questions. Equipment has no personal pronouns.
Counts per area; each limit only falls.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DEFAULT_MONITOR = "modal"
"""Folder of the default monitor; its inside is counted as an area of its own."""

QUESTION = re.compile(r"(What|Who|Whom|Whose|Whether|How|Which|Where|When|Why|If)\b")
PERSON = re.compile(
    r"\b(who|whom|whose|whoever|whomever|nobody|somebody|everybody|anybody|someone|everyone|anyone)\b", re.I
)
PUBLIC = re.compile(r"--[a-z-]+|[`\"][wW]ho[`\"]|\bwho:|[.-]who\b|(?m:^ *(?:\w+, )*who(?:, \w+)*$)")
"""Options of the command line, columns of tables, fields of REST, and lists of parameters: public words.

They are not counted in documents, feeders and service.
"""

FOREIGN = set((ROOT / "service/web/swagger").glob("swagger-ui*"))
"""Files of another project, unchanged."""
# Indirect questions as titles, and personal pronouns for equipment.
LIMITS = {
    "gridsec": (0, 0),
    "default monitor": (0, 0),
    "feeders": (0, 0),
    "service": (0, 0),
    "documents": (0, 0),
}


def documented(tree: ast.AST) -> Iterator[str]:
    """Docstrings of a module, its classes and its functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield text


def prose(source: str) -> Iterator[str]:
    """Comments and string literals of a module: docstrings, messages, sentences."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type in (tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", -1)):
            yield token.string


def persons(text: str, name: str) -> int:
    """Number of personal pronouns in a text of an area."""
    return len(PERSON.findall(PUBLIC.sub("", text) if name in ("feeders", "service", "documents") else text))


def area(path: Path) -> str:
    """Area of a file."""
    parts = path.relative_to(ROOT).parts
    if parts[0] == "gridsec" and DEFAULT_MONITOR in parts:
        return "default monitor"
    return parts[0] if parts[0] in LIMITS else "documents"


def counts() -> dict[str, tuple[Counter[str], Counter[str]]]:
    """Violations of both kinds by area, with their places."""
    out = {name: (Counter[str](), Counter[str]()) for name in LIMITS}
    for package in ("gridsec", "feeders", "service"):
        for path in sorted((ROOT / package).rglob("*.py")):
            source, place = path.read_text(), str(path.relative_to(ROOT))
            titles, pronouns = out[area(path)]
            titles[place] += sum(bool(QUESTION.match(text)) for text in documented(ast.parse(source)))
            pronouns[place] += sum(persons(text, area(path)) for text in prose(source))
        for suffix in ("*.js", "*.html", "*.css"):
            for path in sorted(set((ROOT / package).rglob(suffix)) - FOREIGN):
                out[package][1][str(path.relative_to(ROOT))] += persons(path.read_text(), package)
    for path in sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "docs").rglob("*.py")]):
        place = str(path.relative_to(ROOT))
        out["documents"][1][place] += persons(path.read_text(), "documents")
    return out


FOUND = counts()


@pytest.mark.parametrize("name", LIMITS)
def test_titles_are_no_indirect_questions(name: str) -> None:
    titles = +FOUND[name][0]
    assert titles.total() <= LIMITS[name][0], titles.most_common(20)


@pytest.mark.parametrize("name", LIMITS)
def test_equipment_has_no_personal_pronouns(name: str) -> None:
    pronouns = +FOUND[name][1]
    assert pronouns.total() <= LIMITS[name][1], pronouns.most_common(20)


def test_limits_are_tight() -> None:
    """A limit above its count would let it rise again."""
    counted = {name: (titles.total(), pronouns.total()) for name, (titles, pronouns) in FOUND.items()}
    assert counted == LIMITS


def test_both_kinds_are_recognised() -> None:
    source = '"""What is kept of a feeder."""\n# Whoever lies.\nX = "nobody knows; the whole"\n'
    assert [bool(QUESTION.match(text)) for text in documented(ast.parse(source))] == [True]
    assert sum(len(PERSON.findall(text)) for text in prose(source)) == 2


def test_public_words_are_no_pronouns() -> None:
    source = (
        '"""Answer.\n\nParameters\n----------\nt, who\n    Whoever asks.\n"""\nX = {"who": "--who and who"}\n'
    )
    assert [sum(persons(text, name) for text in prose(source)) for name in ("service", "gridsec")] == [2, 5]
