"""Rehearsals of the sizes that `detectable` promises, on all cores or on a cluster."""

from __future__ import annotations

from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from feeders.load import from_tables
from feeders.schema import FeederTables
from feeders.studies.campaign_run import Here, Runner, versions
from feeders.studies.detectable import Detectable
from feeders.studies.journal import Journal, Progress
from feeders.studies.operating import SHARE
from feeders.studies.rehearsal import Rehearsal, rehearse

if TYPE_CHECKING:
    from feeders.load import Site

__all__ = ["rehearse_everywhere"]

PIECE = 1_000
"""Trials of a piece."""


def rehearse_everywhere(
    site: Site,
    found: Detectable,
    *,
    trials: int,
    seed: int = 0,
    share: float = SHARE,
    runner: Runner | None = None,
    piece: int = PIECE,
    journal: Path | None = None,
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
        "versions": versions(),
    }
    kept = Journal(journal, subject)
    sizes = [min(piece, trials - begin) for begin in range(0, trials, piece)]
    todo = [k for k in range(len(sizes)) if str(k) not in kept]
    done = trials - sum(sizes[k] for k in todo)
    if progress is not None:
        progress(done, trials)
    work = partial(_piece, site.tables, found, sizes, seed, share)
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
