"""The text in which a commissioning is kept: there and back, what it fits, and what is refused."""

from __future__ import annotations

import json
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from feeders.model.site import Site, from_tables, load
from gridsec.estimators.front import ObserverRecord, SuspicionRecord
from service.store.state_codec import (
    FORMAT,
    KeptInvalid,
    SnapshotKind,
    StateSnapshot,
    decode,
    decode_distrust,
    decode_observer,
    encode,
    encode_distrust,
    encode_observer,
    fingerprint,
    observer_fingerprint,
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


def _observer(site: Site) -> ObserverRecord:
    """An observer with some inverters at the ends of their curves."""
    droop, rng = site.droop, np.random.default_rng(1)
    part = np.where(np.arange(droop.tau.size) % 3, rng.uniform(0.0, 1.0, droop.tau.size), 1.0)
    x = droop.q[:, 3] + part * droop.span
    return ObserverRecord(START, x, rng.uniform(0.8, 1.2, x.size), 0.1 + 0.2, 1e-300)


def test_an_observer_comes_back_in_single_precision(site: Site) -> None:
    before, now = _observer(site), observer_fingerprint(site)
    kept = encode_observer(FEEDER, now, before)
    assert (kept.feeder, kept.t, kept.matter) == (FEEDER, START, SnapshotKind.OBSERVER)
    after = decode_observer(site, now, kept)
    np.testing.assert_allclose(after.x, before.x, rtol=1e-7)
    np.testing.assert_allclose(after.input, before.input, rtol=1e-7)
    assert (after.t, after.transient) == (before.t, before.transient)
    # The error covers the rounding.
    assert (np.abs(after.x - before.x) <= (after.error - before.error) * site.droop.span).all()
    assert decode_observer(site, now, encode_observer(FEEDER, now, replace(before, error=1.0))).error == 1.0
    # 146 inverters fit into a page of PostgreSQL without compression.
    wide = replace(before, x=np.zeros(146), input=np.zeros(146))
    assert len(encode_observer(FEEDER, now, wide).text) < 2000


def test_damaged_newer_or_foreign_observers_are_refused(site: Site) -> None:
    before, now = _observer(site), observer_fingerprint(site)
    kept, least = encode_observer(FEEDER, now, before), site.droop.q[:, 3]

    def with_arrays(**changes: Any) -> StateSnapshot:
        return encode_observer(FEEDER, now, replace(before, **changes))

    for bad, code, field in (
        (replace(kept, text=kept.text[:-9]), "damaged", ""),
        (_damaged(kept, format=FORMAT + 1), "newer-format", f" {FORMAT + 1}; "),
        (_damaged(kept, feeder="other"), "other-feeder", "'other'"),
        (_damaged(kept, fingerprint="0"), "feeder-changed", ""),
        (_damaged(kept, x="AAAA"), "damaged", "inverters"),
        (_damaged(kept, x="?"), "damaged", "$.x"),
        (_damaged(kept, error=1.5), "damaged", "$.error"),
        (_damaged(kept, transient=-0.1), "damaged", "$.transient"),
        (with_arrays(x=np.full_like(before.x, np.nan)), "damaged", "impossible"),
        (with_arrays(x=least - 0.01 * site.droop.limit), "damaged", "impossible"),
        (with_arrays(input=np.full_like(before.x, np.inf)), "damaged", "impossible"),
        (with_arrays(input=np.full_like(before.x, -0.1)), "damaged", "impossible"),
    ):
        with refused(KeptInvalid, code) as caught:
            decode_observer(site, now, bad)
        assert field in str(caught.value)


def test_an_observer_belongs_to_its_droop_curves(site: Site) -> None:
    """Another program may have other presets with the same tables."""
    other, meta = copy(site), site.tables.meta
    object.__setattr__(other, "droop", replace(site.droop, tau=2.0 * site.droop.tau))
    assert fingerprint(other) == fingerprint(site)
    assert observer_fingerprint(other) != observer_fingerprint(site)
    titled = from_tables(replace(site.tables, meta=replace(meta, title="Another title")))
    assert observer_fingerprint(titled) == observer_fingerprint(site)
