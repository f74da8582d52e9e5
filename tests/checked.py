"""How jaxtyping's import hook checks the annotations of gknet in the tests."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, get_args

from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray

CONFIGURATION = BeartypeConf(is_pep484_tower=True)
"""An int will do where a float is asked for, as for mypy."""


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Check what has an array in its signature, arguments and result, when it has returned and not on entry.

    jaxtyping asks for two checkers, one of the arguments alone (its result is Any) and one of everything. Leaving the
    first out lets a function refuse bad input in its own words, which is what the tests of bad input look at.
    """
    signature = inspect.signature(function)
    annotations = [parameter.annotation for parameter in signature.parameters.values()]
    if signature.return_annotation is Any or not any(map(has_array, [*annotations, signature.return_annotation])):
        return function
    return beartype(conf=CONFIGURATION)(function)


def has_array(annotation: object) -> bool:
    """Whether a shape such as Float[ndarray, "n 2"] is part of the annotation."""
    if isinstance(annotation, type) and issubclass(annotation, AbstractArray):
        return True
    return any(map(has_array, get_args(annotation)))
