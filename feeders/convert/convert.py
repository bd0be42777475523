"""Conversion of other formats into feeder folders.

Sources: the name of a bundled feeder (builds that folder again), `profiles` (builds the profile library
again), `pandapower:<network>`, `simbench:<code>` or the code alone, the path of a pandapower JSON file, of an
OpenDSS master file (.dss) or of a power-grid-model JSON file, or a feeder's folder. pandapower, simbench and
OpenDSS are the optional extra `convert`.
"""

from __future__ import annotations

import json
import logging
import random
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any, Final

from feeders.convert import from_simbench
from feeders.convert.customers import Fleet
from feeders.convert.from_opendss import read_opendss
from feeders.convert.from_pandapower import read_pandapower
from feeders.convert.from_power_grid_model import read_pgm
from feeders.convert.network import Converted, feeder_of, opened_rows
from feeders.convert.provenance import (
    CHANGES_FILE,
    SOURCE_FILE,
    Changes,
    ConversionChange,
    Origin,
    SourceUnreadable,
    changes_csv,
    feeder_source,
    origin,
    profiles_source,
    sentences,
    versioned,
)
from feeders.convert.round_trip import SourceCheck, compare
from feeders.convert.source import SourceNetwork
from feeders.convert.transformers import EVERYTHING, Extent
from feeders.format.columns import CUSTOMERS_FILE, LINES_FILE, META_FILE
from feeders.format.tables import FeederTables, read, write
from feeders.model.site import from_tables
from feeders.profiles import ENVELOPES, Season
from feeders.util import command_line, extra
from gridsec.errors import FeederInvalid, GridsecError, Problem

UNCHECKED: Final = "it was a feeder's folder already"
AGAIN: Final = "Before the folder was written again: "


def from_folder(
    folder: Path,
    name: str,
    *,
    root: str | None = None,
    opened: Sequence[str] = (),
    droop: str | None = None,
    extent: Extent = EVERYTHING,
) -> Converted:
    """Copy a feeder in the project's own format, with the changes of its earlier conversion.

    An empty `name` keeps the old one; `root`, `droop` and `extent.one_voltage` are only for networks of other
    tools. `extent.meshed` keeps loops closed, with any `meshed` of the file.

    Raises FeederInvalid for an invalid feeder, or with every option that does not apply to a feeder;
        GridsecError for an invalid conversion.csv.
    """
    tables = read(folder)
    given = {"root": root is not None, "droop": droop is not None, "one_voltage": extent.one_voltage}
    problems: list[str] = [
        Problem(
            "inconsistent", f"{option} is for networks of other tools; {folder} is a feeder's folder already"
        )
        for option, value in given.items()
        if value
    ]
    changes = Changes()
    try:
        lines = opened_rows(tables.lines, opened, changes)
    except FeederInvalid as error:
        problems += error.problems
    if problems:
        raise FeederInvalid(problems)
    before = origin(folder)
    earlier = [] if before is None else [ConversionChange(*row) for row in before.changes.to_numpy()]
    meta = tables.meta
    if name:
        meta = replace(meta, name=name, title=name if meta.title == meta.name else meta.title)
    meta = replace(meta, meshed=extent.meshed or meta.meshed)
    tables = replace(tables, meta=meta, lines=tuple(lines))
    return Converted(tables, (*earlier, *changes), None, UNCHECKED)


def source_again(
    before: Origin | None, tables: FeederTables, folder: Path, command: str, notes: tuple[str, ...]
) -> str:
    """Content of the SOURCE.md of a folder that is written again; `before` is its origin until now."""
    if before is None or not before.source:
        about, source, package = "A feeder in the project's own form.", str(folder), versioned("gridsec")
        check = f"Not checked: {UNCHECKED}"
    else:
        about, (source, _, package) = before.about, before.source.rpartition(", ")
        told = before.check.removeprefix(AGAIN).removesuffix(".")
        check = f"{AGAIN}{told or 'unknown'}"
        command = f"{before.command}`, then `{command}" if before.command else command
    return feeder_source(
        tables, about=about, origin=source, package=package, command=command, notes=notes, check=check
    )


PROFILES = "profiles"
OPENDSS, PGM = "opendss", "power-grid-model"
SIMBENCH_CODE = re.compile(r"[0-9]-[A-Za-z0-9.]+(-[A-Za-z0-9.]+)*--[0-9]-(no_)?sw")
WRITTEN = (META_FILE, LINES_FILE, CUSTOMERS_FILE, CHANGES_FILE, SOURCE_FILE)
"""Files of a converted feeder's folder."""

SEED = 1
KERBER = "(G. Kerber, dissertation, TU Munich 2011)"


@dataclass(frozen=True, slots=True)
class Recipe:
    """Options of the conversion to a bundled feeder; the defaults are those of any other source."""

    source: str
    title: str = ""
    about: str = "A converted network."
    root: str | None = None
    fleet: Fleet | None = None
    max_attacked: int = 1
    mend: Callable[[Any], ConversionChange] | None = None
    """Corrects an error of the source; returns the change."""


def _reactive_powers(net: Any) -> ConversionChange:
    """Convert the reactive powers of two phases to the unit of the third."""
    net.asymmetric_load[["q_b_mvar", "q_c_mvar"]] *= 1000.0
    return ConversionChange(
        "the loads of phases b and c",
        "reactive power",
        "changed",
        "too small by a factor of 1000 in pandapower's file; multiplied by 1000, which gives every load the "
        "power factor 0.95 of phase a",
    )


RECIPES: dict[str, Recipe] = {
    "kerber-landnetz": Recipe(
        "pandapower:create_kerber_landnetz_freileitung_1",
        "Kerber rural network, overhead line 1",
        f"A German rural low-voltage feeder, overhead lines, 13 customers {KERBER}.",
        fleet=Fleet(2, 10.0),
        max_attacked=2,
    ),
    "kerber-dorfnetz": Recipe(
        "pandapower:create_kerber_dorfnetz",
        "Kerber village network",
        f"A German village low-voltage grid, cables, 57 customers {KERBER}.",
        fleet=Fleet(2, 10.0),
    ),
    "kerber-vorstadtnetz": Recipe(
        "pandapower:create_kerber_vorstadtnetz_kabel_1",
        "Kerber suburban network, cable 1",
        f"A German suburban low-voltage grid, cables, 146 customers {KERBER}.",
        fleet=Fleet(2, 10.0),
    ),
    "cigre-lv": Recipe(
        "pandapower:create_cigre_network_lv",
        "CIGRE low-voltage benchmark, residential feeder",
        "The residential feeder of the European low-voltage benchmark (CIGRE Task Force C6.04.02, 2014).",
        root="Bus R1",
        fleet=Fleet(1, 0.0),
    ),
    "case33bw": Recipe(
        "pandapower:case33bw",
        "Baran and Wu, 33 buses, 12.66 kV",
        "The radial 12.66 kV test feeder of M. E. Baran and F. F. Wu, IEEE Trans. Power Delivery 4(2), 1989, "
        "its five tie lines open.",
        fleet=Fleet(2, 0.0),
    ),
    "ieee-european-lv": Recipe(
        "pandapower:ieee_european_lv_asymmetric",
        "IEEE European low-voltage test feeder",
        "The European low-voltage test feeder of the IEEE PES Distribution Test Feeder Working Group\n"
        "(2015): 55 customers of one phase each. load_kw is their load in the minute 566 of its day,\n"
        "09:26, the largest of the feeder; it is not the peak of each.",
        fleet=Fleet(3, 4.6),
        mend=_reactive_powers,
    ),
    "simbench-lv-rural1": Recipe(
        "simbench:1-LV-rural1--0-sw",
        "SimBench LV rural 1",
        "A German rural low-voltage grid of the SimBench data set, 13 customers.",
        fleet=Fleet(2, 5.0),
        max_attacked=2,
    ),
    "simbench-lv-rural3": Recipe(
        "simbench:1-LV-rural3--0-sw",
        "SimBench LV rural 3",
        "A German rural low-voltage grid of the SimBench data set, 118 customers.",
        fleet=Fleet(4, 5.0),
    ),
}


@dataclass(frozen=True, slots=True, eq=False)
class Conversion:
    """Result of a conversion."""

    # Omissions, approximations, additions and changes; also in conversion.csv beside the feeder
    changes: tuple[ConversionChange, ...]
    check: SourceCheck | None  # Comparison of the AC power flows of feeder and source; None without one
    unchecked: str = ""  # Reason for a missing comparison

    @property
    def notes(self) -> tuple[str, ...]:
        """Changes as sentences, as in SOURCE.md."""
        return sentences(self.changes)


def convert(
    source: str,
    out: Path | str,
    *,
    root: str | None = None,
    name: str | None = None,
    droop: str | None = None,
    opened: Sequence[str] = (),
    meshed: bool = False,
    one_voltage: bool = False,
) -> Conversion:
    """Convert a source to a feeder's folder (or the profile library) with its SOURCE.md.

    source: source, see the module.
    root: bus that becomes the metered busbar, if the source has several candidates.
    name: default: that of the source if it is a feeder's folder, else that of the output folder.
    droop: preset of the source's generators.
    opened: lines to open, so that a mesh becomes radial.
    meshed: True: loops stay closed, as with `meshed = true` in feeder.toml.
    one_voltage: True: the feeder ends at transformers to another nominal voltage, which become customers.
    Raises FeederInvalid if the result is not a valid feeder: a loop, an island, a missing zero sequence, ...;
        or with every option that does not apply to a feeder's folder; SourceUnreadable if the source does not
        exist, or its own tool cannot read it; GridsecError if a required power flow of the source fails, or
        the extra `convert` is not installed; FileExistsError if the folder has a feeder that is not from a
        conversion.
    """
    folder = Path(out)
    if source == PROFILES:
        _convert_profiles(folder)
        return Conversion((), None, "profiles have no power flow")
    if (folder / META_FILE).exists() and not (folder / CHANGES_FILE).is_file():
        raise FileExistsError(
            f"{folder}: holds a feeder that is not from a conversion; expected another folder"
        )
    again = source not in RECIPES and Path(source).is_dir()  # a feeder's folder has a name and an origin
    before = origin(source) if again else None
    usual = "" if again else re.sub(r"[^A-Za-z0-9_-]+", "-", folder.resolve().name)
    chosen = name or (source if source in RECIPES else usual)
    extent = Extent(one_voltage, meshed)
    converted, package = _converted(source, chosen[:64], root=root, droop=droop, opened=opened, extent=extent)
    try:  # some valid tables cannot be loaded, and the result must be
        from_tables(converted.tables)
    except FeederInvalid as error:
        notes = (Problem("note", f"while converting: {note}") for note in sentences(converted.changes))
        raise FeederInvalid([*error.problems, *notes]) from error
    write(converted.tables, folder)
    done = _checked(converted, folder)
    (folder / CHANGES_FILE).write_text(changes_csv(done.changes), encoding="utf-8", newline="\n")
    target = f"data/feeders/{chosen}" if source in RECIPES else str(out)
    given = {"--root": root, "--name": name, "--droop": droop}
    options = [word for option, value in given.items() if value for word in (option, value)]
    options += [word for line in opened for word in ("--open", line)]
    options += [flag for flag, value in (("--meshed", meshed), ("--one-voltage", one_voltage)) if value]
    command = command_line(["gridsec", "feeders", "convert", source, target, *options])
    if again:
        text = source_again(before, converted.tables, Path(source), command, done.notes)
    else:
        recipe = RECIPES.get(source, Recipe(source))
        text = feeder_source(
            converted.tables,
            about=recipe.about,
            origin=recipe.source,
            package=versioned(package),
            command=command,
            notes=done.notes,
            check=done.check.sentence if done.check else f"Not checked: {done.unchecked}",
        )
    (folder / SOURCE_FILE).write_text(text, encoding="utf-8", newline="\n")
    return done


def check_against_source(
    source: str,
    folder: Path | str,
    *,
    root: str | None = None,
    opened: Sequence[str] = (),
    one_voltage: bool = False,
) -> SourceCheck:
    """Compare a folder's AC power flow with that of its source, at the source's loads; as of `convert`.

    Raises SourceUnreadable if the source cannot be read; GridsecError if the source's power flow fails;
        PowerFlowDiverged if the feeder's power flow fails.
    """
    tables = read(folder)
    extent = Extent(one_voltage, tables.meta.meshed)
    converted, _ = _converted(source, "check", root=root, opened=opened, extent=extent)
    if converted.state is None:
        raise GridsecError(converted.unchecked, code="not-converged")
    return compare(converted.state, tables)


def _checked(converted: Converted, folder: Path) -> Conversion:
    """Compare the written feeder with the source's power flow."""
    if converted.state is None:
        return Conversion(converted.changes, None, converted.unchecked)
    try:
        return Conversion(converted.changes, compare(converted.state, read(folder)))
    except GridsecError as error:
        return Conversion(converted.changes, None, " ".join(str(error).split()))


def _converted(
    source: str,
    name: str,
    *,
    root: str | None,
    opened: Sequence[str] = (),
    droop: str | None = None,
    extent: Extent = EVERYTHING,
) -> tuple[Converted, str]:
    """Source as a feeder, and the package that has its data or reads its file."""
    recipe = RECIPES.get(source, Recipe(source))
    path = Path(recipe.source)
    if source not in RECIPES and path.is_dir():
        return from_folder(path, name, root=root, opened=opened, droop=droop, extent=extent), "gridsec"
    kind = _kind(path) if path.is_file() else ""
    network: SourceNetwork
    if kind == OPENDSS:
        network, package = read_opendss(path), "opendssdirect.py"
    elif kind == PGM:
        network, package = read_pgm(path), "power-grid-model"
    else:
        net, package = _open(recipe.source)
        mended = [recipe.mend(net)] if recipe.mend else []
        network = read_pandapower(net)
        network.changes[:0] = mended
    converted = feeder_of(
        network,
        name,
        title=recipe.title,
        root=root or recipe.root,
        opened=opened,
        droop=droop,
        extent=extent,
        fleet=recipe.fleet,
        max_attacked=recipe.max_attacked,
    )
    return converted, package


def _kind(path: Path) -> str:
    """Tool of a file, by its name and content.

    Raises SourceUnreadable for any other file.
    """
    if path.suffix.lower() == ".dss":
        return OPENDSS
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise SourceUnreadable(
            f"{path}: invalid JSON ({error}); expected a pandapower or power-grid-model JSON file, "
            "or an OpenDSS master file with the ending .dss"
        ) from error
    if isinstance(content, dict):
        if content.get("_class") == "pandapowerNet":
            return "pandapower"
        if "data" in content and "version" in content:
            return PGM
    raise SourceUnreadable(
        f"{path}: JSON, but neither a pandapower net (with _class pandapowerNet) nor input data of "
        "power-grid-model (with version, type and data)"
    )


def _seeded(make: Callable[[], Any]) -> Any:
    """Build a network with random cable types; the caller's random state is restored."""
    state = random.getstate()
    random.seed(SEED)
    try:
        return make()
    finally:
        random.setstate(state)


def _convert_profiles(folder: Path) -> None:
    columns = from_simbench.year()
    loads = from_simbench.load_profiles(columns)
    stretches = [(season.file, *astuple(stretch)) for season, stretch in from_simbench.STRETCHES.items()]
    text = profiles_source(stretches, len(loads), sum(name.startswith("PV") for name in columns))
    folder.mkdir(parents=True, exist_ok=True)
    for season in Season:
        (folder / season.file).write_bytes(from_simbench.library_csv(columns, season))
    (folder / ENVELOPES).write_text(from_simbench.envelopes_csv(columns), encoding="ascii", newline="\n")
    (folder / SOURCE_FILE).write_text(text, encoding="utf-8", newline="\n")


def _open(origin: str) -> tuple[Any, str]:
    """Pandapower net of a source, and the name of the package with its data."""
    kind, _, rest = origin.partition(":")
    path = Path(origin)
    if path.suffix.lower() in (".json", ".dss") and not path.is_file():
        raise SourceUnreadable(f"{origin}: there is no such file", code="missing")
    try:
        import pandapower
        import pandapower.networks
    except ImportError as error:
        raise GridsecError(f"conversion needs {extra('convert')}", code="not-installed") from error
    if (kind == "simbench" and rest) or SIMBENCH_CODE.fullmatch(origin):
        return from_simbench.grid(rest or origin), "simbench"
    if kind == "pandapower" and rest:
        return _named(rest), "pandapower"
    if not path.is_file():
        raise SourceUnreadable(
            f"{origin!r} is not a source; expected {', '.join(RECIPES)}, pandapower:<network>, "
            "simbench:<code>, a pandapower or power-grid-model JSON file, an OpenDSS master file (.dss), "
            "or a feeder's folder",
            code="unknown-name",
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            net = pandapower.from_json(str(path))
    except Exception as error:  # an external reader may raise anything on an external file
        raise SourceUnreadable(f"{origin}: pandapower cannot read it: {error}") from error
    if not isinstance(net, pandapower.pandapowerNet):
        raise SourceUnreadable(f"{origin}: not a pandapower net")
    return net, "pandapower"


def _named(name: str) -> Any:
    """Build one of pandapower's bundled networks."""
    from pandapower import networks

    found = [getattr(networks, maker, None) for maker in (name, f"create_{name}")]
    makers: list[Callable[[], Any]] = [maker for maker in found if callable(maker)]
    if not makers:
        raise SourceUnreadable(f"pandapower has no network {name!r}", code="unknown-name")
    talk = logging.getLogger("pandapower")
    level = talk.level
    talk.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            net = _seeded(makers[0])
    except Exception as error:  # a maker with required arguments may raise anything
        raise SourceUnreadable(f"pandapower cannot build {name!r} by itself: {error}") from error
    finally:
        talk.setLevel(level)
    if not hasattr(net, "bus"):
        raise SourceUnreadable(f"pandapower's {name!r} is not a network")
    return net
