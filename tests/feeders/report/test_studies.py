"""Sections of fleets and of calibrations, the undecided and the bad included."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from feeders.model.site import Site, from_tables
from feeders.report import section_calibrate
from feeders.report.drawing import NARROW, WIDE
from feeders.report.html import StudyOutcome
from feeders.report.section_campaign import campaign as attacks
from feeders.report.section_droop import droop as fleet
from feeders.report.section_meters import detectable as sizes
from feeders.report.section_meters import protect as protection
from feeders.report.section_meters import redundancy as invisible
from feeders.report.text import Question, Section, Standing, said
from feeders.studies.calibrate.study import AS_FILED, EXCLUDED, PROPOSED, UNTOLD, Calibrate
from feeders.studies.campaign.study import Campaign
from feeders.studies.detectable import Detectable
from feeders.studies.droop.limits import BandGuarantee
from feeders.studies.droop.study import DroopStudy
from feeders.studies.droop.verdict import FleetVerdict
from feeders.studies.protect import Goal, Protect, protect
from feeders.studies.redundancy import Redundancy
from tests.feeders import stations


def told(section: Section, question: Question) -> str:
    return " ".join(said(sentence) for sentence in section.answers[question].sentences)


def result(outcomes: list[StudyOutcome], name: str) -> object:
    return next(each.result for each in outcomes if each.study == name)


def test_a_stable_fleet(site: Site, studied: DroopStudy) -> None:
    section = fleet(site, studied)
    finding = section.answers[Question.FLEET]
    if studied.verdict is FleetVerdict.STABLE and studied.always is BandGuarantee.KEPT:
        assert finding.standing is Standing.PROVED
    assert told(section, Question.FLEET).startswith({"stable": "Stable: proved"}[str(studied.verdict)])
    for figure in section.figures:
        assert figure.draw(WIDE).marks
        assert figure.draw(NARROW).width == NARROW


@pytest.mark.parametrize("verdict", list(FleetVerdict))
@pytest.mark.parametrize("always", list(BandGuarantee))
@pytest.mark.parametrize("rest", list(BandGuarantee))
def test_what_is_said_of_a_fleet_is_what_is_known(
    site: Site, studied: DroopStudy, verdict: FleetVerdict, rest: BandGuarantee, always: BandGuarantee
) -> None:
    stability = studied.tables["stability"].assign(verdict=str(verdict), margin=math.nan)
    band = studied.tables["band"].assign(rest=str(rest), always=str(always))
    tables = {**studied.tables, "stability": stability, "band": band}
    section = fleet(site, replace(studied, verdict=verdict, rest=rest, always=always, tables=tables))
    text, finding = told(section, Question.FLEET), section.answers[Question.FLEET]
    assert ("Stable: proved" in text) == (verdict is FleetVerdict.STABLE)
    assert ("It may oscillate" in text) == (verdict is FleetVerdict.UNDECIDED)
    assert ("kept for arbitrary changes of loads" in text) == (always is BandGuarantee.KEPT)
    if FleetVerdict.UNDECIDED in (verdict, rest, always):
        assert finding.standing in {Standing.PART, Standing.OPEN}


def calibration(site: Site, *, sure: bool) -> Calibrate:
    p, customers = len(site.meter_ids), list(site.feeder.customers)
    verdict = PROPOSED if sure else UNTOLD
    std = np.where(np.arange(p) == 0, math.nan, 0.05)
    meters = pd.DataFrame({"meter": site.meter_ids, "bias_percent": 0.3, "std_percent": std})
    meters = meters.assign(low_percent=0.2, high_percent=0.4, verdict=[UNTOLD, *["biased"] * (p - 1)])
    proposals = pd.DataFrame({"what": [customers[0]], "proposed": ["Bus R1"], "verdict": [verdict]})
    places = [verdict, UNTOLD, *["as in the files"] * (len(customers) - 2)]
    lines = pd.DataFrame({"lines": ["one", "two"], "verdict": [UNTOLD, "as in the files"]})
    nothing = pd.DataFrame()
    return Calibrate(
        feeder=site.feeder.name,
        digest=site.digest,
        frames=100,
        span_h=24.0,
        risk=0.05,
        meters=meters,
        lines=lines,
        customers=pd.DataFrame({"customer": customers, "verdict": places}),
        loads=nothing,
        errors=nothing,
        proposals=proposals,
        corrections=(),
    )


@pytest.mark.parametrize("sure", [True, False])
def test_what_cannot_be_told_is_neither_right_nor_wrong(site: Site, *, sure: bool) -> None:
    section = section_calibrate.calibrate(site, calibration(site, sure=sure))
    text = told(section, Question.RECORDS)
    assert ("1 correction of the files is proposed" in text) == sure
    assert ("No correction of the files is decided" in text) == (not sure)
    assert "1 of 2 lines" in text
    assert f"{1 if sure else 2} of {site.feeder.bus.size} customers" in text
    assert "These may be right or wrong" in text
    assert all(figure.draw(NARROW).marks for figure in section.figures)


def test_words_of_the_calibration_are_its_own() -> None:
    words = (
        section_calibrate.UNTOLD,
        section_calibrate.PROPOSED,
        section_calibrate.EXCLUDED,
        section_calibrate.AS_FILED,
    )
    assert words == (UNTOLD, PROPOSED, EXCLUDED, AS_FILED)


def test_sizes_that_are_not_proved_are_said_to_be_none(site: Site, outcomes: list[StudyOutcome]) -> None:
    found = result(outcomes, "detectable")
    assert isinstance(found, Detectable)
    meters, customers = found.meters.copy(), found.customers.copy()
    meters.loc[1, ["noticed", "named"]] = math.inf
    customers.loc[0, "error"] = math.nan
    section = sizes(site, replace(found, meters=meters, customers=customers))
    assert section.answers[Question.LIES].standing is Standing.PART
    assert f"For {meters['meter'][1]} no size is proved" in told(section, Question.LIES)
    assert section.answers[Question.PICTURE].standing is Standing.OPEN
    for figure in section.figures:
        assert figure.draw(WIDE).marks


def test_sizes_on_two_levels_are_drawn_in_parts_of_the_nominal_voltage() -> None:
    """In volts whoever is on the higher level would always be the worst."""
    two = from_tables(stations.tables())
    names, street = list(two.feeder.customers), two.customer_nominal == stations.LV
    percent = np.where(street, 2.0, 1.0)
    percent[names.index("a2-west")] = 3.0
    volt = percent / 100.0 * two.customer_nominal
    meters = pd.DataFrame({"meter": names, "customer": names, "bus": names})
    meters = meters.assign(hidden=0.1 * volt, noticed=volt, named=2.0 * volt)
    meters = meters.assign(undetected=0.2 * volt, found=0.4 * volt)
    customers = pd.DataFrame({"customer": names, "bus": names, "error": volt, "error_fits": volt})
    section = sizes(two, Detectable("two", "", 1, 1e-3, meters, customers))
    by_name = {figure.name: figure for figure in section.figures}
    for key in ("detectable-map", "detectable-picture"):
        assert "% of nominal" in by_name[key].text
        assert "Largest at a2-west." in by_name[key].text
    drawn = str(by_name["detectable-sizes"].draw(WIDE).marks)
    assert drawn.index("a2-west") < drawn.index("sawmill")
    assert "6 %" in drawn


def test_limits_on_two_levels_share_an_axis(studied: DroopStudy) -> None:
    """Proved limits of 20 kV and of 400 V are compared as parts of what is nominal."""
    two = from_tables(stations.tables())
    nominal = pd.Series(two.customer_nominal)
    customers = pd.DataFrame({"customer": list(two.feeder.customers)})
    for name, share in (("low", 0.955), ("low_rest", 0.97), ("high_rest", 1.01), ("high", 1.025)):
        customers[f"{name}_volt"] = share * nominal
    runs = pd.DataFrame({"step": "load", "t_s": [0.0, 1.0], "customer": "dairy", "v_volt": stations.MV})
    tables = {**studied.tables, "customers": customers, "trajectories": runs}
    tables["steps"] = studied.tables["steps"].assign(worst_customer="dairy")
    section = fleet(two, replace(studied, tables=tables))
    drawn = {figure.name: str(figure.draw(WIDE).marks) for figure in section.figures}
    assert drawn["droop-band"].count("95.5 to 102.5 %") == len(customers)
    assert "voltage, % of nominal" in drawn["droop-steps"]
    assert "11547.0 V and 230.9 V" in told(section, Question.FLEET)


def test_a_broken_band_is_told_with_a_voltage(site: Site, studied: DroopStudy) -> None:
    witness = pd.DataFrame(
        {
            "when": "at rest",
            "customer": site.feeder.customers[:3],
            "v_volt": site.customer_nominal[:3] * [0.7, 1.15, 0.86],
            "beyond": [False, True, True],
        }
    )
    band = studied.tables["band"].assign(rest="violated", always="violated")
    tables = {**studied.tables, "band": band, "witness": witness}
    finding = fleet(
        site, replace(studied, rest=BandGuarantee.VIOLATED, always=BandGuarantee.VIOLATED, tables=tables)
    ).answers
    sentence = finding[Question.FLEET].sentences[1]
    volt = next(part for part in sentence if not isinstance(part, str))
    assert volt.source == "droop-witness:v_volt:row 1"
    assert volt.value == witness["v_volt"][1]
    assert f"at {site.feeder.customers[1]}, by AC power flow" in said(sentence)


def test_a_search_that_gave_up_is_not_an_all_clear(site: Site, outcomes: list[StudyOutcome]) -> None:
    found = result(outcomes, "redundancy")
    assert isinstance(found, Redundancy)
    summary, meters = found.summary.copy(), found.meters.copy()
    summary.loc[0, "index"] = math.nan
    meters.loc[0, "index_any"] = math.nan
    section = invisible(site, replace(found, summary=summary, meters=meters))
    assert section.answers[Question.INVISIBLE].standing is Standing.OPEN
    assert "are not proved: the search was stopped" in told(section, Question.INVISIBLE)
    drawing = section.figures[0].draw(WIDE)
    assert any(getattr(mark, "text", "") == "not known" for mark in drawing.marks)


def test_what_is_not_proved_of_sizes_is_not_called_proved(site: Site, outcomes: list[StudyOutcome]) -> None:
    """That the search names who lies is simulated only, and what is proved has a probability, and a share."""
    found = result(outcomes, "detectable")
    assert isinstance(found, Detectable)
    section = sizes(site, found)
    for question in (Question.LIES, Question.PICTURE):
        assert section.answers[question].standing is Standing.PART
    assert "99.9 % at any one moment" in told(section, Question.LIES)
    assert "checked by simulation" in told(section, Question.LIES)
    assert "with 99.8 % for each customer" in told(section, Question.PICTURE)
    assumed = " ".join(section.assumptions)
    assert "hold with 99.9 %" in assumed
    assert "every load draws 50 % of its peak" in assumed
    assert "is not proved" in assumed


def test_protection_against_false_powers_is_told(site: Site) -> None:
    found = protect(site, max_attacked=2)
    text = told(protection(site, found), Question.PROTECT)
    assert text.startswith("Protect 2 of 6 meters: m03 and m06.")
    assert "with any reported powers" in text
    assert "Unprotected, one meter hides up to" in text
    assert "by itself, with true powers" in text


def test_nobody_among_none_left_invisible_is_told_as_such(site: Site, outcomes: list[StudyOutcome]) -> None:
    found = result(outcomes, "protect")
    assert isinstance(found, Protect)
    goal = {"goal": Goal.IDENTIFY, "before": 1.0, "after": math.inf, "alone": math.nan}
    text = told(protection(site, replace(found, **goal)), Question.PROTECT)
    assert (
        "Fewest manipulated meters that stay invisible: 1 without protection, none with it, for any number"
        in text
    )


def test_who_lies_alone_has_nobody_with_it(site: Site, outcomes: list[StudyOutcome]) -> None:
    found = result(outcomes, "detectable")
    assert isinstance(found, Detectable)
    for liars, words in (
        (1, "Each meter manipulated alone."),
        (3, "Each meter manipulated together with at most 2 more."),
    ):
        assert sizes(site, replace(found, max_attacked=liars)).figures[0].text.startswith(words)


def test_protection_with_a_gap_is_not_called_the_fewest(site: Site, outcomes: list[StudyOutcome]) -> None:
    found = result(outcomes, "protect")
    assert isinstance(found, Protect)
    assert len(found.meters)
    section = protection(site, replace(found, least=len(found.meters) - 1))
    assert section.answers[Question.PROTECT].standing is Standing.PART
    assert "is not proved" in told(section, Question.PROTECT)
    none = replace(
        found, meters=found.meters.head(0), goal=Goal.NOTICE, before=math.inf, after=math.inf, least=0
    )
    section = protection(site, none)
    assert section.answers[Question.PROTECT].standing is Standing.OPEN
    assert told(section, Question.PROTECT).startswith("No answer by this criterion, and no safety")
    assert "None needs protection" not in section.figures[0].text


def test_attacks_that_could_not_be_played_are_told(site: Site, played: Campaign) -> None:
    scenarios = played.scenarios.copy()
    scenarios.loc[1, "reason"] = "no such place"
    text = told(attacks(site, replace(played, scenarios=scenarios)), Question.MONITOR)
    assert "1 scenario could not be simulated: no result" in text
    missed = int(np.isinf(played.liars["delay_s"]).sum())
    assert missed
    assert re.search(rf"\b{missed} (was|were) missed\b", text)


def test_a_campaign_without_liars_tells_nothing_about_attacks(site: Site, played: Campaign) -> None:
    section = attacks(site, replace(played, liars=played.liars.head(0)))
    assert section.answers[Question.MONITOR].standing is Standing.OPEN
    assert "No scenario has an attack: no result on attacks" in told(section, Question.MONITOR)


@pytest.mark.parametrize(("verdict", "words"), [("undecided", "not proved"), ("unstable", "unstable there")])
def test_hosted_generation_is_not_called_stable_where_that_is_not_proved(
    site: Site, studied: DroopStudy, verdict: str, words: str
) -> None:
    row = {"preset": "ieee1547-b", "capacity_kw": 100.0, "limit": "voltage high"}
    for known, there in ((verdict, True), ("stable", False)):
        hosting = pd.DataFrame([row | {"verdict": known}])
        tables = {**studied.tables, "hosting": hosting}
        text = told(fleet(site, replace(studied, tables=tables)), Question.FLEET)
        hosted = text[text.index("Hosting capacity, with generation") :]
        assert (words in hosted) == there


def test_a_meter_that_seems_to_lie_is_said(site: Site) -> None:
    found = calibration(site, sure=False)
    meter = str(site.meter_ids[0])
    row = {"what": [meter], "proposed": ["another error"], "verdict": [EXCLUDED]}
    customers = found.customers.assign(verdict=[EXCLUDED, *["as in the files"] * (len(found.customers) - 1)])
    section = section_calibrate.calibrate(
        site, replace(found, proposals=pd.DataFrame(row), customers=customers)
    )
    text = told(section, Question.RECORDS)
    assert f"1 meter is inconsistent, and errors of the files explain it less well: {meter}" in text
    drawing = section.figures[0].draw(WIDE)
    assert any(getattr(mark, "text", "") == "cannot be told" for mark in drawing.marks)
