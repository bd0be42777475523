"""Networks of pandapower for the tests of conversions."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import pandas as pd
import pytest


@pytest.fixture(scope="session", autouse=True)
def empty_tables() -> Iterator[None]:
    """Copy the tables of an empty network: pandapower makes all of them again, in 0.2 s."""
    if find_spec("pandapower") is None:
        yield
        return
    from pandapower.auxiliary import pandapowerNet

    create, made = pandapowerNet.create_dataframes, dict[str, tuple[dict[str, Any], pd.DataFrame]]()

    def copied(_: type, data: dict[str, Any]) -> dict[str, Any]:
        for key, columns in data.items():
            if isinstance(columns, dict):
                if key not in made or made[key][0] != columns:
                    made[key] = columns, create({key: columns})[key]
                data[key] = made[key][1].copy()
        return data

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pandapowerNet, "create_dataframes", classmethod(copied))
        yield
