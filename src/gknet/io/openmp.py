"""How the threads of torch wait for each other. Import this before torch: its OpenMP reads the environment once.

libgomp's threads spin 300,000 times, some 10 ms, before they sleep. Beside other busy processes the spinning keeps the
very thread from running that it waits for: a training becomes several times slower. A spin of 10,000 takes most of that
away and costs a quiet machine nothing; a spin of 1,000 costs it a tenth, and sleeping at once, by the environment
variable OMP_WAIT_POLICY=PASSIVE, 20 to 40 %.
"""

from __future__ import annotations

import os

SPIN_COUNT = "10000"

if not os.environ.keys() & {"GOMP_SPINCOUNT", "OMP_WAIT_POLICY"}:
    os.environ["GOMP_SPINCOUNT"] = SPIN_COUNT
