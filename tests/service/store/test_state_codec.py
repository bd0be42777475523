"""The text in which a commissioning is kept: there and back, what it fits, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from feeders.model.site import Site, from_tables, load
from gridsec.estimators.sequential import SuspicionRecord
from service.store.state_codec import (
    FORMAT,
    KeptInvalid,
    StateSnapshot,
    decode,
    decode_distrust,
    encode,
    encode_distrust,
    fingerprint,
)
from tests.codes import refused
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


def _damaged(kept: StateSnapshot, **changes: Any) -> StateSnapshot:
    return replace(kept, text=json.dumps(json.loads(kept.text) | changes))


def test_damaged_or_newer_texts_are_refused(site: Site) -> None:
    arrays = {"a": np.array([0.1 + 0.2, np.nan, -1e-300, *range(10)])}
    now = fingerprint(site)
    kept = encode(site, now, START, arrays)
    np.testing.assert_array_equal(decode(site, now, kept)["a"], arrays["a"])
    numbers = json.loads(kept.text)["arrays"]
    for bad, code, field in (
        (replace(kept, text="{"), "damaged", ""),
        (replace(kept, text="[]"), "damaged", ""),
        (replace(kept, text="{}"), "damaged", "`format`"),
        (_damaged(kept, format=FORMAT + 1, new=1), "newer-format", f" {FORMAT + 1}; "),
        (_damaged(kept, format=0), "damaged", "$.format"),
        (_damaged(kept, more=1), "damaged", "`more`"),
        (_damaged(kept, feeder="other"), "other-feeder", "'other'"),
        (_damaged(kept, arrays={"a": ["x"]}), "damaged", "$.arrays"),
        (_damaged(kept, arrays={"a": numbers["a"][1:]}), "other-meters", ""),
        (_damaged(kept, meters=["m1"]), "other-meters", ""),
        (_damaged(kept, fingerprint={}), "feeder-changed", "(meters, lines, customers"),
    ):
        with refused(KeptInvalid, code) as caught:
            decode(site, now, bad)
        assert field in str(caught.value)


def test_who_is_not_believed_comes_back_by_name(site: Site) -> None:
    p, m = len(site.meter_ids), site.droop.tau.size
    which, inverters = np.arange(p) % 5 == 1, np.arange(m) == m - 1
    before = replace(
        SuspicionRecord.empty(p, m),
        scale_s=np.where(which, 1.0 / 3.0, np.nan),
        repeats_s=np.where(which & (np.arange(p) > 7), 900.0, np.nan),
        named=which & (np.arange(p) > 5),
        inverters=inverters,
    )
    kept = encode_distrust(site, START, before)
    assert decode_distrust(site, kept).same(before)
    whole = json.loads(kept.text)
    suspect, deviant = whole["meters"][0], whole["inverters"][0]
    # Whoever does not exist any more is nobody.
    more = _damaged(
        kept,
        meters=[*whole["meters"], suspect | {"meter": "gone"}],
        inverters=[*whole["inverters"], deviant | {"number": 7}],
    )
    assert decode_distrust(site, more).same(before)
    for bad, code, field in (
        (replace(kept, text="{"), "damaged", ""),
        (_damaged(kept, format=FORMAT + 1), "newer-format", f" {FORMAT + 1}; "),
        (_damaged(kept, feeder="other"), "other-feeder", "'other'"),
        (_damaged(kept, more=1), "damaged", "`more`"),
        (_damaged(kept, t=1e400), "damaged", ""),
        (_damaged(kept, meters=[suspect, suspect]), "duplicate", ""),
        (_damaged(kept, meters=[suspect | {"scale_s": 0.0}]), "damaged", ".scale_s"),
        (_damaged(kept, meters=[suspect | {"scale_s": None}]), "damaged", ".scale_s"),
        (_damaged(kept, meters=[suspect | {"named": 1}]), "damaged", ".named"),
        (_damaged(kept, inverters=[deviant | {"number": -1}]), "damaged", ".number"),
    ):
        with refused(KeptInvalid, code) as caught:
            decode_distrust(site, bad)
        assert field in str(caught.value)
