"""Conclusions in one sentence with the numbers of their tables, and meanings of all columns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from feeders.model.site import Site
from feeders.report.conclusions import conclusion
from feeders.report.html import StudyOutcome
from feeders.report.text import Value, legend, said
from feeders.studies.comparison import HEADERS
from feeders.studies.detectable import Detectable
from feeders.studies.droop.limits import BandGuarantee
from feeders.studies.droop.study import DroopStudy
from feeders.studies.droop.verdict import FleetVerdict
from feeders.studies.redundancy import Redundancy
from tests.feeders.report.test_build import looked_up


def test_every_number_is_that_of_its_table(site: Site, outcomes: list[StudyOutcome]) -> None:
    for outcome in outcomes:
        if outcome.result is None:
            continue
        tables = {f"{outcome.study}-{name}": table for name, table in outcome.result.tables.items()}
        parts = [p for p in conclusion(site, outcome.study, outcome.result) if isinstance(p, Value)]
        assert parts
        for part in parts:
            assert looked_up(tables, part.source) == part.value, part.source


def test_every_column_has_a_meaning_and_every_infinity_too(outcomes: list[StudyOutcome]) -> None:
    for outcome in outcomes:
        for name, table in (outcome.result.tables if outcome.result else {}).items():
            meanings = legend(outcome.study, table.columns)
            assert list(meanings) == list(table.columns), (outcome.study, name)
            infinite = table.select_dtypes("number").apply(lambda column: np.isinf(column).any())
            for column in infinite[infinite].index:
                assert "∞:" in meanings[column], (outcome.study, name, column)
    assert list(legend("compare", HEADERS)) == list(HEADERS)


def of(outcomes: list[StudyOutcome], study: str) -> object:
    """Result of a study."""
    return next(outcome.result for outcome in outcomes if outcome.study == study)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_proved_is_undecided(site: Site, outcomes: list[StudyOutcome], value: float) -> None:
    sizes = of(outcomes, "detectable")
    assert isinstance(sizes, Detectable)
    meters = sizes.meters.assign(noticed=[value, *sizes.meters["noticed"][1:]])
    told = said(conclusion(site, "detectable", replace(sizes, meters=meters)))
    assert "noticed from UNDECIDED at 1 of 6 meters (no size is proved) on" in told
    assert "(partly proved)" in told


def test_a_stopped_search_and_an_undecided_fleet(
    site: Site, outcomes: list[StudyOutcome], studied: DroopStudy
) -> None:
    found = of(outcomes, "redundancy")
    assert isinstance(found, Redundancy)
    stopped = replace(found, summary=found.summary.assign(index=np.nan))
    told = said(conclusion(site, "redundancy", stopped))
    assert "(not proved)" in told
    assert told.count("UNDECIDED") == len(found.summary)
    fleet = replace(
        studied,
        verdict=FleetVerdict.UNDECIDED,
        rest=BandGuarantee.UNDECIDED,
        always=BandGuarantee.UNDECIDED,
        tables={
            **studied.tables,
            "stability": studied.tables["stability"].assign(verdict="undecided"),
            "band": studied.tables["band"].assign(
                rest="undecided", always="undecided", low_rest_volt=-np.inf
            ),
        },
    )
    told = said(conclusion(site, "droop", fleet))
    assert "(not proved): the fleet is UNDECIDED; the voltage band is UNDECIDED for slow" in told
    assert "no voltage limits are proved" in told
    assert "inf" not in told
