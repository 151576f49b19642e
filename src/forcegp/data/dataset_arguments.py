"""Datasets as arguments: they come first, but for models and posteriors, and have the joints that are asked for."""

from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, ParamSpec, TypeVar, cast

from forcegp.data.dataset import Dataset
from forcegp.errors import InvalidInput, require_type

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def dataset_first(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """A function that refuses anything else as its first argument, which came second in version 0.2."""

    @wraps(function)
    def ordered(*given: Any, **named: Any) -> Result:
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
