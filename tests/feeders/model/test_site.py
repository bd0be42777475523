"""From tables to per unit and from readings to frames, against hand calculation and a scalar reference."""

from __future__ import annotations

import math
import subprocess
import sys
import time
import zipfile
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from feeders.format.columns import CUSTOMER_COLUMNS, LINE_COLUMNS, META_COLUMNS, SUSPICIONS, Number
from feeders.format.tables import CustomerRow, FeederTables, from_json, read, to_json, write
from feeders.model.site import Site, Snapshot, from_tables, load, names, plant, to_frame, volts
from gridsec.errors import FeederInvalid
from gridsec.interface import Frame
from tests.codes import refused

ROOT = Path(__file__).parents[3]
GOOD = ROOT / "tests" / "cases" / "good"
THREE = GOOD / "three-customers"


@pytest.fixture(scope="module")
def three() -> Site:
    return load(THREE)


# --- the model ----------------------------------------------------------------------------------


def test_per_unit_by_hand(three: Site) -> None:
    """With 3 * 230^2 / 1000 kVA one ohm is one per unit."""
    feeder = three.feeder
    assert feeder.base_volt == 230.0
    assert feeder.buses == ("station", "corner", "east", "north")
    assert feeder.customers == ("baker", "smith", "miller")
    np.testing.assert_array_equal(feeder.parent, [0, 1, 1])
    np.testing.assert_array_equal(feeder.bus, [1, 2, 3])
    np.testing.assert_allclose(feeder.r, [0.1, 0.2, 0.3], rtol=1e-12)
    np.testing.assert_allclose(feeder.x, [0.02, 0.04, 0.06], rtol=1e-12)
    np.testing.assert_allclose(feeder.charging, [1e-4, 0.0, 0.0], rtol=1e-12)
    expected = [[0.1, 0.1, 0.1], [0.1, 0.3, 0.1], [0.1, 0.1, 0.4]]
    np.testing.assert_allclose(feeder.linear().R, expected, rtol=1e-12)
    assert three.xy is not None
    np.testing.assert_array_equal(three.xy, [[0, 0], [1, 0], [2, 0], [1, 1]])


def test_droop_and_meters_by_hand(three: Site) -> None:
    np.testing.assert_array_equal(three.droop.customer, [1, 2])
    np.testing.assert_allclose(three.droop.q[0], np.array([0.44, 0.0, 0.0, -0.44]) * 6.0 / 158.7)
    np.testing.assert_allclose(three.droop.q[1], np.array([0.312, 0.0, 0.0, -0.312]) * 4.0 / 158.7)
    np.testing.assert_allclose(three.droop.tau, [5.0 / math.log(10.0), 2.5])
    np.testing.assert_array_equal(three.meters, [0, 1])
    assert three.meter_ids == ("m-baker", "m-smith")
    np.testing.assert_allclose(three.accuracy.class_fraction, [0.005, 0.01])
    np.testing.assert_allclose(three.accuracy.resolution, 0.1 / 230.0)
    np.testing.assert_allclose(three.accuracy.jitter, 5e-4)
    assert three.accuracy.busbar_class == pytest.approx(1e-3)
    assert three.accuracy.busbar_resolution == pytest.approx(0.1 / 230.0)
    assert three.accuracy.busbar_jitter == pytest.approx(2e-4)
    made = plant(three)
    assert (made.feeder, made.droop, made.meters, made.accuracy) == (
        three.feeder, three.droop, three.meters, three.accuracy,
    )  # fmt: skip


def test_zero_impedance_and_open_lines() -> None:
    site = load(GOOD / "fused")
    assert site.feeder.buses == ("bus bar A", "Münsterstraße 1", "house")
    assert dict(site.bus_of_file) == {
        "bus bar A": 0, "bus bar B": 0, "Münsterstraße 1": 1, "box, left": 1, "house": 2,
    }  # fmt: skip
    np.testing.assert_array_equal(site.feeder.bus, [2, 2, 0, 1])
    base = 3.0 * 230.0**2 / 1e5
    np.testing.assert_allclose(site.feeder.r, np.array([0.05, 0.02]) / base)
    assert site.xy is None


def test_line_direction_does_not_matter(three: Site) -> None:
    turned = replace(
        three.tables,
        lines=tuple(
            replace(line, from_bus=line.to_bus, to_bus=line.from_bus, to_x=None, to_y=None)
            for line in three.tables.lines
        ),
    )
    site = from_tables(turned)
    assert site.feeder.buses == three.feeder.buses
    np.testing.assert_array_equal(site.feeder.parent, three.feeder.parent)
    np.testing.assert_array_equal(site.feeder.r, three.feeder.r)


def test_what_takes_balanced_feeders_says_so(three: Site) -> None:
    assert three.balanced is three.feeder
    with refused(FeederInvalid, "not-balanced"):
        _ = load("ieee-european-lv").balanced


def test_feeder_without_any_impedance_is_refused() -> None:
    tables = read(GOOD / "fused")
    lines = tuple(replace(line, r_ohm=0.0, x_ohm=0.0) for line in tables.lines)
    with refused(FeederInvalid, "nothing-to-design"):
        from_tables(replace(tables, lines=lines))


def test_tables_made_in_memory_are_checked(three: Site) -> None:
    broken = replace(three.tables, customers=(CustomerRow("x", "nowhere", load_kw=-1.0),))
    with refused(FeederInvalid, "negative", "unknown-name"):
        from_tables(broken)


EXTREMES = [
    (table, column, value)
    for table, columns in [("lines", LINE_COLUMNS), ("customers", CUSTOMER_COLUMNS), *META_COLUMNS.items()]
    for column in columns
    if type(column) is Number
    for value in (column.low, column.high, column.above and column.above + 1e-300, 1e-300, 1e300)
    if value is not None
]


def test_extreme_numbers_are_refused_or_give_a_finite_model() -> None:
    """Every number of the format at its limits, every doubt accepted: no overflow, no NaN, no traceback."""
    taken = 0
    for table, column, value in EXTREMES:
        obj = to_json(read(THREE))
        obj["feeder"]["accept"] = list(SUSPICIONS)
        if table in ("lines", "customers"):
            cells = obj[table][1]
        else:
            cells = obj["feeder"][table] if table else obj["feeder"]
        cells[column.name] = value
        try:
            site = from_tables(from_json(obj))
        except FeederInvalid:
            continue
        taken += 1
        frame = to_frame(
            site, Snapshot(0.0, np.full(2, 230.0), np.array([1e300, 0.1]), np.array([np.nan, -1e300]), 1e300)
        )
        arrays = [site.feeder.r, site.feeder.x, site.feeder.charging, site.droop.q, site.droop.tau]
        arrays += [getattr(site.loads, field.name) for field in fields(site.loads)]
        arrays += [frame.y, frame.p, frame.p_error, frame.q, frame.q_error, frame.q_net_error]
        assert all(np.isfinite(array).all() for array in arrays), (table, column.name, value)
    assert taken > 50


# --- finding feeders ----------------------------------------------------------------------------


def test_unknown_names_are_refused_with_the_known_ones() -> None:
    for name in ("no-such-feeder", "../feeders/case33bw", "feeder.toml", "data\x00"):
        with refused(FeederInvalid, "unknown-name") as caught:
            load(name)
        assert "simbench-lv-rural1" in str(caught.value)


def test_folder_of_its_own(tmp_path: Path, three: Site) -> None:
    write(three.tables, tmp_path / "mine")
    assert load(tmp_path / "mine").digest == three.digest
    assert load(str(tmp_path / "mine")).digest == three.digest


def test_installed_wheel_brings_its_feeders(tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)],
        cwd=ROOT, check=True, capture_output=True, timeout=120,
    )  # fmt: skip
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    code = (
        "import feeders.model.site as l, pathlib; print(pathlib.Path(l.__file__).resolve());"
        "print(*l.names());"
        "print(l.load('simbench-lv-rural1').digest)"
    )
    found = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path, check=True, capture_output=True, text=True, timeout=60,
        env={"PYTHONPATH": str(tmp_path / "site")},
    ).stdout.splitlines()  # fmt: skip
    assert Path(found[0]).is_relative_to((tmp_path / "site").resolve())
    assert found[1].split() == names()
    assert found[2] == load("simbench-lv-rural1").digest


# --- digest -------------------------------------------------------------------------------------


def test_digest_follows_content_and_order_not_layout(tmp_path: Path, three: Site) -> None:
    for name in ("lines.csv", "customers.csv", "feeder.toml"):
        text = (THREE / name).read_text()
        if name == "lines.csv":
            text = text.replace("0.1,0.02,100", "0.10,2e-2,100.0")
        if name == "customers.csv":
            rows = [line.split(",") for line in text.splitlines()]
            text = "\n".join(",".join([row[1], row[0], *row[2:], "extra"]) for row in rows)
        (tmp_path / name).write_text(text + "\n# a comment\n" if name == "feeder.toml" else text)
    assert load(tmp_path).digest == three.digest
    tables = three.tables
    changed = [
        replace(tables, lines=tables.lines[::-1]),
        replace(tables, customers=tables.customers[::-1]),
        replace(tables, customers=(replace(tables.customers[0], load_kw=4.0000001), *tables.customers[1:])),
        replace(tables, meta=replace(tables.meta, busbar_class_percent=0.2)),
    ]
    digests = {three.digest, *(from_tables(each).digest for each in changed)}
    assert len(digests) == 1 + len(changed)


# --- frames -------------------------------------------------------------------------------------


def reference(tables: FeederTables, p_kw: float, q_kvar: float, row: CustomerRow) -> dict[str, float]:
    """What a frame must say about one customer, in kW and kvar imports, from the documented rules."""
    meters, load_defaults = tables.meta.meters, tables.meta.load
    low_factor = row.power_factor_min or load_defaults.power_factor_min
    high_factor = row.power_factor_max or load_defaults.power_factor_max
    percent = meters.p_error_percent if row.p_error_percent is None else row.p_error_percent
    limit = max(10.0 * (row.load_kw + row.pv_kw + row.inverter_kva), 50.0)
    if abs(p_kw) <= limit:
        share = percent / 100.0
        p, p_error = p_kw, (share * abs(p_kw) + 0.5 * meters.p_resolution_kw) / (1.0 - share)
        p_error += min(2.0 * max(p_kw - row.load_kw, -p_kw - row.pv_kw, 0.0), abs(p_kw))
    else:
        p, p_error = (row.load_kw - row.pv_kw) / 2.0, (row.load_kw + row.pv_kw) / 2.0
    smallest = max(p - p_error, 0.0)
    largest = max(p + p_error, min(p + p_error + row.pv_kw, row.load_kw), 0.0)
    floor = (
        load_defaults.q_floor_percent / 100.0 * row.load_kw if row.q_floor_kvar is None else row.q_floor_kvar
    )
    below = smallest * math.tan(math.acos(high_factor)) - floor
    above = largest * math.tan(math.acos(low_factor)) + floor
    q_percent = meters.q_error_percent if row.q_error_percent is None else row.q_error_percent
    span = max(row.load_kw / low_factor, row.pv_kw, row.inverter_kva)
    reported = abs(q_kvar) <= limit
    return {
        "p": p, "p_error": p_error, "q": (below + above) / 2.0, "q_error": (above - below) / 2.0,
        "q_net": q_kvar if reported else math.nan,
        "q_net_error": q_percent / 100.0 * max(span, abs(q_kvar) if reported else 0.0),
    }  # fmt: skip


readings = st.floats(-200.0, 200.0) | st.just(math.nan) | st.sampled_from([math.inf, -1e308, 1e308, 0.0])


@given(
    st.lists(readings, min_size=2, max_size=2),
    st.lists(readings, min_size=2, max_size=2),
    st.lists(st.floats(allow_nan=True), min_size=3, max_size=3),
)
def test_frame_against_a_scalar_reference(p_kw: list[float], q_kvar: list[float], v: list[float]) -> None:
    site = load(THREE)
    frame = to_frame(site, Snapshot(12.5, np.array(v[:2]), np.array(p_kw), np.array(q_kvar), v[2]))
    assert frame.t == 12.5
    wanted = [
        reference(site.tables, p_kw[k] if k < 2 else math.nan, q_kvar[k] if k < 2 else math.nan, row)
        for k, row in enumerate(site.tables.customers)
    ]
    # A register without a finite model error is replaced by the declared range: tests of `registered`.
    drawn, reactive = (np.array([one[name] for one in wanted]) / 158.7 for name in ("p", "q"))
    with np.errstate(all="ignore"):
        assume(np.isfinite(site.feeder.model_error_bound(-drawn, -reactive, 1.0)).all())
    for k, (row, expected) in enumerate(zip(site.tables.customers, wanted, strict=True)):
        for name, value in expected.items():
            sign = -1.0 if name in ("p", "q", "q_net") else 1.0
            got = sign * getattr(frame, name)[k] * 158.7
            assert got == pytest.approx(value, rel=1e-9, abs=1e-12, nan_ok=True), (row.customer, name)
    np.testing.assert_array_equal(frame.seen, np.isfinite(v[:2]))
    for volt, y in zip(v, [*frame.y, frame.v0_squared], strict=True):
        if not math.isfinite(volt):
            assert math.isnan(y)
        elif 0.0 <= volt <= 23000.0:
            assert y == pytest.approx((volt / 230.0) ** 2)
        else:
            assert math.isfinite(y)
            assert abs(y) <= 1e4 * (1 + 1e-12)
    for name in ("p", "p_error", "q", "q_error", "q_net_error"):
        assert np.isfinite(getattr(frame, name)).all(), name
    assert (frame.p_error >= 0).all()
    assert (frame.q_error >= 0).all()


def test_signs(three: Site) -> None:
    """Imports on the wire are positive; injections in the frame are."""
    frame = to_frame(
        three, Snapshot(0.0, np.full(2, 230.0), np.array([2.0, -3.0]), np.array([0.5, np.nan]), 235.0)
    )
    np.testing.assert_allclose(frame.p[:2], [-2.0 / 158.7, 3.0 / 158.7])
    assert frame.q_net[0] == pytest.approx(-0.5 / 158.7)
    assert frame.q[0] < 0.0  # a lagging load draws reactive power
    assert frame.v0_squared == pytest.approx((235.0 / 230.0) ** 2)


def test_a_negative_voltage_is_no_honest_one(three: Site) -> None:
    frame = to_frame(
        three, Snapshot(0.0, np.array([-230.0, 0.0]), np.full(2, 1.0), np.full(2, np.nan), -230.0)
    )
    np.testing.assert_allclose(frame.y, [-1.0, 0.0])
    assert frame.seen.all()
    assert frame.v0_squared == 0.0


@given(st.data())
def test_the_interval_holds_the_truth(data: st.DataObject) -> None:
    """Whatever load, power factor and generation there are, the frame's intervals hold them."""
    site = load(THREE)
    p_kw, q_kvar, net = [], [], []
    for row in site.tables.customers:
        consumed = data.draw(st.floats(0.0, row.load_kw))
        generated = data.draw(st.floats(0.0, row.pv_kw))
        factor = data.draw(st.floats(0.8, 1.0))
        stray = data.draw(st.floats(-0.1, 0.1)) * row.load_kw
        p_kw.append(consumed - generated)
        q_kvar.append(consumed * math.tan(math.acos(factor)) + stray)
        error = data.draw(st.floats(-0.01, 0.01)) * p_kw[-1]
        net.append(round((p_kw[-1] + error) / 0.01) * 0.01 if data.draw(st.booleans()) else math.nan)
    frame = to_frame(site, Snapshot(0.0, np.full(2, 230.0), np.array(net[:2]), np.full(2, np.nan), 230.0))
    assert (np.abs(-np.array(p_kw) / 158.7 - frame.p) <= frame.p_error + 1e-12).all()
    assert (np.abs(-np.array(q_kvar) / 158.7 - frame.q) <= frame.q_error + 1e-12).all()


def test_volts_undoes_the_square() -> None:
    np.testing.assert_allclose(
        volts(np.full(2, 230.0), np.array([[1.0, 0.81], [-0.5, 1.21]])), [[230.0, 207.0], [0.0, 253.0]]
    )


def test_frames_are_fast_enough_to_replay_days() -> None:
    """146 customers; a day at 1 Hz within a quarter of a minute, so far below 1 ms a frame."""
    site = load("kerber-vorstadtnetz")
    count = len(site.meter_ids)
    rng = np.random.default_rng(1)
    snapshot = Snapshot(
        0.0, rng.normal(230, 2, count), rng.normal(1, 2, count), np.full(count, np.nan), 231.0
    )
    best = math.inf
    for _ in range(5):
        start = time.thread_time()
        for _ in range(50):
            frame: Frame = to_frame(site, snapshot)
        best = min(best, (time.thread_time() - start) / 50)
    assert frame.p.size == count
    assert best < 1e-3


def test_site_arrays_cannot_be_changed(three: Site) -> None:
    arrays: list[Any] = [three.meters, three.feeder.r, three.loads.load_peak, three.xy]
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
