"""The displayed verdict against the alarms, which have the same delays."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from feeders.model.site import load
from feeders.simulation.plant import Channel
from feeders.simulation.recording import read_recording, record
from feeders.simulation.scenario import Scenario
from gridsec.interface import Cause, Decision
from service.alarms.displayed import Display, advance
from service.alarms.state_machine import AlarmBook, AlarmKind, AlarmRules, conditions
from service.alarms.state_machine import advance as advance_alarms
from service.engine.replay import ReplayCounts, replay
from service.report.report import FeederReport
from tests.service.stored import T0, a_report

RULES = AlarmRules(on_delay_s=2.0, off_delay_s=5.0, silence_s=4.0)


def tick(t: float, letter: str) -> FeederReport:
    """A: attacked, C: clean, U: misfit, S: readings are missing."""
    report = a_report(t, ("m0",) if letter == "A" else ())
    if letter in "US":
        cause = Cause.MISFIT if letter == "U" else Cause.SILENT_METERS
        report = replace(report, verdict=Decision.UNDECIDED, cause=cause, reason=letter)
    return report


def letters_of(letters: str, rules: AlarmRules = RULES) -> str:
    """Displayed verdicts, by the first letter, at ticks of one second."""
    display, found = None, ""
    for k, letter in enumerate(letters):
        display = advance(display, rules, tick(T0 + k, letter))
        found += str(display.verdict)[0].upper()
    return found


def test_each_verdict_is_displayed_after_its_delay() -> None:
    assert letters_of("CCCAAAA") == "CCCCCAA"
    assert letters_of("AAACCCCCCC") == "AAAAAAAACC"
    assert letters_of("CCCUUUU") == "CCCCCUU"
    # Readings are missing: longer than the silence, not equal to it.
    assert letters_of("CSSSSSSS") == "CCCCCCUU"
    assert letters_of("UUCCCCCCCC") == "UUUUUUUCCC"
    immediate = AlarmRules(on_delay_s=0.0, off_delay_s=0.0, silence_s=0.0)
    assert letters_of("CACUCA", immediate) == "CACUCA"


def test_lost_readings_do_not_change_it() -> None:
    assert set(letters_of("CSCSSCSSSC" * 20)) == {"C"}
    assert set(letters_of("ASASSASSSA" * 20)) == {"A"}
    # An attack is displayed although every other tick has no answer: its clock stands still there.
    assert letters_of("C" + "AS" * 4) == "CCCCCAAAA"
    # CLEAN between long times without an answer is not enough.
    assert set(letters_of("U" + "CSSSSSS" * 20)) == {"U"}
    assert letters_of("U" + "CS" * 6)[-1] == "C"


def test_the_shown_reason_and_suspects_belong_to_the_shown_verdict() -> None:
    display = advance(None, RULES, tick(T0, "A"))
    for k, letter in enumerate("CSU", start=1):
        display = advance(display, RULES, tick(T0 + k, letter))
    now = display.newest
    assert (now.verdict, now.suspects, now.t) == ("attacked", ("m0",), T0)
    for k in range(4, 12):
        display = advance(display, RULES, tick(T0 + k, "C"))
    now = display.newest
    assert (now.verdict, now.suspects) == ("clean", ())
    # Its first tick came before the undecided ones.
    assert (display.since, now.t) == (T0 + 1, T0 + 11)


def test_a_waiting_attack_lasts_while_undecided_is_displayed() -> None:
    assert letters_of("CCCAAUUUAAA") == "CCCCCCCUAAA"
    display = advance(None, RULES, tick(T0, "C"))
    for k, letter in enumerate("CCAAUUU", start=1):
        display = advance(display, RULES, tick(T0 + k, letter))
    now = display.newest
    assert (display.verdict, now.verdict, now.reason) == (Decision.UNDECIDED, Decision.UNDECIDED, "U")
    assert (display.since, now.t, display.t) == (T0 + 5, T0 + 7, T0 + 7)
    assert (display.answer, display.onset) == (Decision.ATTACKED, T0 + 3)
    # CLEAN waits from its first tick on after UNDECIDED.
    assert letters_of("AAACCCCUUUCCCCCCC") == "AAAAAAAAAUUUUUUCC"


def test_skipped_ticks_and_a_clock_set_back() -> None:
    display = advance(None, RULES, tick(T0, "C"))
    display = advance(display, RULES, tick(T0 + 1, "A"))
    display = advance(display, RULES, replace(tick(T0 + 60, "A"), skipped=58))
    assert display.verdict is Decision.CLEAN
    display = advance(display, RULES, tick(T0 + 62, "A"))
    assert display.verdict is Decision.ATTACKED
    display = advance(display, RULES, tick(T0 - 50, "C"))
    assert (display.verdict, display.since) == (Decision.CLEAN, T0 - 50)


letters = st.text("ACUS", min_size=1, max_size=60)


@settings(max_examples=60)
@given(letters)
@example("CAAUUUA")
@example("AUUUAAU")
@example("ACAUUUAA")
@example("CCCAAUUUAAA")
@example("AAAUUACSSUCCCCUSSUCUUS")
def test_the_page_and_the_alarm_list_agree(sequence: str) -> None:
    """ATTACKED is displayed when the alarm of a manipulation rises, and is not displayed when it clears.

    CLEAN is displayed then, or UNDECIDED: after a time without an answer CLEAN starts again.
    """
    display: Display[FeederReport] | None = None
    book = AlarmBook("village")
    for k, letter in enumerate(sequence):
        report = tick(T0 + k, letter)
        report = replace(report, meters=tuple(replace(m, seen=True) for m in report.meters))
        display = advance(display, RULES, report)
        book, transitions = advance_alarms(book, RULES, conditions(report), report.t)
        for one in transitions:
            if one.alarm.kind is AlarmKind.METER_MANIPULATED:
                assert (display.verdict is Decision.ATTACKED) == one.alarm.active
        assert display.since <= display.newest.t <= report.t


@settings(max_examples=60)
@given(letters)
def test_no_answer_never_stays_behind_another_verdict(sequence: str) -> None:
    """A lasting verdict is displayed after its delay, and two changes are more than the shorter one apart."""
    every = sequence + sequence[-1] * 8
    found = letters_of(every)
    assert found[-1] == {"S": "U"}.get(every[-1], every[-1])
    changes = [k for k, (a, b) in enumerate(pairwise(found), start=1) if a != b]
    assert all(b - a > RULES.on_delay_s for a, b in pairwise(changes))
    for k in changes:
        assert {"S": "U"}.get(every[k], every[k]) == found[k]


@pytest.mark.acceptance
def test_lost_readings_of_a_real_feeder(tmp_path: Path) -> None:
    """With a fifth of the readings lost the raw verdict flickers, the displayed one does not."""
    site = load("simbench-lv-rural1")
    recording = record(site, Scenario(duration_s=300.0, channel=Channel(loss=0.2)), tmp_path / "day.parquet")
    found = [one.report for one in replay(site, read_recording(recording.path).readings(), ReplayCounts())]
    assert sum(a.verdict is not b.verdict for a, b in pairwise(found)) > 20
    verdicts = [one.displayed.verdict for one in found if one.displayed is not None]
    assert len(verdicts) == len(found)
    assert sum(a is not b for a, b in pairwise(verdicts)) <= 2
    assert verdicts[-1] is Decision.CLEAN
