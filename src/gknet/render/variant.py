"""Which of Mitsuba's variants runs here, and the modules that it brings.

Dr.Jit, Mitsuba's compiler, keeps compiled kernels in `$HOME/.drjit`. It aborts the process where it cannot make that
folder, when HOME is unset or read-only as in containers and on cluster nodes. So it starts with a HOME that works.
"""

from __future__ import annotations

import functools
import importlib
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
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

    Attributes:
        mi: The module mitsuba.
        dr: The module drjit.
        scalar: Whether the variant traces one ray after the other and has no arrays.
    """

    mi: ModuleType
    dr: ModuleType
    scalar: bool


@functools.cache
def choose_variant() -> str:
    """Mitsuba's variant for this machine: $GKNET_MITSUBA_VARIANT, else LLVM when it works, else scalar_rgb.

    LLVM is tried in a process of its own, since a version that does not fit aborts the process.

    Raises:
        GknetError: Dr.Jit has no folder for its kernels.
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
    """Whether another process renders a small image with it."""
    command = [sys.executable, "-c", PROBE, variant]
    environment = {**os.environ, "HOME": str(drjit_home())}
    try:
        return subprocess.run(command, capture_output=True, timeout=120, check=False, env=environment).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


def load_engine(variant: str) -> Engine:
    """Mitsuba with a variant set for this process.

    Args:
        variant: One of Mitsuba's RGB variants, such as llvm_ad_rgb.

    Raises:
        GknetError: The variant is unknown or cannot run, or Dr.Jit has no folder for its kernels.
        MissingExtraError: Mitsuba is not installed.
    """
    mi, dr = _modules()
    known = [name for name in mi.variants() if name.endswith("_rgb")]
    if variant not in known:
        raise GknetError(f"variant: expected one of {', '.join(known)}, got '{variant}'")
    if mi.variant() != variant:
        try:
            with _working_home():
                mi.set_variant(variant)
        except (ImportError, RuntimeError) as error:
            raise GknetError(f"variant: Mitsuba cannot run '{variant}' here ({error}); try scalar_rgb") from error
    return Engine(mi, dr, variant.startswith("scalar"))


@functools.cache
def _modules() -> tuple[ModuleType, ModuleType]:
    try:
        with _working_home():
            return importlib.import_module("mitsuba"), importlib.import_module("drjit")
    except ImportError as error:
        raise MissingExtraError("render", "mitsuba") from error


@contextmanager
def _working_home() -> Iterator[None]:
    """HOME as Dr.Jit needs it while it starts; it reads the variable only then."""
    before, working = os.environ.get("HOME"), str(drjit_home())
    os.environ["HOME"] = working
    try:
        yield
    finally:
        if before is None:
            del os.environ["HOME"]
        else:
            os.environ["HOME"] = before


@functools.cache
def drjit_home() -> Path:
    """The folder whose sub-folder `.drjit` takes Dr.Jit's kernels: $HOME where it works, else a cache folder.

    Raises:
        GknetError: None of them can be written.
    """
    home, cache = os.environ.get("HOME"), os.environ.get("XDG_CACHE_HOME")
    candidates = [Path(home)] if home and Path(home).is_dir() else []
    candidates += [Path(cache) / "gknet"] if cache else []
    candidates.append(Path(tempfile.gettempdir()) / f"gknet-{_user()}")
    for folder in candidates:
        if _takes_kernels(folder):
            return folder
    tried = ", ".join(str(folder / ".drjit") for folder in candidates)
    raise GknetError(f"Dr.Jit: no folder for its compiled kernels can be written ({tried}); set HOME to one that can")


def _user() -> int:
    return os.getuid() if hasattr(os, "getuid") else 0


def _takes_kernels(folder: Path) -> bool:
    """Whether `.drjit` in the folder can be written, and both are this user's own: kernels are code that runs."""
    kernels = folder / ".drjit"
    try:
        for each in (folder, kernels):
            each.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=kernels):
            return all(each.stat().st_uid == _user() for each in (folder, kernels))
    except OSError:
        return False
