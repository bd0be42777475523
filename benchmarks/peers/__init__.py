"""Comparison with open tools: manipulated voltage meters found in one snapshot, and the time taken.

Everything runs on one thread, whatever the environment asks for: set here, before NumPy is loaded, and
handed on to every process that is started from here.
"""

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"
