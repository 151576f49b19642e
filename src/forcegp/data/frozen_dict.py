"""A dictionary that cannot change, so that a frozen value can hold mappings and still be written as JSON or pickled."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, NoReturn

from forcegp.errors import DatasetError


class FrozenDict(dict[str, Any]):
    """`dict` whose mutating methods raise TypeError. Being a dict, `json.dumps` and `dict(...)` take it as it is."""

    def _refuse(self, *_: object, **__: object) -> NoReturn:
        raise TypeError("this mapping belongs to a frozen value; change a copy: dict(mapping)")

    __setitem__ = __delitem__ = __ior__ = _refuse  # type: ignore[assignment]  # refuses whatever the arguments are
    clear = pop = popitem = setdefault = update = _refuse  # type: ignore[assignment]  # refuses whatever the arguments are

    def __reduce__(
        self,
    ) -> tuple[type[FrozenDict], tuple[dict[str, Any]]]:  # the default would fill through __setitem__
        return FrozenDict, (dict(self),)

    def copy(self) -> dict[str, Any]:
        """An ordinary dictionary with the same items."""
        return dict(self)


def frozen_json(metadata: Mapping[str, Any]) -> FrozenDict:
    """Copy of a JSON-able mapping, frozen at every level (lists become tuples).

    Raises DatasetError where JSON has no such value: arrays, NaN, keys that are not text.
    """
    try:
        _require_text_keys(metadata)
        plain = json.loads(json.dumps(metadata, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise DatasetError(
            f"metadata cannot be written as JSON: {error}. "
            "Allowed: text, finite numbers, True, False, None, and lists or mappings of them."
        ) from error
    return _freeze(plain)


def _require_text_keys(value: object) -> None:
    """json.dumps turns the key 1 into "1" without a word; the file would then differ from what was given."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            if not isinstance(key, str):
                raise TypeError(f"key {key!r} is not text")
            _require_text_keys(item)
    elif isinstance(value, list | tuple):
        for item in value:
            _require_text_keys(item)


def _freeze(value: Any) -> Any:
    if isinstance(value, dict):
        return FrozenDict({key: _freeze(item) for key, item in value.items()})
    if isinstance(value, list):
        return tuple(_freeze(item) for item in value)
    return value
