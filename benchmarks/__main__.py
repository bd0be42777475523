"""Run all benchmarks, each in a process of its own: `python -m benchmarks [name ...]`.

Exits 1 if one of them misses a limit it states. Figures move from machine to machine; the ratios that
are printed beside them move less.
"""

from __future__ import annotations

import os
import pkgutil
import subprocess
import sys
from pathlib import Path


def names() -> list[str]:
    """All benchmarks of this package."""
    found = pkgutil.iter_modules([str(Path(__file__).parent)])
    return sorted(module.name for module in found if not module.name.startswith("_"))


def main(wanted: list[str]) -> int:
    """Run those that are wanted, all by default."""
    unknown = sorted(set(wanted) - set(names()))
    if unknown:
        print(f"no benchmark {', '.join(unknown)}; there are {', '.join(names())}", file=sys.stderr)
        return 2
    threads = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    missed = []
    for name in wanted or names():
        print(f"--- {name}", flush=True)
        done = subprocess.run(
            [sys.executable, "-m", f"benchmarks.{name}"], env={**os.environ, **threads}, check=False
        )
        if done.returncode:
            missed.append(name)
        print(flush=True)
    if missed:
        print(f"missed: {', '.join(missed)}")
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
