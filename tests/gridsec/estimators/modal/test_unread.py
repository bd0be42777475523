"""Accusations while the busbar's voltage is not read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gridsec.interface import Decision, Frame
from tests.gridsec.estimators.modal.streets import watch
from tests.gridsec.estimators.modal.test_gaps import LIAR, calm


@pytest.mark.canary("0.0013-30")
@pytest.mark.parametrize("back", [30, 999])
@pytest.mark.parametrize("size", [0.0013, 0.0015])
def test_a_busbar_that_moves_unread_acquits_nobody(size: float, back: int) -> None:
    """All residuals move with it, of liars as of everybody: that is no end of a manipulation."""

    def unread(frame: Frame) -> Frame:
        return replace(frame, v0_squared=np.nan)

    made, street, state = calm(4)
    state, _ = watch(street, made, 90, state=state, lies={LIAR: size})
    assert not state.front.trust.trusted[LIAR]
    state, _ = watch(street, made, 20, state=state, lies={LIAR: size}, change=unread)
    street.v0 *= 1.02
    said = []
    for k in range(130):
        change = unread if k < back else None
        state, [(_, verdict)] = watch(street, made, 1, state=state, lies={LIAR: size}, change=change)
        said.append(verdict.decision)
    assert Decision.CLEAN not in said
