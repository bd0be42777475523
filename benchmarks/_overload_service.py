"""The service of `benchmarks.overload`, as a process of its own: rounds and the keeping of states are timed.

    python benchmarks/_overload_service.py TOTALS OPTION...

OPTION are those of `gridsec serve`. On SIGUSR1 the processor time of the judging thread since the start is
written to the file TOTALS as JSON, {"cycle": s, "keep_states": s}. The program is run by its path, so that
PYTHONPATH chooses the source tree under test.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def timed(totals: dict[str, float], name: str, run: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that adds its processor time to a total.

    Parameters
    ----------
    totals, name
        Processor time by name, s.
    run
        The function.
    """

    def measured(*arguments: Any, **options: Any) -> Any:
        begun = time.thread_time()
        try:
            return run(*arguments, **options)
        finally:
            totals[name] += time.thread_time() - begun

    return measured


def main() -> None:
    """Run the service."""
    # The folder of this file has names of installed packages.
    sys.path.remove(str(Path(__file__).parent))
    from service.cli.main import main as gridsec
    from service.engine.engine import Engine

    path, totals = Path(sys.argv[1]), {"cycle": 0.0, "keep_states": 0.0}
    for name in totals:
        setattr(Engine, name, timed(totals, name, getattr(Engine, name)))

    def write(*_: object) -> None:
        part = path.with_suffix(".part")
        part.write_text(json.dumps(totals))
        part.rename(path)

    signal.signal(signal.SIGUSR1, write)
    sys.argv = ["gridsec", "serve", *sys.argv[2:]]
    gridsec()


if __name__ == "__main__":
    main()
