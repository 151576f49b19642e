"""One order of arguments: the dataset first, then what it is looked at with. Models and posteriors come before it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar, cast

from forcegp.data.dataset import Dataset
from forcegp.errors import require_type

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def dataset_first(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """A function whose dataset came second in version 0.2: that order still works, with a FutureWarning."""

    @wraps(function)
    def ordered(*given: Any, **named: Any) -> Result:
        if len(given) > 1 and isinstance(given[1], Dataset) and not isinstance(given[0], Dataset):
            name = function.__name__
            warnings.warn(
                f"{name} takes the dataset first: {name}(dataset, ...); the other order will be removed",
                FutureWarning,
                stacklevel=2,
            )
            given = (given[1], given[0], *given[2:])
        require_type("dataset", given[0] if given else named.get("dataset"), Dataset)
        return cast(Any, function)(*given, **named)

    return ordered
