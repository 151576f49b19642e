"""Datasets as arguments: they come first, but for models and posteriors, and have the joints that are asked for."""

import warnings
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, ParamSpec, TypeVar, cast

from forcegp.data.dataset import Dataset
from forcegp.errors import InvalidInput, require_type

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


def require_rows(name: str, rows: object, joint_names: Sequence[str], whose: str, example: str = "") -> None:
    """Raise InvalidInput unless `rows` is a Dataset with these joints, which are those of `whose`."""
    own = require_type(name, rows, Dataset, example).joint_names
    if tuple(own) != tuple(joint_names):
        raise InvalidInput(
            f"the joints of {name} are {', '.join(own)}, those of {whose} {', '.join(joint_names)}; give data of the "
            "same robot, with its joints in the same order"
        )
