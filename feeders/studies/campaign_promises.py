"""The sizes that `detectable` promises: as lies of a campaign, and rehearsed on all cores or on a cluster."""

from __future__ import annotations

from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from feeders.lies import Trick
from feeders.load import from_tables
from feeders.schema import FeederTables
from feeders.studies.campaign_plan import Kind, Promise
from feeders.studies.campaign_run import Here, Runner
from feeders.studies.detectable import Detectable, monitor_rule
from feeders.studies.journal import Journal, Progress, Where
from feeders.studies.operating import SHARE, volts_of_lie
from feeders.studies.rehearsal import Rehearsal, rehearse
from gridsec.studies.quiet import largest_shift

if TYPE_CHECKING:
    from feeders.load import Site

__all__ = ["promised", "rehearse_everywhere"]

PIECE = 1_000
"""Trials of a piece."""

HIDDEN, NAMED = (0.5, 1.0), (1.0, 1.2)
"""Factors on the sizes up to which lies stay hidden, and beyond which liars are named."""

NOTHING = 1e-6
"""What a solver leaves where nobody lies, V."""


def promised(site: Site, found: Detectable, *, share: float = SHARE) -> tuple[Kind, ...]:
    """Lies of the sizes that `detectable` found, in a campaign.

    Parameters
    ----------
    site
        The feeder, as stated: with the campaign's errors of loads and meters.
    found
        What was found for it.
    share
        As `found` was made with.

    Returns
    -------
    hidden_alone, hidden
        One meter, and M of them in the worst collusion of this size; nobody is to be named.
    named_alone, named
        One meter, and any M of them, each by its size; all are to be named.

    Notes
    -----
    For M = 1 there are only those alone, and where no lie stays hidden for sure there are none of these.
    """
    most, alone = found.max_attacked, (1,)
    kinds = [
        Kind("hidden_alone", Trick.BIAS, HIDDEN, _volts(found, "hidden_alone"), (), alone, Promise.HIDDEN),
        Kind("named_alone", Trick.BIAS, NAMED, _volts(found, "named_alone"), (), alone, Promise.NAMED),
    ]
    if most > 1:
        worst = _collusions(site, found, share)
        kinds += [
            Kind("hidden", Trick.BIAS, HIDDEN, (), worst, (most,), Promise.HIDDEN),
            Kind("named", Trick.BIAS, NAMED, _volts(found, "named"), (), (most,), Promise.NAMED),
        ]
    return tuple(kind for kind in kinds if any(kind.volts) or kind.together)


def _volts(found: Detectable, column: str) -> tuple[float, ...]:
    return tuple(float(volt) for volt in found.meters[column])


def _collusions(site: Site, found: Detectable, share: float) -> tuple[tuple[float, ...], ...]:
    """Lies of all meters, V: for each of them the worst that stay hidden although it takes part."""
    rule, p = monitor_rule(site, risk=found.risk, share=share), site.meters.size
    worst = [largest_shift(rule, np.eye(p)[j], found.max_attacked, seen=False, must=j).lies for j in range(p)]
    base = site.customer_volt[site.meters]
    volts = [np.sign(lies) * volts_of_lie(base, np.abs(lies)) for lies in worst]
    volts = [np.where(np.abs(row) > NOTHING, row, 0.0) for row in volts]
    return tuple(tuple(row.tolist()) for row in volts if row.any())


def rehearse_everywhere(
    site: Site,
    found: Detectable,
    *,
    trials: int,
    seed: int = 0,
    share: float = SHARE,
    runner: Runner | None = None,
    piece: int = PIECE,
    journal: Where = None,
    progress: Progress | None = None,
) -> Rehearsal:
    """As `rehearsal.rehearse`, in pieces that are worked on anywhere.

    Parameters
    ----------
    site, found, trials, share
        As `rehearse`.
    seed
        Chooses everything random; piece k has the seed `seed + k piece` of its own.
    runner
        Where; see `campaign_run`.
    piece
        Trials of a piece.
    journal
        File in which finished pieces are kept.
    progress
        Told how many trials are done.

    Raises
    ------
    OtherStudy
        If the journal is another study's.
    InUse
        If another process is writing it.
    ClusterUnusable, WorkerLost
        From the runner; what is finished is in the journal.
    """
    subject = {
        "study": "rehearsal",
        "digest": site.digest,
        "found": {"max_attacked": found.max_attacked, "risk": found.risk},
        "trials": [trials, piece],
        "seed": seed,
        "share": share,
    }
    sizes = [min(piece, trials - begin) for begin in range(0, trials, piece)]
    work = partial(_piece, site.tables, found, sizes, seed, share)
    with Journal(journal, subject, of=len(sizes)) as kept:
        todo = [k for k in range(len(sizes)) if str(k) not in kept]
        done = trials - sum(sizes[k] for k in todo)
        if progress is not None:
            progress(done, trials)
        with closing((runner or Here()).run(work, todo)) as results:
            for k, counted in results:
                kept.put(str(k), counted)
                done += sizes[k]
                if progress is not None:
                    progress(done, trials)
        counts = [kept[str(k)] for k in range(len(sizes))]
    return Rehearsal(trials, *(sum(each[i] for each in counts) for i in range(3)))


def _piece(  # noqa: PLR0917  # all that a worker needs
    tables: FeederTables, found: Detectable, sizes: list[int], seed: int, share: float, k: int
) -> list[int]:
    begin = sum(sizes[:k])
    seen = rehearse(from_tables(tables), found, trials=sizes[k], seed=seed + begin, share=share)
    return [seen.hidden_named, seen.large_missed, seen.honest_named]
