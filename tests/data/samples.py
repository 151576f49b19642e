"""Small valid Datasets for the tests."""

import numpy as np

from forcegp.data import Dataset
from forcegp.model import Model
from forcegp.robots import Robot

NAMES = ("shoulder", "elbow")
LINK = """<link name="{}">
  <inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""

TWO_JOINTS = """<robot name="slider">
  <link name="base"/>{one}{two}
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="one"/><axis xyz="0 0 1"/></joint>
  <joint name="elbow" type="{elbow}"><parent link="one"/><child link="two"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>"""


def model(elbow: str = "revolute") -> Model:
    """A robot with the joints `NAMES`, the second one revolute or prismatic, that touches nothing."""
    return Model(Robot.from_urdf_text(TWO_JOINTS.format(one=LINK.format("one"), two=LINK.format("two"), elbow=elbow)))


def columns(rows: int = 40, nv: int = 2, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {name: 0.5 * rng.normal(size=(rows, nv)) for name in ("q", "v", "u", "a")}


def dataset(rows: int = 40, seed: int = 0, **changes: object) -> Dataset:
    """`rows` random rows, the first half episode 0 and the rest episode 1, 10 ms apart."""
    fields = {
        **columns(rows, seed=seed), "time": 0.01 * np.arange(rows),
        "episode": (np.arange(rows) >= rows // 2).astype(int), "model": model(), **changes,
    }  # fmt: skip
    return Dataset(**fields)


def complete(rows: int = 40) -> Dataset:
    """With every optional field but the model."""
    rng = np.random.default_rng(1)
    return dataset(
        rows, noise_std=np.array([0.1, 0.2]),
        truth={"a": rng.normal(size=(rows, 2)), "lambda": np.zeros((rows, 0)), "Q_U": np.zeros((rows, 2))},
        strokes=rng.normal(size=(rows, 2, 3)),
        metadata={"source": "a test", "nested": {"list": [1, 2.5, None, True], "text": "µ"}},
    )  # fmt: skip


def arrays(data: Dataset) -> dict[str, np.ndarray]:
    found = {name: getattr(data, name) for name in ("q", "v", "u", "a", "time", "episode")}
    found |= {f"truth/{name}": values for name, values in data.truth.items()}
    found |= {name: x for name in ("noise_std", "strokes") if (x := getattr(data, name)) is not None}
    return found


def assert_equal(one: Dataset, other: Dataset) -> None:
    assert arrays(one).keys() == arrays(other).keys()
    for name, values in arrays(one).items():
        np.testing.assert_array_equal(values, arrays(other)[name], strict=True)
    for name in ("joint_names", "units", "metadata", "time_ordered"):
        assert getattr(one, name) == getattr(other, name)
