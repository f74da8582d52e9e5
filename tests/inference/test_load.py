"""Estimators on disk: a path is a path, a name is a shipped model, and what does not fit together is refused."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.inference.decode import Decoding
from gknet.inference.keypoint_estimator import KeypointEstimator
from gknet.inference.load import load_estimator, shipped_folder, shipped_models
from gknet.io.spacecraft_file import spacecraft_toml
from gknet.spacecraft import Spacecraft

POINTS = np.random.default_rng(7).uniform(-1, 1, (14, 3)) * (3, 1, 1)
CRAFT = Spacecraft("probe", tuple(f"k{i}" for i in range(14)), POINTS, ((0, 1), (1, 2)), 6.5)
SHIPPED = pytest.mark.skipif(not shipped_models(), reason="no model is shipped with this checkout")


def write_model(folder: Path, kind: str, craft: Spacecraft = CRAFT, file: str | None = None) -> None:
    pytest.importorskip("onnx")
    from tests.inference.test_onnx_model import METADATA, write_pool

    folder.mkdir(exist_ok=True)
    metadata = METADATA | {
        "kind": kind,
        "input_size": 32,
        "floor_cells": 0.4,
        "spread_scale": 2.0,
        "pose_scale": 1.5,
        "spacecraft": spacecraft_toml(craft),
    }
    write_pool(folder / f"{file or kind}.onnx", json.dumps(metadata), 32, 5 if kind == "locator" else 14)


def test_a_folder_of_exported_networks(tmp_path: Path) -> None:
    write_model(tmp_path, "keypoints")
    estimator = load_estimator(tmp_path, threads=1)
    assert isinstance(estimator, KeypointEstimator)
    assert not estimator.has_locator
    assert estimator.spacecraft.name == "probe"
    assert estimator.settings.input_size == 32
    assert estimator.decoding == Decoding(floor_cells=0.4, spread_scale=2.0)
    assert estimator.pnp.covariance_scale == 1.5
    write_model(tmp_path, "locator")
    assert load_estimator(str(tmp_path), threads=1).has_locator


def test_files_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    write_model(tmp_path, "keypoints")
    write_model(tmp_path, "keypoints", file="locator")
    with pytest.raises(GknetError, match="kind 'locator'"):
        load_estimator(tmp_path)
    write_model(tmp_path, "locator", replace(CRAFT, name="other"))
    with pytest.raises(GknetError, match=r"locator\.onnx: expected a locator of probe, .* got one of other"):
        load_estimator(tmp_path)


def test_unknown_model_lists_what_exists(tmp_path: Path) -> None:
    with pytest.raises(GknetError, match="shipped model") as caught:
        load_estimator(tmp_path / "none")
    for name in shipped_models():
        assert name in str(caught.value)
    for nothing in ("", "\0"):
        with pytest.raises(GknetError, match="got no name"):
            load_estimator(nothing)
    with pytest.raises(GknetError, match="'none': expected a shipped model"):
        shipped_folder("none")


@SHIPPED
def test_a_name_is_a_shipped_model_and_a_path_never_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    name = shipped_models()[0]
    assert load_estimator(name, threads=1).spacecraft.name == name
    for path in (Path(name), f"./{name}", str(tmp_path / name)):
        with pytest.raises(GknetError, match=r"or a folder with keypoints\.onnx"):
            load_estimator(path)
    write_model(tmp_path / name, "keypoints")
    for path in (Path(name), f"./{name}", str(tmp_path / name)):
        assert load_estimator(path, threads=1).spacecraft.name == "probe"
    assert load_estimator(shipped_folder(name), threads=1).spacecraft.name == name


@SHIPPED
def test_a_name_that_is_a_folder_too_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even when it is empty: the user may have meant it."""
    monkeypatch.chdir(tmp_path)
    name = shipped_models()[0]
    (tmp_path / name).mkdir()
    with pytest.raises(GknetError, match="a shipped model and a folder here both have this name"):
        load_estimator(name)


@SHIPPED
def test_a_locator_of_another_shipped_spacecraft_is_refused(tmp_path: Path) -> None:
    first, second = shipped_models()[:2]
    shutil.copy(shipped_folder(first) / "keypoints.onnx", tmp_path)
    shutil.copy(shipped_folder(second) / "locator.onnx", tmp_path)
    with pytest.raises(GknetError, match=f"expected a locator of {first}"):
        load_estimator(tmp_path, threads=1)
