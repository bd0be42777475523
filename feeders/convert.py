"""Conversion of other formats into feeder folders, each with the SOURCE.md that tells where it is from.

Sources: the name of a feeder that comes with the project (builds that folder again), `profiles` (builds
the profile library again), `pandapower:<network>`, `simbench:<code>`, or the path of a pandapower JSON
file. pandapower and simbench are the optional extra `convert`.
"""

from __future__ import annotations

import random
import re
from collections.abc import Callable
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

from feeders import convert_simbench
from feeders.convert_pandapower import Fleet, from_pandapower
from feeders.convert_source import feeder_source, profiles_source
from feeders.profiles import ENVELOPES, Season
from feeders.schema import validate, write
from gridsec.errors import FeederInvalid, GridsecError

PROFILES = "profiles"
SEED = 1
KERBER = "(G. Kerber, dissertation, TU Munich 2011)"


@dataclass(frozen=True, slots=True)
class Recipe:
    """How one of the project's own feeders was made."""

    source: str
    title: str
    about: str
    root: str | None = None
    fleet: Fleet | None = None
    max_attacked: int = 1
    mend: Callable[[Any], str] | None = None
    """Corrects what is wrong in the source, and says what."""


def _reactive_powers(net: Any) -> str:
    """Bring the reactive powers of two phases to the unit of the third."""
    net.asymmetric_load[["q_b_mvar", "q_c_mvar"]] *= 1000.0
    return (
        "changed: the reactive powers of phases b and c are a thousandth of what they should be in "
        "pandapower's file; they are taken 1000 times, which gives everybody the power factor 0.95 that "
        "phase a has there"
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
        "(2015): 55 customers of one phase each. load_kw is what they draw in the minute 566 of its day,\n"
        "09:26, when the feeder carries the most; it is not the peak of each.",
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


def convert(
    source: str,
    out: Path | str,
    *,
    root: str | None = None,
    name: str | None = None,
    droop: str | None = None,
) -> tuple[str, ...]:
    """Convert a source into a feeder's folder (or the profile library) with its SOURCE.md.

    Parameters
    ----------
    source
        See the module.
    out
        Folder to write; made if it does not exist.
    root
        Bus that becomes the metered busbar, where the source leaves a choice.
    name
        Name of the feeder; default: the name of the folder.
    droop
        Preset of the source's generators.

    Returns
    -------
    notes
        What was left out, added or changed; also in SOURCE.md.

    Raises
    ------
    FeederInvalid
        If the result is no valid feeder: a loop, an island, ...
    GridsecError
        If the source does not exist, or the extra `convert` is not installed.
    """
    folder = Path(out)
    if source == PROFILES:
        return _convert_profiles(folder)
    recipe = RECIPES.get(source)
    origin = source if recipe is None else recipe.source
    net, package = _open(origin)
    mended = (recipe.mend(net),) if recipe and recipe.mend else ()
    chosen = name or (
        source if recipe is not None else re.sub(r"[^A-Za-z0-9_-]+", "-", folder.resolve().name)
    )
    tables, others = from_pandapower(
        net,
        chosen,
        title=recipe.title if recipe else "",
        root=root or (recipe.root if recipe else None),
        droop=droop,
        fleet=recipe.fleet if recipe else None,
        max_attacked=recipe.max_attacked if recipe else 1,
    )
    notes = mended + others
    problems = validate(tables)
    if problems:
        raise FeederInvalid([*problems, *(f"while converting: {note}" for note in notes)])
    write(tables, folder)
    target = f"data/feeders/{chosen}" if recipe else str(out)
    command = " ".join(["gridsec convert", source, target, *_options(root, name, droop)])
    about = recipe.about if recipe else "A converted network."
    text = feeder_source(tables, about=about, origin=origin, package=package, command=command, notes=notes)
    (folder / "SOURCE.md").write_text(text, encoding="utf-8", newline="\n")
    return notes


def _options(root: str | None, name: str | None, droop: str | None) -> list[str]:
    """Return the options of the command line that were given."""
    given = ((f"--root {root!r}", root), (f"--name {name}", name), (f"--droop {droop}", droop))
    return [text for text, value in given if value]


def _seeded(make: Callable[[], Any]) -> Any:
    """Build a network whose maker draws cables at random; the caller's random state stays as it was."""
    state = random.getstate()
    random.seed(SEED)
    try:
        return make()
    finally:
        random.setstate(state)


def _convert_profiles(folder: Path) -> tuple[str, ...]:
    columns = convert_simbench.year()
    loads = convert_simbench.load_profiles(columns)
    stretches = [(season.file, *astuple(stretch)) for season, stretch in convert_simbench.STRETCHES.items()]
    text = profiles_source(stretches, len(loads), sum(name.startswith("PV") for name in columns))
    folder.mkdir(parents=True, exist_ok=True)
    for season in Season:
        (folder / season.file).write_bytes(convert_simbench.library_csv(columns, season))
    (folder / ENVELOPES).write_text(convert_simbench.envelopes_csv(columns), encoding="ascii", newline="\n")
    (folder / "SOURCE.md").write_text(text, encoding="utf-8", newline="\n")
    return ()


def _open(origin: str) -> tuple[Any, str]:
    """Return the net of a source and the name of the package that holds its data."""
    kind, _, rest = origin.partition(":")
    try:
        import pandapower
        import pandapower.networks
    except ImportError as error:
        raise GridsecError("conversion needs the extra 'convert': pip install 'gridsec[convert]'") from error
    if kind == "simbench" and rest:
        return convert_simbench.grid(rest), "simbench"
    if kind == "pandapower" and rest:
        makers = {rest, f"create_{rest}"}
        found: list[Callable[[], Any]] = [
            getattr(pandapower.networks, maker)
            for maker in makers
            if callable(getattr(pandapower.networks, maker, None))
        ]
        if not found:
            raise GridsecError(f"pandapower has no network {rest!r}")
        return _seeded(found[0]), "pandapower"
    path = Path(origin)
    if not path.is_file():
        raise GridsecError(
            f"{origin!r} is no source; expected profiles, {', '.join(RECIPES)}, pandapower:<network>, "
            "simbench:<code>, or a pandapower JSON file"
        )
    try:
        net = pandapower.from_json(str(path))
    except Exception as error:  # whatever the foreign reader raises on a foreign file
        raise GridsecError(f"{origin}: pandapower cannot read it: {error}") from error
    if not isinstance(net, pandapower.pandapowerNet):
        raise GridsecError(f"{origin}: holds no pandapower net")
    return net, "file"
