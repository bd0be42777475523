"""A report of small feeders, made once."""

from __future__ import annotations

from dataclasses import replace

import pytest

from feeders.model.site import Site, from_tables, load
from feeders.report.build import Report, report
from feeders.report.html import StudyOutcome
from feeders.simulation.attacks import AttackKind
from feeders.studies.campaign.plan import AttackClass, CampaignPlan, Place
from feeders.studies.campaign.study import Campaign, campaign
from feeders.studies.detectable import detectable
from feeders.studies.droop.study import DroopOptions, DroopStudy, droop
from feeders.studies.protect import Goal, protect
from feeders.studies.redundancy import redundancy
from tests.feeders.report.about import ABOUT, HOSTILE


@pytest.fixture(scope="session")
def site() -> Site:
    return load("cigre-lv")


@pytest.fixture(scope="session")
def played(site: Site) -> Campaign:
    plan = CampaignPlan(
        scenes=1,
        together=8,
        kinds=(
            AttackClass("bias", AttackKind.BIAS, (1.0, 5.0)),
            AttackClass("replay", AttackKind.REPLAY, (20.0,)),
        ),
        liars=(1, 2),
        places=(Place.RANDOM,),
        duration_s=60.0,
        onset_s=(20.0, 25.0),
        lying_s=25.0,
    )
    return campaign(site, plan, seed=3)


@pytest.fixture(scope="session")
def studied(site: Site) -> DroopStudy:
    return droop(site, DroopOptions(presets=("ieee1547-b",), tau_factors=(1.0,)))


@pytest.fixture(scope="session")
def outcomes(site: Site, played: Campaign, studied: DroopStudy) -> list[StudyOutcome]:
    """All that there is, and a study that failed."""
    return [
        StudyOutcome(
            "detectable", detectable(site, max_attacked=2), command="gridsec study detectable cigre-lv"
        ),
        StudyOutcome("protect", protect(site, max_attacked=2, goal=Goal.BOUND, lie_volt=4.6)),
        StudyOutcome("campaign", played, seconds=1.0, resumed=True),
        StudyOutcome("redundancy", redundancy(site, silent=["m02"])),
        StudyOutcome("droop", studied),
        StudyOutcome("calibrate", None, problem="calibrate of cigre-lv: too few readings <b>here</b>"),
    ]


@pytest.fixture(scope="session")
def made(site: Site, outcomes: list[StudyOutcome]) -> Report:
    return report(site, outcomes, ABOUT)


@pytest.fixture(scope="session")
def hostile(site: Site) -> Site:
    """The same feeder with names that try to become markup."""
    tables = site.tables
    customers = tuple(replace(row, customer=f"{row.customer}{HOSTILE}") for row in tables.customers)
    meta = replace(tables.meta, title=HOSTILE)
    return from_tables(replace(tables, customers=customers, meta=meta))
