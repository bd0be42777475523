"""Scenarios as JSON: what stands in the metadata of recordings."""

from __future__ import annotations

import math
from dataclasses import asdict, fields
from typing import Any, Final

import numpy as np

from feeders.meters import Channel, MeterErrors, Silence
from feeders.plain import plain
from feeders.scenario import Scenario, Season
from feeders.variation import Variation
from gridsec import attack as attacks

__all__ = ["scenario_from_json", "scenario_to_json"]

_LISTS = ("attacks", "busbar_attacks")


def scenario_to_json(scenario: Scenario) -> dict[str, Any]:
    """Turn a scenario into what JSON can hold; infinite times become the text "inf"."""
    told = {field.name: getattr(scenario, field.name) for field in fields(scenario)}
    told["variation"] = asdict(scenario.variation)
    told["errors"] = asdict(scenario.errors)
    told["channel"] = asdict(scenario.channel)
    for name in _LISTS:
        told[name] = [
            {"kind": type(attack).__name__}
            | {field.name: getattr(attack, field.name) for field in fields(attack)}
            for attack in getattr(scenario, name)
        ]
    told["inverter_attacks"] = [
        {field.name: getattr(attack, field.name) for field in fields(attack)}
        for attack in scenario.inverter_attacks
    ]
    out: dict[str, Any] = _told(plain(told))
    return out


def scenario_from_json(obj: dict[str, Any]) -> Scenario:
    """Turn it back; `scenario_to_json` has made it.

    Raises
    ------
    KeyError, TypeError, ValueError
        When it is something else.
    """
    given = {"busbar_attacks": ()} | _heard(obj)
    channel = dict(given["channel"])
    channel["silences"] = tuple(
        Silence(s["meter"], float(s["t_on"]), float(s["t_off"])) for s in channel["silences"]
    )
    given["channel"] = Channel(**channel)
    given["variation"] = Variation(**given["variation"])
    given["errors"] = MeterErrors(**given["errors"])
    for name in _LISTS:
        given[name] = tuple(_attack(entry) for entry in given[name])
    given["inverter_attacks"] = tuple(
        attacks.InverterAttack(
            np.array(entry["inverters"], dtype=np.intp),
            np.array(entry["q"], dtype=np.float64),
            float(entry["t_on"]),
            float(entry["t_off"]),
        )
        for entry in given.get("inverter_attacks", ())
    )
    given["duration_s"] = float(given["duration_s"])
    given["season"] = Season(given.get("season", Season.SUMMER))
    return Scenario(**given)


_ATTACKS: Final = {
    kind.__name__: kind
    for kind in (
        attacks.Bias,
        attacks.Scaling,
        attacks.Drift,
        attacks.Stuck,
        attacks.Replay,
        attacks.Random,
        attacks.Coordinated,
    )
}


def _attack(entry: dict[str, Any]) -> attacks.Attack:
    values = dict(entry)
    kind: Any = _ATTACKS[values.pop("kind")]
    for name, value in values.items():
        if isinstance(value, list):
            values[name] = np.array(value, dtype=np.intp if name == "meters" else np.float64)
    made: attacks.Attack = kind(**values)
    return made


_INFINITE: Final = ("inf", "-inf")


def _told(value: Any) -> Any:
    """Infinities to text, all the way down."""
    if isinstance(value, dict):
        return {name: _told(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_told(item) for item in value]
    return str(value) if isinstance(value, float) and math.isinf(value) else value


def _heard(value: Any, name: str = "") -> Any:
    """The reverse; a meter may have any name."""
    if isinstance(value, dict):
        return {key: _heard(item, key) for key, item in value.items()}
    if isinstance(value, list):
        return [_heard(item) for item in value]
    return float(value) if isinstance(value, str) and value in _INFINITE and name != "meter" else value
