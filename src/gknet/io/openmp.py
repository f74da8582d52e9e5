"""How the threads of torch wait for each other. Import this before torch: its OpenMP reads the environment once.

libgomp's threads spin 300,000 times, some 10 ms, before they sleep. Beside other busy processes the spinning keeps the
very thread from running that it waits for: a training becomes many times slower. Sleeping at once, by the environment
variable OMP_WAIT_POLICY=PASSIVE, costs a quiet machine 20 to 40 %, so a short spin is kept.
"""

from __future__ import annotations

import os

SPIN_COUNT = "1000"

if not os.environ.keys() & {"GOMP_SPINCOUNT", "OMP_WAIT_POLICY"}:
    os.environ["GOMP_SPINCOUNT"] = SPIN_COUNT
