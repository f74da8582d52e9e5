"""constraints.txt pins every package that the two make targets install."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PINNED_BY_TORCH = ("nvidia-", "cuda-", "triton")
"""What a CUDA build of torch brings, each in a release that torch itself names."""


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pairs = (line.split("==", 1) for line in lines if line and not line.startswith("#"))
    return {canonical(name): release for name, release in pairs}


def needed(extras: tuple[str, ...]) -> set[str]:
    """gknet's requirements with these extras, and all that they need here."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    texts = [*project["dependencies"], *(text for extra in extras for text in project["optional-dependencies"][extra])]
    pending, found = [Requirement(text) for text in texts], set()
    while pending:
        requirement = pending.pop()
        name = canonical(requirement.name)
        if name in found:
            continue
        found.add(name)
        try:
            further = [Requirement(text) for text in requires(name) or []]
        except PackageNotFoundError:
            continue
        wanted: list[str] = [*requirement.extras, ""]
        for each in further:
            if each.marker is None or any(each.marker.evaluate({"extra": e}) for e in wanted):
                pending.append(each)
    return found


@pytest.mark.parametrize("extras", [(), ("render", "train", "docs", "dev")], ids=["make demo", "make test"])
def test_every_package_is_pinned(extras: tuple[str, ...]) -> None:
    missing = needed(extras) - set(pins()) - {"setuptools"}
    assert {name for name in missing if not name.startswith(PINNED_BY_TORCH)} == set()


def test_the_tests_run_with_the_pinned_releases() -> None:
    other = {}
    for name, release in pins().items():
        try:
            installed = version(name).split("+")[0]
        except PackageNotFoundError:
            continue
        if installed != release:
            other[name] = f"{installed}, pinned {release}"
    assert other == {}
