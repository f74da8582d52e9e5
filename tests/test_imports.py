"""Imports run one way, downward, and the runtime is light."""

from __future__ import annotations

import ast
import subprocess
import sys
import time
from pathlib import Path

import pytest

import gknet

SOURCE = Path(__file__).parents[1] / "src" / "gknet"

LAYERS = (
    {"errors"},
    {"geometry", "spacecraft"},
    {"frame"},
    {"io"},
    {"dataset", "fleet", "inference"},
    {"network"},
    {"evaluation"},
    {"report"},
    {"predict", "render", "training"},
    {"cli"},
)
"""A room imports from the lines above its own, never from its neighbours nor from below."""

RANK = {room: rank for rank, rooms in enumerate(LAYERS) for room in rooms}
HEAVY = {
    *("torch", "lightning_fabric", "lightning", "safetensors", "tensorboard", "onnx", "onnxscript"),
    *("mitsuba", "drjit", "trimesh", "manifold3d", "shapely", "mapbox_earcut", "PIL", "mpl_toolkits", "matplotlib"),
}
MAY_BE_HEAVY = {"fleet", "render", "network", "training"}
NETWORK_MAY_KNOW = {"errors", "inference"}
NETWORK_MAY_KNOW_OF_INFERENCE = {"gknet.inference.attitude"}
FACE = "__init__"


def files() -> list[Path]:
    return sorted(SOURCE.rglob("*.py"))


def room_of(path: Path) -> str:
    """The top-level name that a source file belongs to."""
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def modules_named(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        assert node.level == 0, "imports are absolute"
        module = node.module or ""
        return [f"{module}.{alias.name}" for alias in node.names] if module == "gknet" else [module]
    return []


def for_types_only(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")


def imported(path: Path, on_loading: bool) -> set[str]:
    """Dotted modules that a file imports: those it loads when it is imported itself, or all that it ever names."""
    found: set[str] = set()
    pending: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while pending:
        node = pending.pop()
        found.update(modules_named(node))
        if on_loading and (for_types_only(node) or isinstance(node, ast.FunctionDef)):
            continue
        pending.extend(ast.iter_child_nodes(node))
    return found


def rooms_imported(path: Path) -> set[str]:
    dotted = (module.split(".") for module in imported(path, on_loading=False))
    return {parts[1] for parts in dotted if parts[0] == "gknet" and len(parts) > 1 and not parts[1].startswith("__")}


def test_every_room_has_its_layer() -> None:
    assert {room_of(path) for path in files()} - set(RANK) == {FACE}


@pytest.mark.parametrize("path", files(), ids=lambda path: str(path.relative_to(SOURCE)))
def test_imports_run_downward(path: Path) -> None:
    room = room_of(path)
    if room == FACE:
        return
    wrong = {other for other in rooms_imported(path) - {room} if RANK.get(other, len(LAYERS)) >= RANK[room]}
    assert not wrong, f"{path.name} of {room} must not import {sorted(wrong)}"


@pytest.mark.parametrize("path", [p for p in files() if room_of(p) == "network"], ids=lambda path: path.name)
def test_networks_know_no_frames(path: Path) -> None:
    may_know = {"io"} if path.stem == FACE else NETWORK_MAY_KNOW | {"network"}  # the face sets up torch's threads
    assert rooms_imported(path) <= may_know
    of_inference = {name for name in imported(path, on_loading=False) if name.startswith("gknet.inference")}
    assert of_inference <= NETWORK_MAY_KNOW_OF_INFERENCE


@pytest.mark.parametrize("path", [p for p in files() if room_of(p) not in MAY_BE_HEAVY], ids=lambda p: p.name)
def test_runtime_imports_nothing_heavy(path: Path) -> None:
    heavy = {module.split(".")[0] for module in imported(path, on_loading=True)} & HEAVY
    assert not heavy, f"{path.name} imports {sorted(heavy)} at module level"


def test_onnxruntime_is_imported_in_one_place() -> None:
    """There it is kept from the network, and its threads from spinning."""
    places = [path.name for path in files() if "onnxruntime" in imported(path, on_loading=False)]
    assert places == ["onnx_session.py"]


def loaded_by(code: str) -> set[str]:
    """The top-level modules in a fresh process after `code`."""
    script = f"import sys\n{code}\nprint('MODULES', *{{name.split('.')[0] for name in sys.modules}})"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(run.stdout.split("MODULES", 1)[1].split())


def test_the_package_alone_loads_no_library() -> None:
    assert not loaded_by("import gknet") & (HEAVY | {"cv2", "numpy", "onnxruntime", "poselib", "pydantic", "scipy"})


@pytest.mark.parametrize(
    "code",
    [
        "import gknet\nfor name in gknet.__all__: getattr(gknet, name)",
        "import gknet.evaluation.evaluate, gknet.fleet, gknet.predict.results, gknet.report.page",
        "import gknet.cli.main as m\nsys.argv = ['gknet', '--help']\ntry:\n    m.main()\nexcept SystemExit: pass",
    ],
    ids=["every name", "the runtime", "gknet --help"],
)
def test_light_things_load_nothing_heavy(code: str) -> None:
    assert not loaded_by(code) & HEAVY


def test_every_name_is_there() -> None:
    for name in gknet.__all__:
        assert getattr(gknet, name).__name__ == name
        assert name in dir(gknet)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = gknet.nothing


def seconds_to(code: str) -> float:
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True)
    return time.perf_counter() - start


def test_import_is_fast() -> None:
    """Best of three against an empty process: 0.5 s is promised; a busy machine is given 1.5 s."""
    best = min(seconds_to("import gknet") for _ in range(3)) - min(seconds_to("pass") for _ in range(3))
    print(f"import gknet: {best:.2f} s")
    assert best < 1.5
