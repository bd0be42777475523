"""The tables of the papers: no cell is empty, and what a row names is there."""

from __future__ import annotations

import re
from functools import cache
from itertools import groupby
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([DOCS / "papers.md", *(DOCS / "papers").glob("*.md"), *(DOCS / "errata").glob("*.md")])
TABLES = sorted(page for page in (DOCS / "papers").glob("*.md") if page.name != "README.md")


def tables(page: Path) -> list[list[list[str]]]:
    """Return the tables of a page as rows of cells; a bar inside of code, or after a backslash, is text."""
    found = []
    for is_table, group in groupby(page.read_text().splitlines(), lambda line: line.startswith("|")):
        lines = list(group)
        if is_table and len(lines) > 1 and set(lines[1]) <= set("|-: "):
            bare = [re.sub(r"`[^`]*`", lambda code: code[0].replace("|", "\0"), line) for line in lines]
            cells = [re.split(r"(?<!\\)\|", line.strip()[1:-1]) for line in bare]
            found.append([[cell.replace("\0", "|").strip() for cell in row] for row in cells])
    return found


@cache
def functions() -> dict[str, set[str]]:
    """Return the test functions and classes of every file of tests."""
    return {
        str(path.relative_to(ROOT)): set(re.findall(r"(?:def |class )([tT]est_?\w+)", path.read_text()))
        for path in (ROOT / "tests").rglob("test_*.py")
    }


@cache
def words() -> dict[str, set[str]]:
    """Return the words of every module."""
    return {
        str(path.relative_to(ROOT)): set(re.findall(r"\w+", path.read_text()))
        for package in ("gridsec", "feeders", "service")
        for path in (ROOT / package).rglob("*.py")
    }


def is_test(name: str) -> bool:
    """Whether a test is there: a folder, or a file or its class or function; some words of a name will do."""
    if name.startswith("tests/") and name.endswith("/"):
        return (ROOT / name).is_dir()
    first, *rest = [part.split("[")[0] for part in name.split("::")]
    stem = first.removeprefix("tests/").removeprefix("…/").removesuffix(".py")
    files = {file: names for file, names in functions().items() if file.removesuffix(".py").endswith(stem)}
    is_file = (
        not first or first.endswith(".py") or Path(stem).name in {Path(file).stem for file in functions()}
    )
    wanted = rest if is_file else [first, *rest]
    known = files.values() if is_file else functions().values()
    return any(all(any(holds(one, part) for one in names) for part in wanted) for names in known)


def holds(name: str, part: str) -> bool:
    if part.startswith("test_") and "…" not in part:
        return name == part
    return all(piece.strip("_") in name for piece in part.split("…"))


def is_code(name: str) -> bool:
    """Whether a module, or something inside one, is there; what is no name (a formula, an option) passes."""
    if re.fullmatch(r"[\w/]+/(\w+(\.py)?)?", name):
        return any((ROOT / base / name).exists() for base in ("", "gridsec", "gridsec/papers"))
    if re.fullmatch(r"\w+\.py", name):
        return any(Path(file).name == name for file in words())
    called = re.fullmatch(r"\.?([A-Za-z_]\w*(?:\.\w+)*)(?:\(.*\))?", name)
    if called is None or len(name) < 4:
        return True
    *path, last = called[1].split(".")
    inside = [
        known
        for file, known in words().items()
        if all(part in Path(file).with_suffix("").parts or part in known for part in path)
    ]
    modules = {part for file in words() for part in Path(file).with_suffix("").parts}
    return last in modules or any(last in known for known in inside)


def columns(page: Path, word: str) -> list[tuple[str, set[str]]]:
    """Return, for the columns with a word in their heads, the names in code of each cell."""
    return [
        (cell, set(re.findall(r"`([^`]+)`", cell)))
        for head, _, *rows in tables(page)
        for row in rows
        for title, cell in zip(head, row, strict=False)
        if word in title.lower().split()
    ]


def test_names_are_told_from_inventions() -> None:
    code = (
        "gridsec.bank.design",
        "bank.design",
        "gridsec/bank.py",
        "bank.py",
        "Bank.masks",
        "design(lure)",
        "gridsec/papers/",
    )
    assert [name for name in code if not is_code(name)] == []
    bad = (
        "gridsec.bank.dream",
        "bank.dream",
        "gridsec/bench.py",
        "bench.py",
        "Bank.musks",
        "dreem(lure)",
        "nowhere/",
    )
    assert [name for name in bad if is_code(name)] == []
    tests = (
        "tests/service/",
        "test_docs_papers",
        "tests/test_docs_papers.py",
        "tests/test_docs_papers.py::test_no_cell_is_empty",
        "test_docs_papers::test_no_cell_is_empty",
        "::test_no_cell_is_empty",
        "test_bank.py::TestGuarantees::test_theorem_2",
        "TestGuarantees::theorem_2",
        "test_no_cell_is_empty",
        "names_are_told_…",
        "names_…_inventions",
    )
    assert [name for name in tests if not is_test(name)] == []
    bad = (
        "tests/none/",
        "tests/test_none.py",
        "test_docs_papers::test_none",
        "test_no_cell",
        "names_…_intentions",
    )
    assert [name for name in bad if is_test(name)] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(DOCS)))
def test_no_cell_is_empty(page: Path) -> None:
    for head, _, *rows in tables(page):
        for row in rows:
            assert len(row) == len(head), f"{row}: {len(head)} cells are expected"
            assert all(row), f"{row}: an empty cell"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(DOCS)))
def test_named_tests_and_modules_exist(page: Path) -> None:
    named = {name for word in ("test", "tests") for _, names in columns(page, word) for name in names}
    assert sorted(name for name in named if not (is_test(name) or is_code(name))) == []
    named = {
        name for word in ("lives", "code", "module") for _, names in columns(page, word) for name in names
    }
    assert sorted(name for name in named if not is_code(name)) == []
    whole = re.findall(r"`((?:tests/|test_)[\w/.:]+)`", page.read_text())
    assert sorted(name for name in whole if not is_test(name)) == []


@pytest.mark.parametrize("page", TABLES, ids=lambda page: page.stem)
def test_a_paper_has_a_table_whose_rows_name_a_test(page: Path) -> None:
    cells = columns(page, "test") + columns(page, "tests")
    assert len(cells) >= 5
    reference = re.compile(r"`|the same|\ball\b|as \(|none")
    assert [cell for cell, _ in cells if not reference.search(cell)] == []


def test_the_index_has_every_page() -> None:
    index = (DOCS / "papers.md").read_text()
    pages = [page for page in PAGES if page.name not in {"papers.md", "README.md"}]
    assert [page for page in pages if f"]({page.relative_to(DOCS)})" not in index] == []
