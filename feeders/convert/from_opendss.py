"""OpenDSS master files, read and solved by OpenDSS.

All elements are at the operating point of OpenDSS; dependence on the voltage or on time is reported.

OpenDSS is one global state. The conversion has an engine of its own, which is cleared before and after. It
opens no windows, starts no programs and writes nothing outside a temporary folder.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np

from feeders.convert.customers import Draw, as_it_stands, is_even, rounded
from feeders.convert.lines import Coupling, line_row, with_taps
from feeders.convert.provenance import Changes, ConversionChange, SourceUnreadable
from feeders.convert.source import CONSTANT, IN_STAR, MEASURE, OFF, UNLIKE, SourceNetwork
from feeders.format.columns import CheckReport
from feeders.format.tables import LineRow
from feeders.util import extra
from gridsec.arrays import Floats, Phasors
from gridsec.errors import FeederInvalid, GridsecError, Problem

PHASES: Final = 3
SAME_POWER: Final = 1e-6
"""Relative difference of two powers that count as equal."""

LOADS: Final = {"load", "indmach012"}
GENERATORS: Final = {"generator", "pvsystem"}
STORAGE: Final = {"storage"}

PROFILE: Final = "a profile of the library instead"
STANDS: Final = "its power is that of the source's power flow"
RATED: Final = "the peak is the rated one, the present power that of the source's power flow"
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
"""Properties that refer to a curve, and the feeder's replacement; empty: a profile of the library."""


@dataclass(frozen=True, slots=True, eq=False)
class Element:
    """One element of the solved circuit, terminal by terminal."""

    name: str
    kind: str
    buses: tuple[str, ...]
    nodes: tuple[tuple[int, ...], ...]
    power_kva: tuple[Phasors, ...]
    enabled: bool
    on: tuple[int, ...]

    @property
    def closed(self) -> bool:
        """True if all ends are connected."""
        return self.enabled and len(self.on) == len(self.buses)

    @property
    def label(self) -> str:
        """Kind and name for messages."""
        return f"{self.kind} {self.name}"


def voltage_dependence(dss: Any) -> list[tuple[str, ConversionChange]]:
    """Loads that are not of constant power, each with its bus."""
    changes = []
    for name in dss.Loads.AllNames():
        if name.lower() == "none":
            continue
        dss.Loads.Name(name)
        bus = str(dss.CktElement.BusNames()[0]).partition(".")[0].lower()
        if int(dss.Loads.Model()) != 1:
            model = f"model {int(dss.Loads.Model())}"
            changes.append((bus, ConversionChange(f"load {name}", model, "approximated", CONSTANT)))
    return changes


def beyond_limits(
    found: list[Element], constant: list[Element], known: set[str]
) -> list[tuple[str, ConversionChange]]:
    """Loads and generators of constant power that become impedances at their voltages.

    `found` are the elements as the source solves them, `constant` those with loads of constant power, `known`
    the labels of elements that are reported already.
    """
    out = []
    for one, other in zip(found, constant, strict=True):
        if one.kind not in {"load", "generator"} or not one.enabled:
            continue
        power = other.power_kva[0].sum()
        if one.label not in known and abs(one.power_kva[0].sum() - power) > SAME_POWER * abs(power):
            effect = "beyond them it depends on the voltage in the source; taken as constant power"
            out.append((one.buses[0], ConversionChange(one.label, "vminpu, vmaxpu", "approximated", effect)))
    return out


def add_draw(dss: Any, each: Element, network: SourceNetwork) -> None:
    """Add a load, a generator or a battery to a network, and report properties that a customer lacks."""
    power, bus = each.power_kva[0], each.buses[0]
    used = [node for node in each.nodes[0] if 1 <= node <= PHASES]
    even = len(used) == PHASES and (is_even(power) or not power.any())
    told = list(_curves(dss, each))
    if len(used) > 1 and not even:
        told.append(ConversionChange(each.label, "delta", "approximated", IN_STAR))
    rating: float | None = None
    peak = 0.0
    if each.kind == "pvsystem":
        rating, peak = (_number(dss, each, name) for name in ("kva", "pmpp"))
        told += _sunlight(dss, each, peak)
    elif each.kind != "load":
        rating = 0.0 if each.kind in GENERATORS else None
        told.append(ConversionChange(each.label, "control", "changed", as_it_stands(power)))
    network.of_bus.extend((bus, change) for change in told)
    phases = "".join("abc"[node - 1] for node in sorted(used))
    noun = "" if each.kind in {"load", *GENERATORS} else each.kind
    draw = Draw(each.name, bus, power, even=even, rating_kva=rating, peak_kw=peak, phases=phases, noun=noun)
    network.draws.append(draw)


def _curves(dss: Any, each: Element) -> Iterator[ConversionChange]:
    """Every curve of an element over time, temperature or voltage, each once."""
    told: set[str] = set()
    known = _properties(dss, each)
    for prop, effect in OVER_TIME[each.kind].items():
        value = known.get(prop, "")
        if value and value.lower() not in told:
            told.add(value.lower())
            what = f"load shape {value}" if prop in {"yearly", "daily", "duty"} else f"{prop} {value}"
            yield ConversionChange(each.label, what, "left out", effect or PROFILE)


def _sunlight(dss: Any, each: Element, peak: float) -> Iterator[ConversionChange]:
    """Present power of a solar plant, if it is not the rated peak."""
    now = 0.0 - round(float(each.power_kva[0].sum().real), 6)
    if abs(now - peak) > SAME_POWER * peak:
        sun = _number(dss, each, "irradiance")
        effect = (
            f"feeds in {now:.4g} kW at this moment, as in the check; pv_kw is its rated peak of {peak:.6g}"
        )
        yield ConversionChange(each.label, f"irradiance {sun:g}", "changed", effect)


def _properties(dss: Any, each: Element) -> dict[str, str]:
    dss.Circuit.SetActiveElement(f"{each.kind}.{each.name}")
    return {name.lower(): str(dss.Properties.Value(name)) for name in dss.Element.AllPropertyNames()}


def _number(dss: Any, each: Element, name: str) -> float:
    dss.Circuit.SetActiveElement(f"{each.kind}.{each.name}")
    return float(dss.Properties.Value(name))


SOLVER: Final = ("set mode=snap", "set tolerance=1e-11", "set maxiterations=1000", "set maxcontroliter=200")
CONSTANT_POWER: Final = (
    "set controlmode=off",
    "batchedit load..* model=1 vminpu=0.01 vlowpu=0.005 vmaxpu=10",
    "batchedit generator..* model=1 vminpu=0.01 vmaxpu=10",
)
UNNAMED_KV: Final = (0.208, 0.48, 12.47, 24.9, 34.5, 115.0, 230.0)
"""Voltage bases, kV, of a circuit without bases in its file."""

DEAD: Final = 1e-4
"""Voltage, pu, below which a phase is not energised: only open lines end there."""

APART: Final = 1e-6
"""Coupling between a transformer's phases, relative to its largest admittance, that counts as zero."""

NO_LOAD: Final = 1e-5
"""No-load power relative to a transformer's rating from which on it is reported."""

SERIES: Final = {"line", "reactor"}
COUPLINGS: Final = {"transformer", "autotrans"}
DROOP: Final = "inverters of solar plants follow the droop curve of the customer"
TOLD: Final = {
    "monitor": MEASURE,
    "energymeter": MEASURE,
    "sensor": MEASURE,
    "regcontrol": "taps as in the source's power flow",
    "capcontrol": "switched as in the source's power flow",
    "swtcontrol": "switched as in the source's power flow",
    "fuse": "never blows",
    "relay": "never trips",
    "recloser": "never trips",
    "invcontrol": DROOP,
    "expcontrol": DROOP,
    "storagecontroller": "storage as in the source's power flow",
    "gendispatcher": "generators as in the source's power flow",
    "espvlcontrol": "plants as in the source's power flow",
    "upfccontrol": "left out with its UPFC",
}
"""Classes without current, and their replacement in a feeder."""

NO_PLACE: Final = {
    *("isource", "vccs", "fault", "upfc", "vsconverter"),
    *("gicsource", "gicline", "gictransformer"),
}
"""Classes with current that are left out; reported like any unknown class."""

DEFINITIONS: Final = {
    *("linecode", "wiredata", "cndata", "tsdata", "linespacing", "linegeometry", "xfmrcode", "spectrum"),
    *("loadshape", "tshape", "priceshape", "growthshape", "xycurve", "tcc_curve", "dynamicexp"),
}
"""Classes of data without an effect of their own; elements that refer to them report them."""


@contextmanager
def _engine() -> Iterator[Any]:
    """OpenDSS engine of its own, empty and without effects on anything else."""
    try:
        from opendssdirect import dss
    except ImportError as error:
        raise GridsecError(f"OpenDSS files need {extra('convert')}", code="not-installed") from error
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as scratch:
        engine = dss.NewContext()
        os.chdir(here)  # a new context changes to the start folder of the process
        engine.Basic.AllowForms(False)
        engine.Basic.AllowEditor(False)
        engine.Basic.AllowDOScmd(False)
        engine.Basic.AllowChangeDir(False)
        engine.Basic.DataPath(scratch)
        engine.Basic.ClearAll()
        try:
            yield engine
        finally:
            engine.Basic.ClearAll()
            os.chdir(here)


def read_opendss(path: Path) -> SourceNetwork:
    """Read and solve a master file, which defines the circuit and its voltage bases.

    Raises SourceUnreadable if OpenDSS cannot read it; GridsecError if OpenDSS cannot solve it; FeederInvalid
        with all content that a feeder cannot have.
    """
    with _engine() as dss:
        try:
            return _read(dss, path)
        except (FeederInvalid, GridsecError):
            raise
        except Exception as error:  # the external engine may raise anything on an external file
            raise SourceUnreadable(f"{path}: OpenDSS: {' '.join(str(error).split())}") from error


def _read(dss: Any, path: Path) -> SourceNetwork:
    dss.Text.Command(f'redirect "{path.resolve()}"')
    if not dss.Basic.NumCircuits():
        raise SourceUnreadable(f"{path}: OpenDSS finds no circuit in it; expected 'new circuit...'")
    report = CheckReport()
    _run(dss, (*_voltage_bases(dss), *SOLVER))
    found = _solved(dss)
    if not found:
        raise GridsecError(f"{path}: OpenDSS's own power flow does not converge", code="not-converged")
    elements = [_element(dss, name, report) for name in dss.Circuit.AllElementNames()]
    changes = voltage_dependence(dss)
    _run(dss, CONSTANT_POWER)
    volts = _solved(dss)
    if volts:
        before = elements
        elements = [_element(dss, name, report) for name in dss.Circuit.AllElementNames()]
        changes += beyond_limits(before, elements, {change.element for _, change in changes})
    nominal = _nominal(dss)
    bare = [bus for bus, volt in nominal.items() if volt <= 0]
    if bare:
        report.problem(
            "missing",
            f"{len(bare)} bus(es) have no nominal voltage, among them {', '.join(bare[:5])}; "
            "expected 'set voltagebases=[...]' and 'calcvoltagebases' in the file",
        )
    network = SourceNetwork(
        tool=f"OpenDSS {version('dss_python_backend')}",
        sources=[each.buses[0] for each in elements if each.kind == "vsource" and each.enabled],
        nominal=nominal,
        volts=volts,
        as_found=found if changes else {},
        xy=_positions(dss),
        unsolved="with loads of constant power OpenDSS's own power flow does not converge",
    )
    network.of_bus.extend(changes)
    _build_everything(dss, elements)
    for each in elements:
        _take(dss, each, network, report)
    if report.problems:
        once = dict.fromkeys(report.problems)
        raise FeederInvalid(Problem(problem.code, f"{path.name}: {problem}") for problem in once)
    return network


def _run(dss: Any, commands: tuple[str, ...]) -> None:
    for command in commands:
        dss.Text.Command(command)


def _solved(dss: Any) -> dict[str, Phasors]:
    """Solve; voltages of all buses, V, none without a solution."""
    dss.Solution.Solve()
    if not dss.Solution.Converged():
        return {}
    volts: dict[str, Phasors] = {}
    for bus in _buses(dss):
        parts = np.array(dss.Bus.Voltages()).reshape(-1, 2)
        v = np.full(PHASES, np.nan, dtype=np.complex128)
        for node, (real, imaginary) in zip(dss.Bus.Nodes(), parts, strict=True):
            live = abs(complex(real, imaginary)) > DEAD * 1000.0 * float(dss.Bus.kVBase())
            if 1 <= node <= PHASES and live:
                v[node - 1] = complex(real, imaginary)
        volts[bus] = v
    return volts


def _voltage_bases(dss: Any) -> tuple[str, ...]:
    """Missing commands for a file with voltage bases that it does not apply, such as a saved one."""
    named = set(dss.Settings.VoltageBases()) != set(UNNAMED_KV)
    bare = any(not volt > 0 for volt in _nominal(dss).values())
    return ("calcvoltagebases",) if named and bare else ()


def _nominal(dss: Any) -> dict[str, float]:
    return {bus: 1000.0 * float(dss.Bus.kVBase()) for bus in _buses(dss)}


def _positions(dss: Any) -> dict[str, tuple[float, float]]:
    return {
        bus: (round(float(dss.Bus.X()), 6), round(float(dss.Bus.Y()), 6))
        for bus in _buses(dss)
        if dss.Bus.Coorddefined()
    }


def _buses(dss: Any) -> Iterator[str]:
    """Yield every bus while it is the active one."""
    for bus in dss.Circuit.AllBusNames():
        dss.Circuit.SetActiveBus(bus)
        yield bus


def _element(dss: Any, full: str, report: CheckReport) -> Element:
    dss.Circuit.SetActiveElement(full)
    kind, _, name = full.partition(".")
    kind = kind.lower()
    element = dss.CktElement
    enabled = bool(element.Enabled())
    buses = tuple(str(bus).partition(".")[0].lower() for bus in element.BusNames())
    conductors = int(element.NumConductors())
    live = enabled and bool(buses)  # some controllers have no terminals
    order = list(element.NodeOrder()) if live else []
    nodes = tuple(tuple(order[k * conductors : (k + 1) * conductors]) for k in range(len(buses)))
    parts = np.array(element.Powers()).reshape(-1, 2) if live else np.empty((0, 2))
    flat = parts[:, 0] + 1j * parts[:, 1]
    # The second half of an autotransformer's conductors belongs to the voltages between its windings.
    own = conductors // 2 if kind == "autotrans" else conductors
    powers = []
    for k, here in enumerate(nodes):
        power = np.zeros(PHASES, dtype=np.complex128)
        for node, kva in zip(here[:own], flat[k * conductors : k * conductors + own], strict=True):
            if 1 <= node <= PHASES:
                power[node - 1] += kva
        powers.append(power)
    if enabled and kind not in COUPLINGS and any(node > PHASES for here in nodes for node in here):
        report.problem(
            "unsupported",
            f"{kind} {name} has a conductor besides the phases 1, 2, 3 and the grounded neutral 0; "
            "expected none",
        )
    on = tuple(k for k in range(len(buses)) if enabled and not element.IsOpen(k + 1, 0))
    return Element(name, kind, buses, nodes, tuple(powers), enabled, on)


def _build_everything(dss: Any, elements: list[Element]) -> None:
    """Close open elements, after everything else has been read: only closed elements have matrices."""
    for each in elements:
        if each.kind in SERIES and each.enabled and not each.closed:
            dss.Circuit.SetActiveElement(f"{each.kind}.{each.name}")
            for terminal in range(1, len(each.buses) + 1):
                dss.CktElement.Close(terminal, 0)
    dss.Solution.BuildYMatrix(1, 0)


def _take(dss: Any, each: Element, network: SourceNetwork, report: CheckReport) -> None:
    """Add an element to the network, or report its omission."""
    label = f"{each.kind} {each.name}"
    if not each.enabled:
        network.leave_out(label, "disabled in the source")
    elif each.kind in {"capacitor", "reactor"} and _is_shunt(each):
        _shunt(dss, each, network)
    elif each.kind in SERIES:
        _line(dss, each, network, report)
    elif each.kind == "capacitor":
        text = f"{label} is in series between {each.buses[0]} and {each.buses[1]}; expected a shunt"
        report.problem("unsupported", text)
    elif each.kind in COUPLINGS:
        line, idle = _regulator(dss, each, network)
        network.couplings.append(Coupling(label, each.buses, each.power_kva, line, idle))
    elif each.kind in LOADS | GENERATORS | STORAGE:
        add_draw(dss, each, network)
    elif each.kind != "vsource":
        at = [bus for bus in each.buses if bus in network.nominal]  # none for controllers of several elements
        network.leave_out(label, TOLD.get(each.kind, UNLIKE), *at)


def _regulator(dss: Any, each: Element, network: SourceNetwork) -> tuple[LineRow | None, Draw | None]:
    """Transformer as a line with a tap: two ends of the same phases, without coupling or phase shift.

    With the admittance y behind a ratio t its admittances are ``y / t^2``, ``-y / t`` and, at the far end, y
    and the no-load admittance. The latter becomes a draw there.
    """
    ends = [sorted((node, k) for k, node in enumerate(nodes) if node > 0) for nodes in each.nodes]
    nodes = [node for node, _ in ends[0]]
    alike = each.kind == "transformer" and len(ends) == 2 and nodes == [node for node, _ in ends[-1]]
    if not (alike and each.closed and nodes and len(set(nodes)) == len(nodes) and nodes[-1] <= PHASES):
        return None, None
    whole, count = _yprim(dss, each), len(nodes)
    order = [k for _, k in ends[0]] + [len(each.nodes[0]) + k for _, k in ends[1]]
    blocks = whole[np.ix_(order, order)].reshape(2, count, 2, count)
    near, across, far = (np.diagonal(blocks[i, :, j]) for i, j in ((0, 0), (0, 1), (1, 1)))
    crossed = max(
        np.abs(blocks[i, :, j] - np.diag(np.diagonal(blocks[i, :, j]))).max() for i in (0, 1) for j in (0, 1)
    )
    if crossed > APART * np.abs(whole).max() or not near.all() or not across.all():
        return None, None
    ratio = -across / near
    series = -1.0 / (ratio * across)
    if (
        np.abs(ratio.imag).max() > APART
        or ratio.real.min() <= 0
        or min(series.real.min(), series.imag.min()) < 0
    ):
        return None, None
    label = f"{each.kind} {each.name}"
    phases = np.array(nodes) - 1
    row = line_row(
        f"{each.kind}.{each.name}",
        (each.buses[0], each.buses[1]),
        phases,
        series=np.diag(series),
        shunt=np.zeros((count, count)),
        changes=Changes(),
    )
    taps = np.ones(PHASES)
    here, there = (network.nominal[bus] for bus in each.buses)
    taps[phases] = ratio.real * there / here
    idle = np.zeros(PHASES, dtype=np.complex128)
    v = network.volts[each.buses[1]][phases] if network.volts else np.full(count, np.nan)
    idle[phases] = np.abs(v) ** 2 * np.conj(far - 1.0 / series) / 1e3
    takes = np.abs(idle).sum() > NO_LOAD * float(dss.Properties.Value("kva"))  # False for NaN
    draw = Draw(f"{label} no-load", each.buses[1], idle, even=is_even(idle), idle=True) if takes else None
    return replace(with_taps(row, taps), rating_a=_amps(dss, each, count)), draw


def _amps(dss: Any, each: Element, count: int) -> float | None:
    """Rated current of a transformer's second winding, A; for several phases kV is between phases."""
    dss.Transformers.Name(each.name)
    dss.Transformers.Wdg(2)
    kva, kv = float(dss.Transformers.kVA()), float(dss.Transformers.kV())
    neutral = kv / 3**0.5 if count > 1 else kv
    return rounded(kva / count / neutral) if kva > 0 and kv > 0 else None


def _is_shunt(each: Element) -> bool:
    return len(each.buses) == 1 or each.buses[0] == each.buses[1] or set(each.nodes[-1]) == {0}


def _yprim(dss: Any, each: Element) -> Phasors:
    dss.Circuit.SetActiveElement(f"{each.kind}.{each.name}")
    flat = np.array(dss.CktElement.YPrim())
    size = round((flat.size // 2) ** 0.5)
    matrix: Phasors = (flat[0::2] + 1j * flat[1::2]).reshape(size, size)
    return matrix


def _line(dss: Any, each: Element, network: SourceNetwork, report: CheckReport) -> None:
    """Line or series reactor: series impedance and charging from its primitive admittances."""
    label = each.name if each.kind == "line" else f"{each.kind}.{each.name}"
    here, there = each.nodes
    if here != there or len(set(here)) != len(here) or not all(1 <= node <= PHASES for node in here):
        if all(1 <= node <= PHASES for node in (*here, *there)):
            report.problem(
                "unsupported",
                f"line {label} joins the phases {'.'.join(map(str, here))} of {each.buses[0]} to "
                f"{'.'.join(map(str, there))} of {each.buses[1]}; expected the same phases at both ends",
            )
        elif 0 in (*here, *there):
            report.problem("unsupported", f"line {label} has a conductor to ground; expected phases 1, 2, 3")
        return
    matrix, count = _yprim(dss, each), len(here)
    series = np.asarray(
        np.linalg.inv(-0.5 * (matrix[:count, count:] + matrix[count:, :count].T)), dtype=np.complex128
    )
    shunt: Floats = (
        matrix[:count, :count] + matrix[count:, count:] + matrix[:count, count:] + matrix[count:, :count]
    ).imag
    order = np.argsort(here)
    phases = np.array(here)[order] - 1
    if min(series.real.diagonal().min(), series.imag.diagonal().min()) < 0:
        report.problem("negative", f"line {label} has a negative resistance or reactance; expected none")
        return
    changes = Changes()
    row = line_row(
        label,
        (each.buses[0], each.buses[1]),
        phases,
        series=series[np.ix_(order, order)],
        shunt=shunt[np.ix_(order, order)],
        changes=changes,
    )
    network.of_bus.extend((each.buses[0], change) for change in changes)
    network.add_line(_rated(dss, each, row), [each.buses[k] for k in each.on])


def _rated(dss: Any, each: Element, row: LineRow) -> LineRow:
    limit = 0.0
    if each.kind == "line":
        dss.Lines.Name(each.name)
        limit = float(dss.Lines.NormAmps())
    return replace(row, closed=each.closed, rating_a=limit if limit > 0 else None)


def _shunt(dss: Any, each: Element, network: SourceNetwork) -> None:
    """A capacitor at a bus becomes the charging of a line to nowhere; a reactor is left out."""
    label, bus = f"{each.kind} {each.name}", each.buses[0]
    kvar = -sum(power.sum() for power in each.power_kva).imag
    if not each.closed or each.kind == "reactor" or kvar <= 0:
        effect = f"{-kvar:.4g} kvar" if each.closed else OFF
        network.leave_out(label, effect, bus)
        return
    # Both terminals may be at phases of the bus: entries between phases are where their conductors meet.
    meet = np.equal.outer(np.arange(1, PHASES + 1), np.concatenate(each.nodes)).astype(np.float64)
    here = np.flatnonzero(meet.any(axis=1))
    block = (meet @ _yprim(dss, each).imag @ meet.T)[np.ix_(here, here)]
    phases = "".join("abc"[k] for k in here)
    network.add_capacitor(f"capacitor.{each.name}", bus, block, kvar, phases=phases, label=label)
