"""Where droop fleets cease to be stable: the largest size that is proven, the smallest that is unstable.

python -m benchmarks.droop_edge cigre-lv kerber-landnetz

Category B inverters at all customers of a feeder, a third of load and generation, the busbar at 1.05 pu; all
inverters are made larger by a common factor.
"""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks._arguments import arguments
from feeders.model.site import load
from feeders.studies.droop.fleets import Equipped, equip, point
from feeders.studies.droop.verdict import Subject, edge
from gridsec.planning.droop.stability import Update, enlarged

UPDATES = (Update(60.0), Update(60.0, 2), Update(1.0), Update(1.0, 1))


def main(feeders: Sequence[str]) -> None:
    """Print a row for each feeder and kind of update.

    Parameters
    ----------
    feeders
        Names or folders.
    """
    print("feeder, interval s, dead: proven, unstable, ratio")
    for name in feeders:
        site = load(name)
        subject, fleet, at = (
            Subject.of(site),
            equip(site, "ieee1547-b", Equipped.ALL),
            point(site, 0.3, 0.3, 1.05),
        )
        for update in UPDATES:
            sure, over = edge(subject, fleet, update, at, enlarged)
            print(f"{name}, {update.interval_s:g}, {update.dead}: {sure:.3g}, {over:.3g}, {over / sure:.3g}")


if __name__ == "__main__":
    main(arguments(__doc__, feeders=("cigre-lv",)).feeders)
