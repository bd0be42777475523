"""Files and folders that cannot be used are told before the work, all of them, and nothing is left behind."""

from __future__ import annotations

from pathlib import Path

import pytest

from feeders.format.tables import write
from service.cli.paths import Unusable, check_paths
from tests.codes import refused
from tests.feeders.villages import tables
from tests.service.commands import command, plain

run = command()

MISSING = "there is no such file"
NO_FILE = "a folder; expected a file"
NO_FOLDER = "a file; expected a folder"

WRONG = [
    (
        "study redundancy cigre-lv --out FILE --journal FOLDER",
        {"--out FILE": NO_FOLDER, "--journal FOLDER": NO_FILE},
    ),
    ("study redundancy cigre-lv --out FILE/deep/er", {"--out FILE/deep/er": "FILE is a file"}),
    ("study protect cigre-lv --out VILLAGE", {"--out VILLAGE": "a feeder's folder"}),
    ("study detectable cigre-lv --out new --journal new", {"--journal new": "--out uses it as well"}),
    ("study droop cigre-lv --out new --journal FILE/j", {"--journal FILE/j": "FILE is a file"}),
    (
        "study campaign cigre-lv --out new/j/out --journal new/j",
        {"--journal new/j": "--out uses it as well"},
    ),
    (
        "study calibrate cigre-lv --readings none --out FILE --journal FOLDER --write VILLAGE",
        {
            "--readings none": MISSING,
            "--out FILE": NO_FOLDER,
            "--journal FOLDER": NO_FILE,
            "--write VILLAGE": "exists; expected a new folder",
        },
    ),
    ("study compare cigre-lv --csv FOLDER --write none", {"--csv FOLDER": NO_FILE, "--write none": MISSING}),
    (
        "study report cigre-lv --out FOLDER --readings none",
        {"--out FOLDER": NO_FILE, "--readings none": MISSING},
    ),
    ("study report cigre-lv --out in/r.html", {"--out, tables in/r-files/tables": NO_FOLDER}),
    ("simulate cigre-lv --out FOLDER", {"--out FOLDER": NO_FILE}),
    ("reproduce kim2018 --out FILE", {"--out FILE": NO_FOLDER}),
    ("convert pandapower:example_simple FILE", {"FOLDER FILE": NO_FOLDER}),
]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with all that is in the way; the journals' own is beside it."""
    here = tmp_path / "here"
    (here / "FOLDER").mkdir(parents=True)
    (here / "FILE").write_text("mine", encoding="utf-8")
    write(tables(), here / "VILLAGE")
    (here / "in" / "r-files").mkdir(parents=True)
    (here / "in" / "r-files" / "tables").write_text("mine", encoding="utf-8")
    monkeypatch.chdir(here)
    monkeypatch.setenv("GRIDSEC_CACHE_DIR", str(tmp_path / "cache"))
    return here


def content(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}


@pytest.mark.parametrize(("words", "told"), WRONG, ids=[" ".join(words.split()[:2]) for words, _ in WRONG])
def test_every_command_looks_before_it_works(
    words: str,
    told: dict[str, str],
    place: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = content(place.parent)
    code, out, error = run(monkeypatch, capsys, *words.split())
    assert (code, out) == (6, "")
    said = plain(error).replace(f"{place}/", "")
    for what, why in told.items():
        assert f"{what}: {why}" in said
    assert content(place.parent) == before


@pytest.mark.parametrize(
    "readings", ["nonsense", "meter,t,v_volt\nm99,0,230\n"], ids=["no table", "another feeder's"]
)
def test_readings_that_are_none_do_not_cost_the_other_studies(
    readings: str, place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (place / "readings.csv").write_text(readings, encoding="utf-8")
    before = content(place.parent)
    code, out, error = run(monkeypatch, capsys, "study", "report", "cigre-lv", "--readings", "readings.csv")
    assert (code, out) == (6, "")
    assert "readings" in error
    assert content(place.parent) == before


def test_what_nobody_can_write_into_is_told(place: Path) -> None:
    with refused(Unusable, "not-writable"):
        check_paths(folders={"--out": Path("/proc/no/such/folder")})
    (place / "link").symlink_to("nowhere")
    with refused(Unusable, "dead-link"):
        check_paths(folders={"--out": Path("link")})
    with refused(Unusable, "no-access", "not-file") as caught:
        check_paths(folders={"--out": Path("x" * 300)}, files={"--csv": Path("FOLDER")})
    assert [each.partition(": ")[0] for each in caught.value.problems] == [
        "--out " + "x" * 300,
        "--csv FOLDER",
    ]


def test_what_can_be_written_is_not_touched(place: Path) -> None:
    before = content(place.parent)
    check_paths(
        folders={"--out": Path("FOLDER"), "--more": Path("new/folder"), "--not-given": None},
        over={"folder": Path("VILLAGE")},
        new={"--write": Path("copy")},
        files={"--csv": Path("FILE"), "--journal": Path("new/journal")},
        replaced={"--page": Path("page.html")},
        read={"--csv": Path("FILE"), "--readings": Path("VILLAGE/customers.csv")},
    )
    assert content(place.parent) == before
