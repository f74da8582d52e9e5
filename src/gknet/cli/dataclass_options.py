"""Command-line options made from a frozen dataclass, so that a setting, its default and its help exist once."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, fields
from typing import Annotated, Any, get_type_hints

import typer

Parser = Callable[[str], object]
"""The text of an option -> the value of its field."""


def with_options(
    settings: type,
    names: Mapping[str, str] | None = None,
    parsers: Mapping[str, Parser] | None = None,
    skip: Sequence[str] = (),
    panel: str | None = None,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a typer command an option for each field of a dataclass.

    The command has one parameter annotated with the dataclass and gets it filled in; its other parameters are as typer
    knows them. Two decorators on one command serve two dataclasses.

    Args:
        settings: The dataclass. Its docstring has a Google-style "Attributes:" section; the text there is the help.
        names: Option names that are not the field's own, such as {"learning_rate": "--lr"}.
        parsers: Functions for fields that typer has no type for. The option is a text then, and left out it leaves
            the field's default.
        skip: Fields that get no option; they must have defaults.
        panel: The heading in the help under which the options stand.

    Returns:
        The decorator.
    """
    names, parsers = names or {}, parsers or {}
    chosen = [field for field in fields(settings) if field.name not in skip]
    texts, types = attribute_texts(settings), get_type_hints(settings)
    options = [
        _option(field, types[field.name], texts.get(field.name), names.get(field.name), field.name in parsers, panel)
        for field in chosen
    ]

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(command, eval_str=True).parameters.values()
        [target] = [parameter.name for parameter in own if parameter.annotation is settings]

        def run(**values: Any) -> None:
            given = {field.name: values.pop(field.name) for field in chosen}
            for name, parser in parsers.items():
                text = given.pop(name)
                if text is not None:
                    given[name] = parser(text)
            command(**values, **{target: settings(**given)})

        kept = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in own if p.name != target]
        signature = inspect.Signature([*kept, *options])
        run.__name__, run.__doc__ = command.__name__, command.__doc__
        run.__signature__ = signature  # type: ignore[attr-defined]
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in signature.parameters.values()}
        return run

    return decorate


def _option(
    field: Field[Any], kind: Any, text: str | None, name: str | None, is_parsed: bool, panel: str | None
) -> inspect.Parameter:
    default = field.default
    if is_parsed:
        kind, default = (str, MISSING) if default is MISSING else (str | None, None)
    option = typer.Option(*([name] if name else []), help=text, rich_help_panel=panel)
    return inspect.Parameter(
        field.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=inspect.Parameter.empty if default is MISSING else default,
        annotation=Annotated[kind, option],
    )


def attribute_texts(settings: type) -> dict[str, str]:
    """Each attribute's text in the "Attributes:" section of a Google-style docstring, lines joined."""
    texts: dict[str, str] = {}
    is_section, name = False, ""
    for line in inspect.cleandoc(settings.__doc__ or "").splitlines():
        depth = len(line) - len(line.lstrip())
        if depth == 0 and line:
            is_section = line == "Attributes:"
        elif is_section and depth == 4:
            name, _, text = line.strip().partition(":")
            texts[name] = text.strip()
        elif is_section and line:
            texts[name] += " " + line.strip()
    return texts
