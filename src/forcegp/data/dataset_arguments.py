"""Datasets as arguments: they have the joints that are asked for."""

from collections.abc import Sequence

from forcegp.data.dataset import Dataset
from forcegp.errors import InvalidInput, require_type


def require_rows(name: str, rows: object, joint_names: Sequence[str], whose: str, example: str = "") -> None:
    """Raise InvalidInput unless `rows` is a Dataset with these joints, which are those of `whose`."""
    own = require_type(name, rows, Dataset, example).joint_names
    if tuple(own) != tuple(joint_names):
        raise InvalidInput(
            f"the joints of {name} are {', '.join(own)}, those of {whose} {', '.join(joint_names)}; give data of the "
            "same robot, with its joints in the same order"
        )
