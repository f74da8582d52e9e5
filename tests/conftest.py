"""Shape annotations are checked in every test: jaxtyping's import hook goes in before gknet is first imported."""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "2")

from hypothesis import settings
from jaxtyping import install_import_hook

import tests.checked  # noqa: F401  (the hook finds it by name)

install_import_hook("gknet", "tests.checked.checked")

import gknet.io.openmp  # noqa: E402, F401  (before a test imports torch)

settings.register_profile("gknet", deadline=None, max_examples=50, derandomize=True)
settings.load_profile("gknet")
