"""Tables of studies as files."""

from __future__ import annotations

import math
from pathlib import Path

import pandas as pd
import pytest

from feeders.format.tables import write
from feeders.model.site import load
from gridsec.errors import InputInvalid
from service.cli.paths import write_tables
from tests.codes import refused


def test_both_files_hold_the_table(tmp_path: Path) -> None:
    frame = pd.DataFrame(
        {"meter": ["m,1", 'm"2'], "lie": [0.1 + 0.2, math.inf], "critical": [True, None], "n": [1, 2]}
    )
    write_tables(tmp_path / "new" / "out", "study", {"meters": frame})
    kept = pd.read_parquet(tmp_path / "new" / "out" / "study-meters.parquet")
    pd.testing.assert_frame_equal(kept, frame)
    read = pd.read_csv(tmp_path / "new" / "out" / "study-meters.csv", float_precision="round_trip")
    assert read["meter"].tolist() == ["m,1", 'm"2']
    assert read["lie"].tolist() == [0.1 + 0.2, math.inf]
    assert sorted(path.name for path in (tmp_path / "new" / "out").iterdir()) == [
        "study-meters.csv",
        "study-meters.parquet",
    ]


def test_values_of_several_types_are_text_in_parquet(tmp_path: Path) -> None:
    write_tables(tmp_path, "study", {"mixed": pd.DataFrame({"value": [1, "unknown", None]})})
    kept = pd.read_parquet(tmp_path / "study-mixed.parquet")["value"]
    assert kept.tolist()[:2] == ["1", "unknown"]
    assert pd.isna(kept[2])


def test_no_folder_and_no_rows(tmp_path: Path) -> None:
    write_tables(None, "study", {"nothing": pd.DataFrame()})
    write_tables(tmp_path, "study", {"empty": pd.DataFrame({"liars": []})})
    assert pd.read_parquet(tmp_path / "study-empty.parquet").columns.tolist() == ["liars"]


@pytest.mark.parametrize("name", ["", "../up", "a/b", ".."])
def test_a_table_stays_in_its_folder(tmp_path: Path, name: str) -> None:
    with refused(InputInvalid, "wrong-name"):
        write_tables(tmp_path / "in", "study", {name: pd.DataFrame({"a": [1]})})


def test_a_feeders_own_files_are_never_replaced(tmp_path: Path) -> None:
    write(load("cigre-lv").tables, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(FileExistsError, match="a feeder's folder"):
        write_tables(tmp_path, "study", {"customers": pd.DataFrame({"customer": ["x"]})})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_studies_share_a_folder_and_each_leaves_only_its_present_tables(tmp_path: Path) -> None:
    one, other = pd.DataFrame({"meter": ["m01"]}), pd.DataFrame({"meter": ["m02"]})
    write_tables(tmp_path, "redundancy", {"meters": one, "changes": one})
    write_tables(tmp_path, "detectable", {"meters": other})
    (tmp_path / "redundancy-notes.csv").write_text("mine")
    write_tables(tmp_path, "redundancy", {"meters": one})
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        *("detectable-meters.csv", "detectable-meters.parquet"),
        *("redundancy-meters.csv", "redundancy-meters.parquet", "redundancy-notes.csv"),
    ]
    assert pd.read_csv(tmp_path / "redundancy-meters.csv")["meter"].tolist() == ["m01"]
