"""The text in which a commissioning is kept: there and back, what it fits, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from feeders.load import Site, from_tables, load
from service.kept import FORMAT, Kept, KeptInvalid, decode, encode, fingerprint
from tests.service.running import FEEDER

START = 1_795_212_000.0


@pytest.fixture(scope="module")
def site() -> Site:
    return load(FEEDER)


def test_what_does_not_matter_changes_nothing(site: Site) -> None:
    meta = site.tables.meta
    monitor = replace(meta.monitor, on_delay_s=0.0, max_attacked=1, alarms_per_year=2.0)
    other = from_tables(replace(site.tables, meta=replace(meta, title="Another title", monitor=monitor)))
    assert fingerprint(other) == fingerprint(site)
    assert other.digest != site.digest


def _damaged(kept: Kept, **changes: Any) -> Kept:
    return replace(kept, text=json.dumps(json.loads(kept.text) | changes))


def test_damaged_or_newer_texts_are_refused_in_words(site: Site) -> None:
    arrays = {"a": np.array([0.1 + 0.2, np.nan, -1e-300, *range(10)])}
    now = fingerprint(site)
    kept = encode(site, now, START, arrays)
    np.testing.assert_array_equal(decode(site, now, kept)["a"], arrays["a"])
    numbers = json.loads(kept.text)["arrays"]
    for bad, said in (
        (replace(kept, text="{"), "damaged"),
        (replace(kept, text="[]"), "damaged"),
        (replace(kept, text="{}"), "damaged.*format"),
        (_damaged(kept, format=FORMAT + 1, new=1), f"format {FORMAT + 1}, and this program knows {FORMAT}"),
        (_damaged(kept, format=0), "damaged"),
        (_damaged(kept, more=1), "damaged.*more"),
        (_damaged(kept, feeder="other"), "feeder 'other'"),
        (_damaged(kept, arrays={"a": ["x"]}), "damaged"),
        (_damaged(kept, arrays={"a": numbers["a"][1:]}), "do not belong"),
        (_damaged(kept, meters=["m1"]), "do not belong"),
        (_damaged(kept, fingerprint={}), r"changed since \(meters, lines, customers"),
    ):
        with pytest.raises(KeptInvalid, match=said):
            decode(site, now, bad)
