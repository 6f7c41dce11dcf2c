"""`python -m pipelines`; see `pipelines.cli`."""

from __future__ import annotations

import os
import sys

# Read by OpenMP as it is loaded. Threads that wait in a loop for the next operation take a core
# from whatever else runs: on 2 cores, a few short runs each, training was about 1.2 times faster
# without on a quiet machine and 2 to 3.5 times in two of three tries beside other busy processes.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from pipelines.cli import main

if __name__ == "__main__":
    sys.exit(main())
