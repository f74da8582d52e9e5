"""How jaxtyping's import hook checks the annotations of gknet in the tests."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype

CONFIGURATION = BeartypeConf(is_pep484_tower=True)
"""An int will do where a float is asked for, as for mypy."""


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Check arguments and result when a function has returned, not on entry.

    jaxtyping asks for two checkers, one of the arguments alone (its result is Any) and one of everything. Leaving the
    first out lets a function refuse bad input in its own words, which is what the tests of bad input look at.
    """
    if inspect.signature(function).return_annotation is Any:
        return function
    return beartype(function, conf=CONFIGURATION)
