"""Which of Mitsuba's variants runs here, and the modules that it brings."""

from __future__ import annotations

import functools
import importlib
import os
import subprocess
import sys
import warnings
from dataclasses import dataclass
from types import ModuleType

from gknet.errors import GknetError, MissingExtraError

VARIABLE = "GKNET_MITSUBA_VARIANT"

PROBE = """
import sys
import mitsuba as mi
mi.set_variant(sys.argv[1])
import numpy as np
parts = {"ball": {"type": "sphere"}, "sky": {"type": "constant"}, "integrator": {"type": "direct"}}
film = {"type": "hdrfilm", "width": 8, "height": 8}
scene = mi.load_dict({"type": "scene", "eye": {"type": "perspective", "film": film}, **parts})
assert np.isfinite(np.array(mi.render(scene, spp=1))).all()
"""


@dataclass(frozen=True)
class Engine:
    """Mitsuba and Dr.Jit with one variant set. Their types are made per variant at run time, so no checker knows them.

    scalar   the variant traces one ray after the other and has no arrays
    """

    mi: ModuleType
    dr: ModuleType
    scalar: bool


@functools.cache
def choose_variant() -> str:
    """Mitsuba's variant for this machine: $GKNET_MITSUBA_VARIANT, else LLVM when it works, else scalar_rgb.

    LLVM is tried in a process of its own, since a version that does not fit aborts the process.
    """
    chosen = os.environ.get(VARIABLE)
    if chosen:
        return chosen
    if variant_works("llvm_ad_rgb"):
        return "llvm_ad_rgb"
    warnings.warn(
        "rendering with scalar_rgb, many times slower: Mitsuba found no LLVM that works; "
        "install one (Debian, Ubuntu: apt install libllvm19 or libllvm15)",
        stacklevel=2,
    )
    return "scalar_rgb"


def variant_works(variant: str) -> bool:
    """Whether another process renders a small picture with it."""
    command = [sys.executable, "-c", PROBE, variant]
    try:
        return subprocess.run(command, capture_output=True, timeout=120, check=False).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


def load_engine(variant: str) -> Engine:
    """Mitsuba with `variant` set for this process; GknetError when it is unknown or cannot run."""
    try:
        mi, dr = importlib.import_module("mitsuba"), importlib.import_module("drjit")
    except ImportError as error:
        raise MissingExtraError("render", "mitsuba") from error
    known = [name for name in mi.variants() if name.endswith("_rgb")]
    if variant not in known:
        raise GknetError(f"variant: expected one of {', '.join(known)}, got '{variant}'")
    if mi.variant() != variant:
        try:
            mi.set_variant(variant)
        except (ImportError, RuntimeError) as error:
            raise GknetError(f"variant: Mitsuba cannot run '{variant}' here ({error}); try scalar_rgb") from error
    return Engine(mi, dr, variant.startswith("scalar"))
