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
        "gridsec.estimators.exact_bank.bank.design",
        "bank.design",
        "gridsec/estimators/exact_bank/bank.py",
        "bank.py",
        "Bank.masks",
        "design(lure)",
        "gridsec/papers/",
    )
    assert [name for name in code if not is_code(name)] == []
    bad = (
        "gridsec.estimators.exact_bank.bank.dream",
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
        "test_bank_guarantees.py::TestGuarantees::test_theorem_2",
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


# What the papers number. Figures 1.1 and 1.2 of lee2018 belong to its introduction.
NUMBERED = {
    "chong2020": """
        Assumption 1, 2; Definition 1; Theorem 1, 2; Proposition 1; Corollary 1; Figure 1, 2; (1) to (20)
        """,
    "kim2018": """
        Assumption 1 to 3; Definition 1; Lemma 1; Proposition 1; Theorem 1, 2; Corollary 1; Remark 1 to 3;
        Table I; Figure 1; (1) to (25)
        """,
    "lee2018": """
        Algorithm 2.1 to 2.3, 4.1, 4.2; Assumption 3.1.1, 4.1.1, 4.3.1 to 4.3.3, 5.1.1, 5.2.1; Definition
        2.1.1, 2.2.1 to 2.2.3, 3.1.1 to 3.1.4, 3.2.1 to 3.2.4, 3.3.1, 3.3.2, 5.1.1, 5.1.2, 5.3.1; Theorem
        2.1.1, 2.1.2, 2.2.7, 2.2.9, 2.2.11, 2.2.12, 2.2.18, 2.2.19, 4.3.2, 5.4.1, 5.4.3; Lemma 2.2.1,
        2.2.4, 2.2.6, 2.2.8, 2.2.16, 2.2.17, 5.1.1, 5.2.1; Corollary 2.2.5, 2.2.13 to 2.2.15, 3.1.5,
        3.1.12, 5.4.2; Proposition 2.2.2, 2.2.3, 2.2.10, 3.1.1 to 3.1.4, 3.1.6 to 3.1.11, 3.1.13, 3.2.1 to
        3.2.4, 3.3.1, 3.3.2, 4.3.1, 5.1.2 to 5.1.7; Remark 2.2.1 to 2.2.3, 3.2.1, 4.4.1, 4.4.2, 5.2.1 to
        5.2.3, 5.3.1, 5.4.1; Table 5.1; Figure 4.1 to 4.12, 5.1 to 5.4, 6.1; (2.1.1) to (2.1.4), (2.2.1) to
        (2.2.21), (3.1.1) to (3.1.6), (3.2.1) to (3.2.6), (4.1.1), (4.1.2), (4.2.1) to (4.2.10), (4.3.1)
        to (4.3.16), (4.5.1), (4.5.2), (5.1.1) to (5.1.5), (5.2.1) to (5.2.8), (5.3.1) to (5.3.5), (5.4.1)
        to (5.4.5)
        """,
    "yang2019": """
        Assumption 1 to 3; Algorithm 1, 2; Proposition 1 to 4; Remark 1, 2; Example 1; Figure 1 to 4; (1)
        to (26)
        """,
    "yang2021": """
        Assumption 1 to 3; Lemma 1 to 3; Theorem 1, 2; Example 1 to 4; Figure 1 to 12; (1) to (48)
        """,
}


def expanded(text: str) -> set[str]:
    """Return the numbers of a list such as "1, 2 and 4 to 6" or "(2.1) to (2.3), (2.5)", as written."""
    found = set(re.findall(r"\(?(?:\d+(?:\.\d+)*|\bI\b)\)?", text))
    for first, last in re.findall(r"(\(?[\d.]+\)?)\s*(?:to|–)\s*(\(?[\d.]+\)?)", text):
        head, _, start = first.strip("()").rpartition(".")
        stop = int(last.strip("()").rpartition(".")[2])
        shape = "({})" if first.startswith("(") else "{}"
        found |= {shape.format(f"{head}.{k}" if head else k) for k in range(int(start), stop + 1)}
    return found


def numbered(pages: list[Path]) -> dict[str, set[str]]:
    """Return what the rows of some pages are about: numbers by kind, those of equations under no kind."""
    kinds = "Assumption|Definition|Theorem|Lemma|Proposition|Corollary|Algorithm|Remark|Example|Figure|Table"
    out: dict[str, set[str]] = {"": set()}
    for page in pages:
        for _, _, *rows in tables(page):
            for first, *_ in rows:
                subject = re.sub(r"[′″]+|(?<=\d)[a-z](?=\))", "", first).replace("Corollaries", "Corollary")
                out[""] |= {n for n in expanded(subject) if n.startswith("(")}
                pieces = re.split(rf"\b({kinds})s?\b", subject)
                for kind, rest in zip(pieces[1::2], pieces[2::2], strict=True):
                    upto = re.match(r"[\s\d.,I–]*(?:(?:to|and)[\s\d.,I–]*)*", rest)
                    out.setdefault(kind, set()).update(expanded(upto[0] if upto else ""))
    return out


@pytest.mark.parametrize("paper", NUMBERED)
def test_everything_that_a_paper_numbers_has_a_row(paper: str) -> None:
    have = numbered([page for page in TABLES if page.stem.split("-")[0] == paper])
    for part in NUMBERED[paper].split(";"):
        kind, rest = part.split(maxsplit=1)
        if kind.startswith("("):
            kind, rest = "", part
        assert sorted(expanded(rest) - have.get(kind, set())) == [], kind


def test_numbers_are_told_from_each_other() -> None:
    assert expanded("2.2.1, 2.2.3 to 2.2.5") == {"2.2.1", "2.2.3", "2.2.4", "2.2.5"}
    assert expanded("(5) to (7), (9)") == {"(5)", "(6)", "(7)", "(9)"}
    assert "2.2.2" not in numbered(TABLES)["Theorem"]
    assert "(49)" not in numbered(TABLES)[""]
