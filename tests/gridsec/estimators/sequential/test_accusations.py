"""Honest meters stay unaccused: runs of `benchmarks.accusations` by situation and seed."""

from __future__ import annotations

import pytest

from benchmarks.accusations import Run, cell, run

# Seeds with an honest meter accused before its mend come first.
RUNS = [
    *(("majority", seed) for seed in (1, 2, 4, 14, 17, 18, 35, 47, 79, 128, 156, 185)),
    *(("phases-busbar", seed) for seed in (0, 33, 35, 36)),
    *(("phases-lateral", seed) for seed in (1, 18, 29, 77, 93)),
    *(("drift", seed) for seed in (4, 38)),
    *(("contiguous-low", seed) for seed in (0, 1, 2)),
    *(("false-power", seed) for seed in (0, 1, 2)),
]


@pytest.mark.canary(
    "majority-14",
    "phases-lateral-93",
    "contiguous-low-0",
    "false-power-1",
)
@pytest.mark.parametrize(("situation", "seed"), RUNS)
def test_no_honest_meter_is_accused(situation: str, seed: int) -> None:
    assert run(situation, seed).accused == ()


def test_a_run_is_its_situation_and_seed() -> None:
    def told(one: Run) -> tuple[object, ...]:
        return one.cell, one.decisions, one.manipulated, one.named, one.accused, one.ratio, one.clean_volt

    setting, size = cell("majority", 9)
    one = run("majority", 9)
    assert told(one) == told(run("majority", 9))
    assert one.cell.startswith(setting.feeder)
    assert one.cell.endswith(f"{size:g}")
    assert len(one.manipulated) == 4
    assert sum(one.decisions.values()) == 90
