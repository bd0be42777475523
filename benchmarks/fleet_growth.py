"""Processor time of a reading against the number of meters of one process, with its parts, and a plot.

    python -m benchmarks.fleet_growth [PICTURE] [SECONDS] [MOST]

Feeders of `benchmarks.fleet` with one reading per second of each meter, as single JSON and as batches in
Arrow. The number of feeders grows by the factor `GROWTH` up to MOST. For each number: processor time of the
service for a reading, the part in zenoh's threads, and the estimator's step, measured beside it without
zenoh. A fleet that is not held ends its row. PICTURE is a file for the plot.
"""

from __future__ import annotations

import sys
import tempfile
from math import nan
from pathlib import Path

from benchmarks._arguments import arguments
from benchmarks.fleet import FEEDER, Held, holds, stages
from feeders.model.site import load

GROWTH = 3
"""Factor between two numbers of feeders."""
FORMS = {"json": "single JSON", "arrow": "batches in Arrow"}


def main() -> int:
    """Measure, print a table, and draw it."""
    asked = arguments(__doc__, picture="", seconds=20.0, most=270)
    site = load(FEEDER)
    meters = len(site.meter_ids)
    step_us = 1e6 * stages(site, "arrow")["step"] / (meters + 1)
    print(f"step of the estimator: {step_us:.1f} us for a reading\n", flush=True)
    print("| readings | meters | held | processor time of a reading, us | zenoh's threads | others |")
    print("|---|---|---|---|---|---|", flush=True)
    found: dict[str, list[tuple[int, Held]]] = {form: [] for form in FORMS}
    with tempfile.TemporaryDirectory() as folder:
        for form, title in FORMS.items():
            number = 1
            while number <= asked.most:
                one = holds(site, Path(folder), number, form, seconds=asked.seconds)
                found[form].append((number * meters, one))
                zenoh_us, cost_us = 1e6 * one.zenoh_s, 1e6 * one.cost_s
                cells = f"{cost_us:.1f} | {zenoh_us:.1f} | {cost_us - zenoh_us:.1f}"
                print(f"| {title} | {number * meters} | {one.held} | {cells} |", flush=True)
                if not one.held:
                    break
                number = asked.most if number < asked.most < GROWTH * number else GROWTH * number
    if asked.picture:
        _draw(asked.picture, found, step_us)
    return 0


def _draw(picture: str, found: dict[str, list[tuple[int, Held]]], step_us: float) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for (form, rows), color in zip(found.items(), ("tab:blue", "tab:orange"), strict=True):
        held = [(meters, one) for meters, one in rows if one.held]
        meters = [each for each, _ in held]
        cost_us, zenoh_us = ([1e6 * getattr(one, of) for _, one in held] for of in ("cost_s", "zenoh_s"))
        axes.loglog(meters, cost_us, "-o", color=color, label=FORMS[form])
        # A time below the clock's resolution has no place on the axis.
        shown = [each or nan for each in zenoh_us]
        axes.loglog(meters, shown, "--", color=color, label="of it zenoh's threads")
    axes.axhline(step_us, color="gray", linestyle=":", label="step of the estimator")
    axes.set_xlabel("meters at one reading per second")
    axes.set_ylabel("processor time of a reading, us")
    axes.grid(visible=True, which="both", alpha=0.3)
    axes.legend(fontsize="small")
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    sys.exit(main())
