"""Settings are refused in one line that names them; each has its help; those that shape the weights are fixed."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from gknet.cli.dataclass_options import attribute_texts
from gknet.errors import GknetError
from gknet.network.build import NETWORKS
from gknet.training.schedule import parse_stages
from gknet.training.settings import BOUNDS, MAY_CHANGE, TrainSettings


@pytest.mark.parametrize("budgets", [{}, {"minutes": 1, "epochs": 1}, {"samples": 9, "epochs": 1}])
def test_there_is_one_budget(budgets: dict[str, Any]) -> None:
    with pytest.raises(GknetError, match="--samples, --epochs or --minutes"):
        TrainSettings(**budgets)


@pytest.mark.parametrize("name", BOUNDS)
@pytest.mark.parametrize("value", [-1, math.nan, math.inf, -math.inf, 1e300])
def test_a_number_out_of_range_is_refused_by_its_name(name: str, value: float) -> None:
    budget: dict[str, Any] = {} if name in ("samples", "epochs", "minutes") else {"samples": 1}
    with pytest.raises(GknetError, match=f"^{name}: expected a number from"):
        TrainSettings(**{**budget, name: value})


def test_every_number_has_bounds_that_its_default_keeps() -> None:
    settings = TrainSettings(samples=1)
    numbers = {field.name for field in fields(settings) if "int" in str(field.type) or "float" in str(field.type)}
    assert numbers == set(BOUNDS)


@pytest.mark.parametrize("name", ["network", "graph", "loss", "optimizer", "device", "precision"])
def test_a_choice_that_is_none_is_refused_by_its_name(name: str) -> None:
    values: dict[str, Any] = {"samples": 1, name: "hourglass"}
    with pytest.raises(GknetError, match=rf"^{name}: expected one of .*, got 'hourglass'"):
        TrainSettings(**values)


def test_choices_that_a_network_does_not_have_are_refused() -> None:
    for network in ("hrnet-xs", "resunet", "locator"):
        with pytest.raises(GknetError, match="graph"):
            TrainSettings(network, "identity", epochs=1)
    with pytest.raises(GknetError, match="loss"):
        TrainSettings("locator", loss="squared", epochs=1)
    with pytest.raises(GknetError, match="cycles"):
        TrainSettings(epochs=1, cycles=0)
    assert TrainSettings("hrnet", epochs=1).chosen_loss == "squared"
    assert TrainSettings("hrnet", loss="likelihood", epochs=1).chosen_loss == "likelihood"


def test_every_setting_has_its_help_and_every_network_is_in_it() -> None:
    texts = attribute_texts(TrainSettings)
    assert list(texts) == [field.name for field in fields(TrainSettings)]
    assert all(texts.values())
    assert set(texts["network"].rstrip(".").replace(" or ", ", ").split(", ")) == set(NETWORKS)


def test_what_a_resumed_run_must_have_as_it_was() -> None:
    settings = TrainSettings(samples=1)
    assert set(settings.fixed) == {field.name for field in fields(TrainSettings)} - set(MAY_CHANGE)
    own = TrainSettings(samples=1, stages=NETWORKS["gknet-s"].stages, loss="likelihood", init=Path("a"))
    assert own.fixed == settings.fixed  # the defaults, spelled out
    assert parse_stages(settings.fixed["stages"]) == settings.input_stages
    for other in ({"stages": parse_stages("1:96:2")}, {"learning_rate": 1e-3}, {"val_frames": 3}, {"seed": 1}):
        changed: dict[str, Any] = {"samples": 1, **other}
        assert TrainSettings(**changed).fixed != settings.fixed
