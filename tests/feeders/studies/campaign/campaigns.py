"""A small campaign."""

from __future__ import annotations

from feeders.model.site import load
from feeders.simulation.attacks import Trick
from feeders.studies.campaign.plan import Kind, Place, Plan

SITE = load("cigre-lv")

PLAN = Plan(
    scenes=3,
    together=4,
    seed=3,
    duration_s=24.0,
    onset_s=(8.0, 11.0),
    lying_s=9.0,
    settling_s=3.0,
    kinds=(
        Kind("bias", Trick.BIAS, (3.0,)),
        Kind("replay", Trick.REPLAY, (6.0,)),
        Kind("late", Trick.CLOCK_SHIFT, (20.0,)),
        Kind("coordinated-power", Trick.COORDINATED_POWER, (2.0,)),
        Kind("inverter", Trick.INVERTER, (100.0,)),
    ),
    liars=(1,),
    places=(Place.RANDOM, Place.STREET),
    alarms_per_year=(1.0, 1e5),
)
