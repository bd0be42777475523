"""What a campaign plays: what options say, and for the rest what the feeder's files say."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from gridsec.errors import refuse

if TYPE_CHECKING:
    from feeders.load import Site
    from feeders.studies.campaign_plan import Plan

__all__ = ["planned", "sources"]

SHORTEST: Final = 10
"""A scenario has at least so many readings: lies begin after a tenth of it."""

FILES: Final = "feeder's files"


def planned(
    site: Site,
    *,
    step: float | None,
    duration: float | None = None,
    load_error_kw: float | None,
    load_error_kvar: float | None,
    **chosen: Any,
) -> Plan:
    """The plan of a campaign; all that is wrong with it is told at once.

    Parameters
    ----------
    site
        The feeder.
    step, duration, load_error_kw, load_error_kvar
        As on the command line; None: as the files say. With one of the load errors the other is none.
    chosen
        Attributes of the plan by name; None: as the files say.

    Raises
    ------
    ValueError
        If a scenario is too short for readings so far apart, there is no such setting, or as `Plan`.
    """
    from feeders.studies.campaign_plan import Plan, wrong_settings
    from feeders.trials import LoadError

    problems: list[str] = [*wrong_settings(site, chosen.get("settings") or ())]
    step_s = step or site.tables.meta.monitor.tick_s
    if duration is not None and duration < SHORTEST * step_s:
        problems.append(
            f"--duration: {duration:g} s are too few where readings come every {step_s:g} s "
            f"({_from(step, '--step')}): at least {SHORTEST * step_s:g} s, or more frequent readings with "
            "--step"
        )
        duration = None
    chosen |= {"step_s": step, "duration_s": duration}
    if load_error_kw is not None or load_error_kvar is not None:
        chosen["load_error"] = LoadError(load_error_kw or 0.0, load_error_kvar or 0.0)
    try:
        plan = Plan.of(site, **{name: value for name, value in chosen.items() if value is not None})
    except ValueError as error:
        refuse([*problems, str(error)])
        raise
    refuse(problems)
    return plan


def sources(site: Site, plan: Plan, given: Mapping[str, object]) -> str:
    """What is played, and which of it is from the files and which from options.

    Parameters
    ----------
    site, plan
        The feeder, and the campaign.
    given
        Options such as --step, and None where they were not given.
    """
    from feeders.doubts import load_doubt

    some = {option for option, value in given.items() if value is not None}
    asked = "--step", "--estimator", "--alarms-per-year"
    step, estimator, rate = (option if option in some else FILES for option in asked)
    rates = ", ".join(f"{each:g}" for each in plan.alarms_per_year)
    loads = [option for option in ("--load-error-kw", "--load-error-kvar") if option in some]
    doubt, base = load_doubt(plan.trial(site, plan.moment(0)).stated), site.feeder.base_kva
    kw, kvar = (float(np.median(each[site.meters])) * base for each in (doubt.p, doubt.q))
    return (
        f"{site.feeder.name}: {plan.scenarios} scenarios of {plan.duration_s / plan.step_s:.0f} readings, "
        f"one every {plan.step_s:g} s ({step}), watched by {plan.estimator} "
        f"({estimator}); allowed false alarms a year: {rates} ({rate}); powers of "
        f"metered customers within {kw:.2g} kW and {kvar:.2g} kvar, medians of 1 sigma "
        f"({', '.join(loads) or FILES})"
    )


def _from(value: float | None, option: str) -> str:
    return FILES if value is None else option
