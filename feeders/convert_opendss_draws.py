"""What takes power from an OpenDSS circuit or feeds it: customers, and what is said about each.

All of it stands at the operating point that OpenDSS found; what moves with the voltage or over
time is named.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from feeders.convert_changes import Change
from feeders.convert_draws import Draw, as_it_stands, is_even
from feeders.convert_network import Network
from gridsec.arrays import Phasors

PHASES: Final = 3
SAME_POWER: Final = 1e-6
"""Relative difference of two powers below which they are the same."""

LOADS: Final = {"load", "indmach012"}
GENERATORS: Final = {"generator", "pvsystem"}
STORAGE: Final = {"storage"}

PROFILE: Final = "a profile of the library instead"
STANDS: Final = "its power stands as the source's power flow has it"
RATED: Final = "the peak is the rated one, and what it feeds in now as the source's power flow has it"
OVER_TIME: Final = {
    "load": {"yearly": "", "daily": "", "duty": "", "growth": STANDS, "cvrcurve": STANDS},
    "generator": {"yearly": "", "daily": "", "duty": ""},
    "pvsystem": {
        **dict.fromkeys(("yearly", "daily", "duty"), ""),
        **dict.fromkeys(("tyearly", "tdaily", "tduty", "p-tcurve", "effcurve"), RATED),
    },
    "storage": dict.fromkeys(("yearly", "daily", "duty", "effcurve"), STANDS),
    "indmach012": dict.fromkeys(("yearly", "daily", "duty"), STANDS),
}
"""Properties that name a curve, and what the feeder does instead; empty: a profile of the library."""


@dataclass(frozen=True, slots=True, eq=False)
class Element:
    """One element of the circuit as solved, terminal by terminal."""

    name: str
    kind: str
    buses: tuple[str, ...]
    nodes: tuple[tuple[int, ...], ...]
    power_kva: tuple[Phasors, ...]
    enabled: bool
    on: tuple[int, ...]

    @property
    def closed(self) -> bool:
        """Whether it is connected at all its ends."""
        return self.enabled and len(self.on) == len(self.buses)

    @property
    def label(self) -> str:
        """What it is called where it is told about."""
        return f"{self.kind} {self.name}"


def voltage_dependence(dss: Any) -> list[tuple[str, Change]]:
    """Return the loads that are not of constant power, each with its bus.

    Parameters
    ----------
    dss
        The engine, with the circuit as it was read.
    """
    effect = "depends on the voltage in the source; taken as constant power"
    changes = []
    for name in dss.Loads.AllNames():
        if name.lower() == "none":
            continue
        dss.Loads.Name(name)
        bus = str(dss.CktElement.BusNames()[0]).partition(".")[0].lower()
        if int(dss.Loads.Model()) != 1:
            change = Change(f"load {name}", f"model {int(dss.Loads.Model())}", "approximated", effect)
            changes.append((bus, change))
    return changes


def beyond_limits(found: list[Element], constant: list[Element], known: set[str]) -> list[tuple[str, Change]]:
    """Return loads and generators that become impedances at their voltages, though of constant power.

    Parameters
    ----------
    found, constant
        All elements as the source solves them, and with loads of constant power.
    known
        Those that are told about already.
    """
    out = []
    for one, other in zip(found, constant, strict=True):
        if one.kind not in {"load", "generator"} or not one.enabled:
            continue
        power = other.power_kva[0].sum()
        if one.label not in known and abs(one.power_kva[0].sum() - power) > SAME_POWER * abs(power):
            effect = "beyond them it depends on the voltage in the source; taken as constant power"
            out.append((one.buses[0], Change(one.label, "vminpu, vmaxpu", "approximated", effect)))
    return out


def add_draw(dss: Any, each: Element, network: Network) -> None:
    """Add a load, a generator or a battery to a network, with everything that a customer cannot hold.

    Parameters
    ----------
    dss
        The engine.
    each
        The element.
    network
        Takes it.
    """
    power, bus = each.power_kva[0], each.buses[0]
    used = [node for node in each.nodes[0] if 1 <= node <= PHASES]
    even = len(used) == PHASES and (is_even(power) or not power.any())
    told = list(_curves(dss, each))
    if len(used) > 1 and not even:
        effect = "in star, its phases' powers as the source's power flow has them; exact at these loads only"
        told.append(Change(each.label, "delta", "approximated", effect))
    rating: float | None = None
    peak = 0.0
    if each.kind == "pvsystem":
        rating, peak = (_number(dss, each, name) for name in ("kva", "pmpp"))
        told += _sunlight(dss, each, peak)
    elif each.kind != "load":
        rating = 0.0 if each.kind in GENERATORS else None
        told.append(Change(each.label, "control", "changed", as_it_stands(power)))
    network.of_bus.extend((bus, change) for change in told)
    phases = "".join("abc"[node - 1] for node in sorted(used))
    noun = "" if each.kind in {"load", *GENERATORS} else each.kind
    draw = Draw(each.name, bus, power, even=even, rating_kva=rating, peak_kw=peak, phases=phases, noun=noun)
    network.draws.append(draw)


def _curves(dss: Any, each: Element) -> Iterator[Change]:
    """Name every curve that an element follows over time, temperature or voltage, each once."""
    told: set[str] = set()
    known = _properties(dss, each)
    for prop, effect in OVER_TIME[each.kind].items():
        value = known.get(prop, "")
        if value and value.lower() not in told:
            told.add(value.lower())
            what = f"load shape {value}" if prop in {"yearly", "daily", "duty"} else f"{prop} {value}"
            yield Change(each.label, what, "left out", effect or PROFILE)


def _sunlight(dss: Any, each: Element, peak: float) -> Iterator[Change]:
    """Say what a solar plant feeds in now, where that is not its rated peak."""
    now = 0.0 - round(float(each.power_kva[0].sum().real), 6)
    if abs(now - peak) > SAME_POWER * peak:
        sun = _number(dss, each, "irradiance")
        effect = (
            f"feeds in {now:.4g} kW at this moment, as in the check; pv_kw is its rated peak of {peak:.6g}"
        )
        yield Change(each.label, f"irradiance {sun:g}", "changed", effect)


def _properties(dss: Any, each: Element) -> dict[str, str]:
    dss.Circuit.SetActiveElement(f"{each.kind}.{each.name}")
    return {name.lower(): str(dss.Properties.Value(name)) for name in dss.Element.AllPropertyNames()}


def _number(dss: Any, each: Element, name: str) -> float:
    dss.Circuit.SetActiveElement(f"{each.kind}.{each.name}")
    return float(dss.Properties.Value(name))
