"""Tick-by-tick estimator with one of `gridsec.families.decoders` as identification step."""

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
    """Design with a decoder; `gridsec.sequential.init` and `step` run it.

    Parameters
    ----------
    decoder
        From `gridsec.families.decoders`, or a custom one.
    doubt
        Uncertainty of the powers of the frames.
    step_s
        Expected interval between frames, s.
    max_attacked
        M, the largest number of accusations.
    alarms_per_year
        Expected false alarms per year.

    Raises
    ------
    NotObservable, ValueError
        As `gridsec.sequential.design`.
    DesignInfeasible
        If no certificate holds, or the decoder has too many sets to try.
    """
    options = SequentialOptions(alarms_per_year=alarms_per_year, scales_s=(0.0,), commission_s=0.0)
    made = sequential_design(plant, doubt=doubt, step_s=step_s, options=options, max_attacked=max_attacked)
    if decoder is fewest:
        check(plant.meters.size, max_attacked)
    return replace(made, decoder=decoder)
