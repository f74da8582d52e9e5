"""The list of networks is consistent with what it builds, and light to read."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from gknet.errors import GknetError
from gknet.network.build import NETWORKS, build, spec_of
from gknet.network.direct_pose import DirectNetwork
from gknet.network.heatmap import HeatmapNetwork
from gknet.network.locator import Locator
from gknet.network.spec import NetworkSpec, Stage
from tests.network.tiny import chain, points

CLASSES = {"keypoints": HeatmapNetwork, "direct": DirectNetwork, "locator": Locator}


@pytest.mark.parametrize("name", list(NETWORKS))
def test_an_entry_is_what_its_builder_makes(name: str) -> None:
    spec = NETWORKS[name]
    with torch.device("meta"):
        network = build(name, chain(6), points(6))
    assert isinstance(network, CLASSES[spec.kind])
    assert (network.stride is None) == (spec.kind == "direct")
    assert spec.kind != "direct" or network.attitude_bins is not None
    assert (spec.loss is None) == (spec.kind != "keypoints")
    if isinstance(network, HeatmapNetwork):
        assert network.loss == spec.loss
        assert network.two_pass <= spec.has_graph
    assert sum(stage.share for stage in spec.stages) == pytest.approx(1)


def test_reading_the_list_loads_no_torch() -> None:
    code = "import sys, gknet.network.build; print('torch' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "False"


def test_what_does_not_fit_is_refused() -> None:
    stages = (Stage(1.0, 64, 4),)
    for kind, loss in (("keypoints", None), ("direct", "likelihood"), ("locator", "squared")):
        with pytest.raises(GknetError, match="expected a loss of a keypoint network alone"):
            NetworkSpec(kind, NETWORKS["locator"].builder, stages, loss)  # type: ignore[arg-type]
    with pytest.raises(GknetError, match="expected one of gknet-s, "):
        spec_of("hourglass")
    for share, size, batch in ((0, 64, 4), (1.5, 64, 4), (np.nan, 64, 4), (1, 65, 4), (1, 0, 4), (1, 64, 0)):
        with pytest.raises(GknetError, match="stage"):
            Stage(share, size, batch)
