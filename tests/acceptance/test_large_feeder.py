"""A large feeder fits into little memory, and the monitor names exactly those who lie there."""

from __future__ import annotations

import subprocess
import sys

import pytest

# 500 MB for 2 000 customers, of which 100 MB are the interpreter with its libraries, and the rest grows with
# the square: 200 MB for 1 000. And a tenth more for other versions of these libraries.
LIMIT_MB = 220.0


@pytest.mark.slow
def test_a_thousand_customers_of_whom_a_third_lies_fit_into_the_memory() -> None:
    """In a process of its own: the peak is that of the design, quiet minutes and the attack together."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.sequential_step", "--one", "1000"],
        capture_output=True,
        check=True,  # it fails unless exactly the liars are named
        text=True,
        timeout=300,
    )
    *_, peak = (float(cell) for cell in done.stdout.split())
    assert peak <= LIMIT_MB
