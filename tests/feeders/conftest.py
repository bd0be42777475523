"""What tests of feeders share."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest


@pytest.fixture(scope="session")
def simbench_tables() -> Iterator[None]:
    """Let SimBench read its tables, 110 MB, only once; a copy for everybody who asks."""
    extract = pytest.importorskip(
        "simbench.networks.extract_simbench_grids_from_csv", reason="the extra `convert` is not installed"
    )
    read = cache(extract.read_csv_data)

    def copied(path: str, sep: str, tablename: str) -> Any:
        return read(path, sep, tablename).copy()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(extract, "read_csv_data", copied)
        yield
