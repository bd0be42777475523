"""A feeder watched tick by tick, with one of `gridsec.families.decoders` to tell who lies."""

from __future__ import annotations

from dataclasses import replace

from gridsec.families.decoders import fewest
from gridsec.families.sets import check
from gridsec.plant import Plant
from gridsec.sequential import LoadDoubt, SequentialDesign, SequentialOptions
from gridsec.sequential import design as sequential_design
from gridsec.sequential.decoder import Decoder


def design(
    plant: Plant,
    decoder: Decoder,
    *,
    doubt: LoadDoubt,
    step_s: float,
    max_attacked: int,
    alarms_per_year: float = 1.0,
) -> SequentialDesign:
    """Prepare to watch a feeder with a decoder; `gridsec.sequential.init` and `step` run it.

    Parameters
    ----------
    plant
        What is watched.
    decoder
        From `gridsec.families.decoders`, or one's own.
    doubt
        How wrong the powers of the frames may be.
    step_s
        Expected interval between frames, s.
    max_attacked
        M, the largest number of accusations.
    alarms_per_year
        False alarms by chance in a year.

    Raises
    ------
    NotObservable, ValueError
        As `gridsec.sequential.design`.
    DesignInfeasible
        If no certificate holds, or the decoder would have to try too many sets.
    """
    options = SequentialOptions(alarms_per_year=alarms_per_year, scales_s=(0.0,), commission_s=0.0)
    made = sequential_design(plant, doubt=doubt, step_s=step_s, options=options, max_attacked=max_attacked)
    if decoder is fewest:
        check(plant.meters.size, max_attacked)
    return replace(made, decoder=decoder)
