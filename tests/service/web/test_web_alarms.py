"""The web page: alarms, what is learned of meters, and whether the page can be believed."""

from __future__ import annotations

import re
import time
from dataclasses import replace

import pytest
from playwright.sync_api import APIResponse, Route, expect

from gridsec.estimators.data_errors import DataErrorKind
from gridsec.estimators.front import LearningReason, LearningState
from gridsec.interface import Cause
from service.alarms.state_machine import AlarmState, AlarmTransition, Change
from service.report.data_errors import DataErrorReport
from service.report.report import (
    BusbarMeterState,
    CustomerState,
    InverterState,
    LearningReport,
    StalledMeter,
    with_data_error,
    with_learning,
)
from tests.service.asking import T0
from tests.service.looking import LOOKS, READABLE, Site, contrast, customer
from tests.service.stored import an_alarm, raised

pytestmark = pytest.mark.browser

ALARMS = re.compile(r"/api/v1/alarms")
LIST = re.compile(r"/api/v1/alarms\?")
PAUSE_S = 60.0
"""Time from the present at which a page's clock stands, s: above the delay of a call."""


def test_a_manipulated_inverter_and_its_alarm(site: Site) -> None:
    wrong = InverterState("H7", "drop-7", "H7", True, True, 4.5, -6.0)
    customers = tuple(CustomerState(f"H{k}", 230.0, 0.25) for k in range(13))
    for k in range(4):
        report = site.village.report(T0 + k, cause=Cause.RESIDUALS)
        liar = replace(report.meters[2], suspect=True, attack_volt_estimated=9.0, kind="drift")
        meters = (*report.meters[:2], liar, *report.meters[3:])
        site.service.tick(replace(report, meters=meters, inverters=(wrong,), customers=customers))
    page = site.open()
    expect(page.locator("#chips")).to_contain_text("inverter of H7 −6.0 kvar")
    alarm = page.locator('.alarm:has-text("Inverter manipulated")')
    expect(alarm).to_contain_text("injects -6.0 kvar")
    alarm.locator("a.where").click()
    panel = page.locator("#detail-card")
    expect(page.locator("#detail-title")).to_have_text("H7")
    expect(panel).to_contain_text("+4.5 kvar")
    expect(panel).to_contain_text("−6.0 kvar")
    expect(panel).to_contain_text("Standard deviation")
    expect(panel).to_contain_text("0.25 V")
    expect(page.locator('.alarm:has-text("Meter manipulated")')).to_contain_text("drift")
    page.select_option("#alarm-kind", "inverter-manipulated")
    expect(page.locator(".alarm")).to_have_count(1)


def test_an_error_of_the_files_stands_beside_the_accusation(site: Site) -> None:
    """In the reason of the verdict, at the alarm, which has it later than it was raised, and at the meter."""
    text = "An error of the feeder's files explains this as well: customer H3 at another bus (bus drop-9)."
    study = "gridsec study calibrate village"
    error = DataErrorReport(DataErrorKind.BUS, ("H3",), ("H3",), ("bus drop-9",), study, text)
    page = site.open()
    for k in range(5):
        report = site.village.report(T0 + k, cause=Cause.RESIDUALS)
        (at,) = (j for j, m in enumerate(report.meters) if m.meter == "H3")
        liar = replace(report.meters[at], suspect=True, attack_volt_estimated=9.0)
        report = replace(report, meters=(*report.meters[:at], liar, *report.meters[at + 1 :]))
        site.service.tick(with_data_error(report, error if k == 4 else None))
    expect(page.locator("#reason")).to_contain_text(text)
    expect(page.locator(".alarm .hint")).to_have_text(text)
    page.locator(".alarm a.where").click()
    expect(page.locator("#detail-card")).to_contain_text("bus drop-9")


@pytest.mark.canary("desktop")
@LOOKS
def test_a_busbar_meter_that_lies_is_marked(site: Site, size: dict[str, int], scheme: str) -> None:
    """In words and shapes, wherever a suspect meter is; and everything is as before once it is believed."""
    honest = BusbarMeterState(True, True, False, (), None, 231.0, 231.0, 0.0)
    site.service.tick(replace(site.village.report(T0), busbar=honest))
    page = site.open(size, color_scheme=scheme)
    note, mark, name = (
        page.locator("#busbar-meter"),
        page.locator(".busbar-liar"),
        page.locator(".busbar-name"),
    )
    expect(page.locator("#decision")).to_have_text("CLEAN")
    expect(note).to_be_hidden()
    expect(mark).to_be_hidden()
    expect(name).to_have_text("Busbar (busbar): 230.9 V")
    liar = BusbarMeterState(True, True, True, ("b",), "b", 238.0, 231.0, 7.0)
    for k in range(1, 5):
        site.service.tick(replace(site.village.report(T0 + k, cause=Cause.RESIDUALS), busbar=liar))
    off = "Busbar meter suspect, phase b: reports 238.0 V, reconstructed 231.0 V (+7.0 V)"
    expect(note).to_have_text(off)
    expect(mark).to_be_visible()
    expect(mark.locator(".sign")).to_have_text("!")
    expect(mark.locator(".note")).to_have_text("+7.0")
    expect(name).to_have_text("◆ Busbar (busbar): 230.9 V")
    expect(page.locator("#chips")).to_have_text("substation · busbar meter +7.0 V")
    alarm = page.locator('.alarm:has-text("Meter manipulated")')
    expect(alarm).to_contain_text("substation · busbar meter · village")
    assert contrast(page, ".alarm :is(b, p, a, button, span), .incident :is(b, span)") > READABLE
    expect(alarm).to_contain_text("238.0 V reported, 231.0 V reconstructed (+7.0 V)")
    page.locator("#meters-box summary").click()
    expect(page.locator("#meters tr").first).to_contain_text("substation")
    expect(page.locator("#meters tr").first).to_contain_text("suspect")
    box, card = mark.bounding_box(), page.locator("#diagram").bounding_box()
    assert box is not None
    assert card is not None
    assert card["x"] <= box["x"]
    assert box["x"] + box["width"] <= card["x"] + card["width"]
    assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
    site.service.tick(replace(site.village.report(T0 + 5), busbar=honest))
    expect(note).to_be_hidden()
    expect(mark).to_be_hidden()
    expect(page.locator("#chips")).to_be_empty()


def test_an_alarm_is_acknowledged_with_a_name(site: Site) -> None:
    site.tick(T0, 4, lies={"H3": 9.0})
    page = site.open()
    page.locator("button.ack").click()
    page.locator("#act-send").click()  # no name: the form stays
    expect(page.locator("#act")).to_be_visible()
    page.fill("#act-who", "   ")
    page.locator("#act-send").click()
    expect(page.locator("#act-error")).to_have_text("Please enter your name.")
    page.fill("#act-who", "Ada <b>")
    page.fill("#act-text", "van sent")
    page.locator("#act-send").click()
    expect(page.locator("#act")).to_be_hidden()
    expect(page.locator(".alarm .answer")).to_have_text("Acknowledged by Ada <b>van sent")
    expect(page.locator("button.ack")).to_have_count(0)
    (alarm,) = site.service.store.alarms()[0]
    assert (alarm.acknowledged_by, alarm.comment) == ("Ada <b>", "van sent")


def test_a_single_alarm_is_commented_and_its_acknowledgement_withdrawn(site: Site) -> None:
    site.service.wall = lambda: T0 + 10
    site.tick(T0, 4, lies={"H3": 9.0, "H5": 9.0})
    page = site.open()
    one = page.locator('#alarm-list .alarm:has-text("H3")')
    expect(one.locator("button.withdraw")).to_have_count(0)
    one.locator("button.ack").click()
    page.fill("#act-who", "Ada")
    page.click("#act-send")
    # A known name is not typed again: the cursor stands in the text.
    one.locator('[data-do="comment"]').click()
    expect(page.locator("#act-text")).to_be_focused()
    page.click("#act-send")
    expect(page.locator("#act")).to_be_visible()
    page.keyboard.type("fuse <b>changed")
    page.click("#act-send")
    one.locator('[data-do="log"]').click()
    log = one.locator(".log li")
    expect(log).to_have_count(3)
    expect(log.last).to_contain_text("comment by Adafuse <b>changed")
    one.locator("button.withdraw").click()
    page.fill("#act-text", "wrong house")
    page.click("#act-send")
    expect(one.locator("button.ack")).to_be_visible()
    expect(one).to_have_attribute("data-state", "raised")
    expect(one.locator("button.ack")).to_be_focused()
    # The open log follows.
    expect(log.last).to_contain_text("acknowledgement withdrawn by Adawrong house")
    found = {alarm.meter: alarm.acknowledged_by for alarm in site.service.store.alarms()[0]}
    assert found == {"H3": None, "H5": None}
    # The same actions within the incident.
    page.locator(".incident .line").click()
    inside = page.locator('.incident .alarm:has-text("H3")')
    expect(inside.locator(".log li")).to_have_count(4)
    inside.locator("button.ack").click()
    page.click("#act-send")
    expect(inside.locator("button.withdraw")).to_be_visible()
    expect(one.locator("button.withdraw")).to_be_visible()
    inside.locator('[data-do="log"]').click()
    expect(page.locator(".alarm .log")).to_have_count(0)


def test_a_pressed_button_stays_until_its_release_for_at_most_a_second(site: Site) -> None:
    """Another operator acknowledges between press and release; the page's clock stands."""
    site.service.wall = lambda: T0 + 10
    site.tick(T0, 4, lies={"H3": 9.0, "H5": 9.0})
    page = site.open()
    page.clock.install()
    page.reload()
    page.evaluate("document.querySelector('#alarm-box').open = true")
    expect(page.locator("#alarm-list button.ack")).to_have_count(2)
    expect(page.locator(".incident")).to_have_count(1)
    page.clock.pause_at(time.time() + PAUSE_S)
    for meter, held_ms in (("H3", 999), ("H5", 1000)):
        one = page.locator(f'#alarm-list .alarm:has-text("{meter}")')
        one.locator('[data-do="log"]').click()
        page.clock.run_for(1)
        expect(one.locator(".log li")).to_have_count(1)
        one.locator('[data-do="comment"]').hover()
        page.mouse.down()
        expect(one.locator('[data-do="comment"]:active')).to_have_count(1)
        page.clock.run_for(held_ms - 1)
        (alarm,) = (each for each in site.service.store.alarms()[0] if each.meter == meter)
        with page.expect_response(re.compile(rf"/api/v1/alarms/{alarm.id}/events")):  # the page has the event
            answer = page.request.post(
                f"{site.server.url}/api/v1/alarms/{alarm.id}/ack", data={"who": "Bob", "count": 1}
            )
        assert answer.ok
        expect(one.locator("button.ack")).to_be_visible()
        page.clock.run_for(1)
        if held_ms < 1000:
            page.mouse.up()
            expect(page.locator("#act")).to_be_visible()
            page.clock.run_for(1)
            page.click("#act-cancel")
        expect(one).to_contain_text("Acknowledged by Bob")
    page.mouse.up()
    expect(page.locator("#act")).to_be_hidden()


def test_what_is_learned_of_the_meters_and_a_replaced_one(site: Site) -> None:
    site.tick(T0, 4, lies={"H3": 9.0})
    page = site.open()
    expect(page.locator("#commissioning")).to_contain_text("Meters' own errors learned on ")
    customer(page, "H3").click()
    panel = page.locator("#detail-card")
    expect(panel).to_contain_text("+0.41 V")
    expect(panel).to_contain_text("± 0.09 V, learned on ")
    page.locator("#replaced").click()
    expect(page.locator("#act-what")).to_contain_text("Meter H3 of village")
    page.fill("#act-who", "Ada <b>")
    page.fill("#act-text", "  ")
    page.locator("#act-send").click()
    expect(page.locator("#act-error")).to_have_text("Please enter the reason.")
    page.fill("#act-text", "new <i>meter")
    page.locator("#act-send").click()
    expect(page.locator("#act")).to_be_hidden()
    expect(page.locator("#commissioning")).to_have_text("Learning 1 of 13 meters, 5 of 24 h.")
    expect(panel).to_contain_text("not learned yet 5 of 24 h gathered, learning")
    (event,) = site.service.store.commission_events("village")
    assert (event.who, event.reason, event.meters) == ("Ada <b>", "new <i>meter", ("H3",))


def test_a_commissioning_that_begins_anew_says_why(site: Site) -> None:
    site.service.learning.update(site.village.meters)
    site.service.note = "the feeder has changed since (<b>lines)"
    site.tick(T0)
    page = site.open()
    expect(page.locator("#commissioning")).to_have_text(
        "Learning meters, 5 of 24 h. Restarted: the feeder has changed since (<b>lines)."
    )


def test_stalled_learning_is_shown_with_its_reasons_and_its_alarm(site: Site) -> None:
    silent, no_busbar = LearningReason.SILENT, LearningReason.NO_BUSBAR
    why = {"H2": silent, "H3": no_busbar, "H5": no_busbar}
    site.service.learning.update(["H1", *why])
    site.service.stalled.update(why)
    learning = LearningReport(
        tuple(LearningState.STALLED if m in why else LearningState.LEARNED for m in site.village.meters),
        tuple(map(why.get, site.village.meters)),
        86_401.0,
        tuple(StalledMeter(m, reason, 0.0) for m, reason in why.items()),
    )
    for k in range(4):
        site.service.tick(with_learning(site.village.report(T0 + k), learning))
    page = site.open()
    expect(page.locator("#commissioning")).to_have_text(
        "Learning 4 of 13 meters, 5 of 24 h. Delayed: 3, stalled: 3. "
        "Reasons: no busbar voltage (2), no readings (1)."
    )
    customer(page, "H3").click()
    panel = page.locator("#detail-card")
    expect(panel).to_contain_text("not learned yet 5 of 24 h gathered, stalled: no busbar voltage")
    page.select_option("#alarm-kind", "learning-stalled")
    alarm = page.locator(".alarm")
    expect(alarm).to_have_count(1)
    expect(alarm).to_contain_text("Learning stalled")
    expect(alarm).to_contain_text("minor")
    expect(alarm).to_contain_text("no-busbar (2), silent (1). Meters: H2, H3, H5")


def test_the_second_operator_hears_who_was_first(site: Site) -> None:
    site.tick(T0, 4, lies={"H3": 9.0})
    one, two = site.open(), site.open()
    two.locator("button.ack").click()
    one.locator("button.ack").click()
    one.fill("#act-who", "Ada")
    one.locator("#act-send").click()
    expect(two.locator(".alarm .answer")).to_contain_text("Ada")  # it arrives behind the open dialogue
    site.expected = "409"
    two.fill("#act-who", "Grace")
    two.locator("#act-send").click()
    expect(two.locator("#act-error")).to_contain_text("already been acknowledged by Ada")


def test_nobody_answers_an_alarm_that_has_come_back_behind_the_dialogue(site: Site) -> None:
    site.tick(T0, 4, lies={"H3": 2.0})
    page = site.open()
    page.locator("button.ack").click()
    site.tick(T0 + 4, 8)
    site.tick(T0 + 12, 4, lies={"H3": 40.0})
    expect(page.locator(".alarm .times")).to_have_text("× 2")
    site.expected = "409"
    page.fill("#act-who", "Ada")
    page.locator("#act-send").click()
    expect(page.locator("#act-error")).to_contain_text("raised 2 times by now")
    expect(page.locator(".alarm")).to_have_attribute("data-state", "raised")
    page.locator("#act-cancel").click()
    page.locator("button.ack").click()
    page.locator("#act-send").click()
    expect(page.locator(".alarm .answer")).to_contain_text("Ada")


def test_what_has_not_changed_stays_where_it_is(site: Site) -> None:
    """Else a click whose halves fall on two copies of a button is none."""
    site.tick(T0, 4, lies={"H3": 9.0})
    page = site.open()
    button = page.locator("button.ack")
    button.focus()
    button.evaluate("(node) => { node.dataset.mine = 'yes'; }")
    site.tick(T0 + 4, 4, lies={"H3": 9.0, "H5": 9.0})
    expect(page.locator(".alarm")).to_have_count(2)
    expect(page.locator(".alarm").first).to_contain_text("H5")
    kept = page.locator('[data-mine="yes"]')
    expect(kept).to_have_count(1)
    expect(kept).to_be_focused()


def test_an_alarm_that_overtakes_the_list_stays(site: Site) -> None:
    site.tick(T0)
    page = site.open()
    expect(page.locator("#alarm-none")).to_be_visible()
    held: list[tuple[Route, APIResponse]] = []
    page.route(LIST, lambda route: held.append((route, route.fetch())), times=1)
    page.select_option("#alarm-kind", "meter-manipulated")
    while not held:
        page.wait_for_timeout(20)
    site.tick(T0 + 1, 4, lies={"H3": 9.0})  # after the server read the list, and before the page has it
    expect(page.locator(".alarm")).to_have_count(1)
    ((route, answer),) = held
    with page.expect_response(LIST):
        route.fulfill(response=answer)
    page.wait_for_timeout(300)
    expect(page.locator(".alarm")).to_have_count(1)


@pytest.mark.acceptance
def test_a_list_that_cannot_be_loaded_is_said_and_asked_for_again(site: Site) -> None:
    site.tick(T0, 4, lies={"H3": 9.0}, silent=("H5",))
    page = site.open()
    expect(page.locator(".alarm")).to_have_count(2)
    site.expected = "net::ERR_"
    page.route(LIST, lambda route: route.abort())
    error = page.locator("#alarm-error")
    page.select_option("#alarm-kind", "voltage-limit")
    expect(error).to_contain_text("Alarms not loaded: ")
    expect(page.locator(".alarm")).to_have_count(0)
    expect(page.locator("#alarm-none")).to_be_hidden()  # nobody knows
    for control, choice in (("#alarm-kind", "data-loss"), ("#alarm-scope", "this"), ("#alarm-state", "all")):
        page.select_option(control, choice)
        expect(error).to_contain_text("Alarms not loaded: ")
    page.unroute(LIST)
    expect(error).to_be_hidden()
    expect(page.locator(".alarm")).to_have_count(1)
    # The stream goes on as well.
    site.tick(T0 + 4, 4, silent=("H5", "H6"))
    expect(page.locator(".alarm")).to_have_count(2)


@pytest.mark.acceptance
def test_a_list_that_may_not_be_complete_says_so(site: Site) -> None:
    site.tick(T0)
    page = site.open()
    expect(page.locator("#alarm-none")).to_be_visible()
    site.service.waits = (2, "database: it is locked")
    told = page.locator("#alarm-unstored")
    words = "Alarms may be missing here, 2 changes wait. database: it is locked"
    expect(told).to_have_text(words)
    expect(page.locator("#alarm-none")).to_be_hidden()
    site.service.waits = (0, None)
    expect(told).to_be_hidden()
    expect(page.locator("#alarm-none")).to_be_visible()


def test_filters(site: Site, village: type) -> None:
    town = village("town", 4)
    site.service.villages["town"] = town
    site.service.books["town"] = type(site.service.books["village"])("town")
    site.tick(T0, 4, lies={"H3": 9.0}, silent=("H5",))
    for k in range(4):
        site.service.tick(town.report(T0 + k, lies={"H1": 5.0}))
    page = site.open()
    expect(page.locator(".alarm")).to_have_count(3)
    page.select_option("#alarm-kind", "data-loss")
    expect(page.locator(".alarm")).to_have_count(1)
    page.select_option("#alarm-kind", "")
    page.select_option("#alarm-scope", "this")
    expect(page.locator(".alarm")).to_have_count(2)
    page.select_option("#feeder", "town")
    expect(page.locator(".alarm")).to_have_count(1)
    page.select_option("#alarm-scope", "")
    page.locator(".alarm a", has_text="H5 · village").click()
    expect(page.locator("#detail-title")).to_have_text("H5")
    expect(page.locator("#feeder")).to_have_value("village")


def test_older_alarms_come_page_by_page(site: Site) -> None:
    for k in range(12):
        site.tick(T0 + 10_000 * k, 4, lies={f"H{i}": 8.0 for i in range(6)})
        site.tick(T0 + 10_000 * k + 4, 8)
    page = site.open()
    page.select_option("#alarm-state", "all")
    expect(page.locator(".alarm")).to_have_count(50)
    page.locator("#alarm-more").click()
    expect(page.locator(".alarm")).to_have_count(72)
    expect(page.locator("#alarm-more")).to_be_hidden()


# ------------------------------------------------------------ can it be believed?


def test_the_badge_counts_what_is_not_loaded_too(site: Site) -> None:
    """One alarm that nobody has answered is older than a page of others that have come and gone."""
    site.service.store.commit([raised(an_alarm())])
    gone = [an_alarm(k, state=AlarmState.CLEARED, t_cleared=T0 + k + 1) for k in range(1, 61)]
    site.service.store.commit([AlarmTransition(alarm, Change.CLEARED, T0) for alarm in gone])
    page = site.open()
    badge = page.locator("#alarm-count")
    expect(badge).to_have_text("1 new")
    page.select_option("#alarm-state", "all")
    expect(page.locator(".alarm")).to_have_count(50)
    expect(badge).to_have_text("1 new")
    page.select_option("#alarm-kind", "data-loss")
    expect(page.locator(".alarm")).to_have_count(0)
    site.tick(T0 + 100, 4, lies={"H3": 9.0})
    expect(badge).to_have_text("2 new")
    expect(page.locator(".alarm")).to_have_count(0)
    page.select_option("#alarm-kind", "")
    page.select_option("#alarm-state", "raised")
    expect(page.locator(".alarm")).to_have_count(2)
    site.tick(T0 + 104, 8)
    expect(page.locator(".alarm")).to_have_count(1)
    expect(badge).to_have_text("1 new")


def test_a_lost_connection_is_said_and_healed(site: Site) -> None:
    site.tick(T0, 4, lies={"H3": 9.0})
    page = site.open()
    expect(page.locator("#link")).to_have_text("live")
    expect(page.locator(".alarm")).to_have_count(1)
    site.expected = "net::ERR_"
    site.server.stop()
    expect(page.locator("#link")).to_contain_text("connection lost")
    expect(page.locator("#decision")).to_have_text("NO LIVE DATA")
    expect(page.locator("#reason")).to_contain_text("attacked")
    expect(page.locator("#main")).to_have_attribute("data-fresh", "no")
    for old in (".diagram", ".table", ".facts", ".alarm-list"):
        expect(page.locator(old)).to_have_css("filter", "grayscale(1)")
    site.tick(T0 + 4, 8)
    site.server = site.serve(site.service, site.server.port)
    expect(page.locator("#link")).to_have_text("live")
    expect(page.locator("#decision")).to_have_text("CLEAN")
    expect(page.locator(".alarm")).to_have_count(0)


def test_meters_that_changed_places_accuse_their_new_customers_on_an_open_page(site: Site) -> None:
    site.tick(T0, lies={"H3": 9.0})
    page = site.open()
    suspect = page.locator('#diagram .customer[data-status="suspect"]')
    expect(suspect).to_have_attribute("aria-label", re.compile("^H3: suspect"))
    meters = [c["meter"] for c in site.village.customers]
    meters[3], meters[9] = meters[9], meters[3]
    pairs = zip(site.village.customers, meters, strict=True)
    site.village.customers = [{**c, "meter": meter} for c, meter in pairs]
    site.tick(T0 + 1, lies={"H3": 9.0})
    expect(suspect).to_have_attribute("aria-label", re.compile("^H3 · H9: suspect"))
    expect(suspect).to_have_count(1)
    expect(page.locator("#link")).to_have_text("live")


def test_a_state_that_is_old_when_it_comes_is_not_live(site: Site) -> None:
    """It counts from its tick by the service's clock, and does not grow younger when it comes again."""
    site.tick(T0)
    site.service.delay_s = 2400.0
    page = site.open()
    expect(page.locator("#link")).to_have_text(re.compile("data stale, 40 min old"))
    expect(page.locator("#decision")).to_have_text("NO LIVE DATA")
    site.expected = "net::ERR_"
    site.server.stop()
    expect(page.locator("#link")).to_contain_text("connection lost, data 40 min old")
    site.server = site.serve(site.service, site.server.port)
    expect(page.locator("#link")).to_contain_text("data stale")
    expect(page.locator("#decision")).to_have_text("NO LIVE DATA")
    site.service.delay_s = 0.0
    site.tick(T0 + 1)
    expect(page.locator("#link")).to_have_text("live")
    expect(page.locator("#decision")).to_have_text("CLEAN")


@pytest.mark.acceptance
def test_alarms_that_come_no_more_look_old_while_states_go_on(site: Site) -> None:
    site.tick(T0, 4, lies={"H3": 9.0})
    site.expected = "net::ERR_"
    page = site.open()
    expect(page.locator("#link")).to_have_text("live")
    page.route(ALARMS, lambda route: route.abort())
    page.select_option("#alarm-kind", "meter-manipulated")
    for k in range(3):
        site.tick(T0 + 4 + k, lies={"H3": 9.0})
        expect(page.locator("#link")).to_have_text("connection lost for alarms")
    expect(page.locator("#decision")).to_have_text("ATTACKED")
    expect(page.locator(".alarm-list")).to_have_css("filter", "grayscale(1)")
    expect(page.locator(".table")).to_have_css("filter", "none")
    page.unroute(ALARMS)
    expect(page.locator("#link")).to_have_text("live")
    expect(page.locator(".alarm-list")).to_have_css("filter", "none")


def test_old_data_is_not_shown_as_an_answer(site: Site) -> None:
    site.tick(T0)
    context = site.browser.new_context()
    page = context.new_page()
    page.clock.install()
    page.goto(site.server.url)
    expect(page.locator("#decision")).to_have_text("CLEAN")
    page.clock.fast_forward(int(1_100 * site.village.detail()["patience_s"]))
    expect(page.locator("#link")).to_contain_text("data stale")
    expect(page.locator("#decision")).to_have_text("NO LIVE DATA")
    expect(page.locator("#verdict")).to_have_attribute("data-verdict", "none")
    site.tick(T0 + 1)
    expect(page.locator("#decision")).to_have_text("CLEAN")
    expect(page.locator("#link")).to_have_text("live")
    context.close()
