"""What a table of a configuration may hold, read from its models: for refusals that name what was meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from types import UnionType
from typing import Annotated, Any, Literal, Union, cast, get_args, get_origin

from pydantic import BaseModel

HOLDERS = (Annotated, Union, UnionType, list, tuple)


def models_at(of: object, loc: Sequence[str | int]) -> list[type[BaseModel]]:
    """The models of the table at `loc`: pydantic's place of an error, tags of unions and numbers of items included.

    `of` is a model, or a union of some.
    """
    models = list(_models(of))
    for part in loc:
        if isinstance(part, int):
            continue
        inside = [model.model_fields[part].annotation for model in models if part in model.model_fields]
        if inside:
            models = [model for annotation in inside for model in _models(annotation)]
        else:
            models = [model for model in models if part in kinds([model])]
    return models


def fields(models: Sequence[type[BaseModel]]) -> list[str]:
    """Names that any of these tables may have, in their order."""
    return list(dict.fromkeys(name for model in models for name in model.model_fields))


def kinds(models: Sequence[type[BaseModel]]) -> list[str]:
    """What `kind` may be in these tables."""
    tags = (model.model_fields["kind"].annotation for model in models if "kind" in model.model_fields)
    return [str(kind) for tag in tags if get_origin(tag) is Literal for kind in get_args(tag)]


def nearest(name: str, known: Sequence[str]) -> str | None:
    """The known name that is most like it, if any is."""
    return next(iter(difflib.get_close_matches(name, known, n=1)), None)


def paths(models: Sequence[type[BaseModel]], above: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The path of every field in these tables and the tables in them."""
    for model in models:
        for name, field in model.model_fields.items():
            yield (*above, name)
            yield from paths(list(_models(field.annotation)), (*above, name))


def _models(annotation: object) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(cast("type[Any]", annotation), BaseModel):
        yield annotation
    elif get_origin(annotation) in HOLDERS:
        for inner in get_args(annotation):
            yield from _models(inner)
