"""A small campaign."""

from __future__ import annotations

from feeders.model.site import load
from feeders.simulation.attacks import AttackKind
from feeders.studies.campaign.plan import AttackClass, CampaignPlan, Place

SITE = load("cigre-lv")

PLAN = CampaignPlan(
    scenes=3,
    together=4,
    seed=3,
    duration_s=24.0,
    onset_s=(8.0, 11.0),
    lying_s=9.0,
    settling_s=3.0,
    kinds=(
        AttackClass("bias", AttackKind.BIAS, (3.0,)),
        AttackClass("replay", AttackKind.REPLAY, (6.0,)),
        AttackClass("late", AttackKind.CLOCK_SHIFT, (20.0,)),
        AttackClass("coordinated-power", AttackKind.COORDINATED_POWER, (2.0,)),
        AttackClass("inverter", AttackKind.INVERTER, (100.0,)),
    ),
    liars=(1,),
    places=(Place.RANDOM, Place.STREET),
    alarms_per_year=(1.0, 1e5),
)
