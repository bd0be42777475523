"""Provenance of converted feeders: changes, SOURCE.md, licences."""

from __future__ import annotations

import csv
import io
import re
import textwrap
from collections.abc import Iterable
from dataclasses import astuple, dataclass
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final, Literal

import pandas as pd

from feeders.format.tables import FeederTables
from feeders.model.equipment import folder_of
from gridsec.errors import GridsecError

CHANGES_FILE: Final = "conversion.csv"
COLUMNS: Final = ("element", "property", "done", "effect")
WHOLE: Final = "all of it"
"""Property value for a whole element."""

NAMED: Final = 8
"""Largest number of elements that a sentence names; the file names all of them."""

Done = Literal["left out", "approximated", "changed", "added", "accepted"]


class BusbarUnclear(GridsecError):
    """There are several possible busbars, or none."""

    code = "busbar-unclear"


class SourceUnreadable(GridsecError):
    """The source does not exist, or is not a readable network."""

    code = "unreadable"


@dataclass(frozen=True, slots=True)
class ConversionChange:
    """Element of the source that is not, or not exactly, in the feeder."""

    element: str  # Kind and name
    prop: str  # Property of the element; WHOLE for all of it
    done: Done  # Kind of the change
    effect: str  # Replacement in the feeder, and its effect on the voltages


class Changes(list[ConversionChange]):
    """Changes of a conversion in the order of their detection."""

    def note(self, element: str, prop: str, done: Done, effect: str) -> None:
        """Add a change; arguments as of `ConversionChange`."""
        self.append(ConversionChange(element, prop, done, effect))


def sentences(changes: Iterable[ConversionChange]) -> tuple[str, ...]:
    """Changes as sentences, with equal changes of several elements together."""
    fates: dict[tuple[str, str, str], list[str]] = {}
    for change in changes:
        fates.setdefault((change.done, change.prop, change.effect), []).append(change.element)
    return tuple(
        f"{done}: {'' if prop == WHOLE else f'{prop} of '}{_listed(elements)}; {effect}"
        for (done, prop, effect), elements in fates.items()
    )


def _listed(elements: list[str]) -> str:
    tail = f" and {len(elements) - NAMED} more" if len(elements) > NAMED else ""
    return ", ".join(elements[:NAMED]) + tail


def changes_csv(changes: Iterable[ConversionChange]) -> str:
    """Table of all changes, one row for each element and property."""
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(astuple(change) for change in changes)
    return out.getvalue()


SOURCE_FILE = "SOURCE.md"

ODBL = """\
The database called SimBench is made available under the Open Database License,
http://opendatacommons.org/licenses/odbl/1.0/. Any rights in individual contents of the database are
licensed under the Database Contents License, http://opendatacommons.org/licenses/dbcl/1.0/.
Copyright (c) 2019-2026 by University of Kassel, TU Dortmund, RWTH Aachen University and Fraunhofer
Institute for Energy Economics and Energy System Technology (IEE) Kassel and individual contributors.

{this} contains information from SimBench and is made available under the same Open Database License.
A changed version of it must be published under that license too."""

PANDAPOWER = """\
The network data come with pandapower, which is under the 3-clause BSD license:

Copyright (c)
    2016-2026 University of Kassel
    2016-2026 Fraunhofer Institute for Energy Economics
    2016-2026 Energy System Technology (IEE) Kassel
    2016-2026 individual contributors (see AUTHORS file for details)
    All rights reserved.

Redistribution and use in source and binary forms, with or without modification, are permitted provided
that the following conditions are met:

1. Redistributions of source code must retain the above copyright notice, this list of conditions and the
following disclaimer.

2. Redistributions in binary form must reproduce the above copyright notice, this list of conditions and
the following disclaimer in the documentation and/or other materials provided with the distribution.

3. Neither the name of the copyright holder nor the names of its contributors may be used to endorse or
promote products derived from this software without specific prior written permission.

THIS SOFTWARE IS PROVIDED BY THE COPYRIGHT HOLDERS AND CONTRIBUTORS "AS IS" AND ANY EXPRESS OR IMPLIED
WARRANTIES, INCLUDING, BUT NOT LIMITED TO, THE IMPLIED WARRANTIES OF MERCHANTABILITY AND FITNESS FOR A
PARTICULAR PURPOSE ARE DISCLAIMED. IN NO EVENT SHALL THE COPYRIGHT HOLDER OR CONTRIBUTORS BE LIABLE FOR ANY
DIRECT, INDIRECT, INCIDENTAL, SPECIAL, EXEMPLARY, OR CONSEQUENTIAL DAMAGES (INCLUDING, BUT NOT LIMITED TO,
PROCUREMENT OF SUBSTITUTE GOODS OR SERVICES; LOSS OF USE, DATA, OR PROFITS; OR BUSINESS INTERRUPTION)
HOWEVER CAUSED AND ON ANY THEORY OF LIABILITY, WHETHER IN CONTRACT, STRICT LIABILITY, OR TORT (INCLUDING
NEGLIGENCE OR OTHERWISE) ARISING IN ANY WAY OUT OF THE USE OF THIS SOFTWARE, EVEN IF ADVISED OF THE
POSSIBILITY OF SUCH DAMAGE."""

OWN_FILE = "The licence of the converted file applies; this conversion adds no terms of its own."

LICENCES = {"simbench": ODBL.format(this="This folder"), "pandapower": PANDAPOWER}

ASSUMED = """\
Every customer has a meter. The transformer is upstream of the metered busbar and not part of the feeder.
Where the source gives no load profile or no reactive power, the load follows a profile of the library
(data/profiles), by turns in the order of the loads: households H0, above 30 kW or at medium voltage trade
G and agriculture L; its power factor at the peak is then 0.93, as everywhere in SimBench's low voltage.
power_factor_min, power_factor_max and q_floor_kvar hold every point of the profile's history in SimBench
(data/profiles/envelopes.csv)."""


def _wrapped(notes: tuple[str, ...]) -> str:
    lines = (
        textwrap.fill(note, 108, initial_indent="- ", subsequent_indent="  ", break_on_hyphens=False)
        for note in notes
    )
    return "\n".join(lines) or "- nothing"


RANDOM = """

pandapower draws the types of some of the Kerber networks' service cables at random; the random numbers start
from the seed 1."""


def versioned(package: str) -> str:
    """Name and version of a package."""
    try:
        return f"{package} {version(package)}"
    except PackageNotFoundError:
        return package


def feeder_source(
    tables: FeederTables,
    *,
    about: str,
    origin: str,
    package: str,
    command: str,
    notes: tuple[str, ...],
    check: str,
) -> str:
    """Content of the SOURCE.md of a converted feeder.

    `package` has the data, or reads the file; `notes` are omissions, additions and changes; `check` compares
    the AC power flow with the source's.
    """
    licence = LICENCES.get(origin.partition(":")[0], OWN_FILE)
    return f"""# {tables.meta.title}

{about}

- Source: `{origin}`, {package}
- Made by: `{command}`
- {len(tables.lines)} lines and switches, {len(tables.customers)} customers

{ASSUMED}{RANDOM if "kerber" in origin else ""}

## Left out, added, changed

{_wrapped(notes)}

## Checked

{textwrap.fill(check, 108, break_on_hyphens=False)}.

## Licence

{licence}
"""


def profiles_source(stretches: Iterable[tuple[str, date, int]], loads: int, generators: int) -> str:
    """Content of the SOURCE.md of the profile library; `stretches` are file, first day and days."""
    table = "\n".join(f"| `{file}` | {first:%Y-%m-%d} | {days} |" for file, first, days in stretches)
    return f"""# Load and generation profiles

Some days of every season, one value every 15 minutes, of SimBench's low-voltage profiles:

| file | first day, a Monday | days |
|---|---|---|
{table}

Each has {loads} load profiles (`_p` active power as a fraction of the peak, `_q` reactive power as a
fraction of the one at the peak) and {generators} generation profiles (fraction of the rating). `t_s` counts
seconds from the first sample, which is at 00:00 local time.

`envelopes.csv` holds, for each load profile, the narrowest limits
`q_low p - q_floor <= q <= q_high p + q_floor` that hold every point of SimBench's whole year.

- Source: {versioned("simbench")}
- Made by: `gridsec convert profiles data/profiles`

## Licence

{ODBL.format(this="This folder")}
"""


@dataclass(frozen=True, slots=True, eq=False)
class Origin:
    """Origin of a converted feeder."""

    source: str  # The source, with the package that has or reads it; empty if unknown
    # Comparison of the feeder's AC power flow with the source's, or the reason for a missing one; empty if
    # unknown
    check: str
    # Omissions, approximations, additions and changes; one row each, as in conversion.csv
    changes: pd.DataFrame
    # Description of the network, and the command line of the conversion; empty if unknown
    about: str = ""
    command: str = ""


def origin(path_or_name: Path | str) -> Origin | None:
    """Origin of a feeder, given by its folder or as a bundled feeder; None if it was not converted.

    Raises GridsecError if its conversion.csv is not from `feeders.convert.convert`.
    """
    folder = folder_of(path_or_name)
    if folder is None or not (folder / CHANGES_FILE).is_file():
        return None
    try:
        changes = pd.read_csv(folder / CHANGES_FILE, dtype=str, keep_default_na=False)
    except ValueError as error:
        raise GridsecError(f"{folder / CHANGES_FILE}: {error}", code="unreadable") from error
    if tuple(changes.columns) != COLUMNS:
        raise GridsecError(
            f"{folder / CHANGES_FILE}: expected the columns {', '.join(COLUMNS)}", code="unreadable"
        )
    told = folder / SOURCE_FILE
    text = told.read_text(encoding="utf-8", errors="replace") if told.is_file() else ""
    source = re.search(r"^- Source: `(.*)`(.*)$", text, re.MULTILINE)
    check = re.search(r"^## Checked\n\n(.*?)\n\n", text, re.MULTILINE | re.DOTALL)
    about = re.search(r"^# .*\n\n(.*?)\n\n- Source: ", text, re.DOTALL)
    command = re.search(r"^- Made by: `(.*)`$", text, re.MULTILINE)
    return Origin(
        "".join(source.groups()) if source else "",
        " ".join(check[1].split()) if check else "",
        changes,
        about[1] if about else "",
        command[1] if command else "",
    )
