"""Plots hold what they promise, are written whole, and leave matplotlib's global state alone."""

import sys

import numpy as np
import pytest
from matplotlib.image import imread

from forcegp.errors import InvalidInput
from forcegp.scores import normal_force_figure, save_figure
from forcegp.scores.figures.style import new_figure, short_joint_names, window

PNG = b"\x89PNG\r\n\x1a\n"


def test_a_file_is_a_picture_and_no_global_state_of_pyplot_is_touched(posterior, test_data, tmp_path):
    sys.modules.pop("matplotlib.pyplot", None)  # examples that ran before in this process may have imported it
    path = tmp_path / "force.png"
    save_figure(normal_force_figure(posterior, test_data), path)
    assert path.read_bytes().startswith(PNG)
    picture = imread(path)
    assert min(picture.shape[:2]) > 300
    assert picture[..., :3].std() > 0.02  # not one colour
    assert list(tmp_path.iterdir()) == [path]
    assert "matplotlib.pyplot" not in sys.modules


def test_a_figure_that_cannot_be_drawn_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "old.png"
    path.write_bytes(b"old")
    figure = new_figure(2.0, 2.0)
    figure.set_size_inches(1e6, 1e6)  # more than any renderer holds
    with pytest.raises(ValueError, match="Image size"):
        save_figure(figure, path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_window_holds_the_rows_of_one_episode_in_order_of_time(test_data):
    rows = window(test_data.rows(np.random.default_rng(0).permutation(len(test_data))), 0.1, 0.2)
    np.testing.assert_allclose(rows.time, test_data.time[(test_data.time >= 0.1) & (test_data.time <= 0.3)])
    with pytest.raises(InvalidInput, match=r"no rows from 5\.0 s on"):
        window(test_data, 5.0, 1.0)


@pytest.mark.parametrize(
    ("names", "short"),
    [
        (["lbr_iiwa_joint_1", "lbr_iiwa_joint_2"], ["joint 1", "joint 2"]),
        (["shoulder_pan", "shoulder_lift"], ["pan", "lift"]), (["pan", "lift"], ["pan", "lift"]),
        (["panel", "pan"], ["panel", "pan"]), (["only_joint_1"], ["only_joint_1"]),
    ],
)  # fmt: skip
def test_short_names_drop_what_all_joints_share(names, short):
    assert short_joint_names(names) == short
