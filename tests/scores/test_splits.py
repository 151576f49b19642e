"""What is held out: no row is on both sides, and none within the guard is learned from."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.data.samples import model
from tests.goldens.compare import assert_unchanged
from tests.posterior.arm import arm_data
from tests.scores.moving_arm import given_system, moving_arm

from forcegp.data import Dataset
from forcegp.errors import DatasetError, InvalidInput
from forcegp.scores import Split, split_named
from forcegp.scores.experiment import training_subset
from forcegp.scores.held_out import held_out_motions
from forcegp.scores.models import all_rows_at_once, candidates, default_models, usual_identification


def recording(rows: int = 60, episodes: int = 3, seed: int = 0, **changes) -> Dataset:
    generator = np.random.default_rng(seed)
    values = {name: generator.normal(size=(rows, 2)) for name in "qvua"}
    episode = np.repeat(np.arange(episodes), rows // episodes)
    time = np.concatenate([np.cumsum(generator.uniform(0.005, 0.03, rows // episodes)) for _ in range(episodes)])
    return Dataset(**{**values, "time": time, "episode": episode, "model": model(), **changes})


@settings(max_examples=30, deadline=None)
@given(
    blocks=st.integers(2, 7), wanted=st.sets(st.integers(1, 7), min_size=1), guard=st.floats(0.0, 0.2),
    episodes=st.integers(1, 3), seed=st.integers(0, 50),
)  # fmt: skip
def test_blocks_share_no_row_and_keep_their_distance(blocks, wanted, guard, episodes, seed):
    data, wanted = recording(60, episodes, seed), sorted(number for number in wanted if number <= blocks)
    if not wanted or len(wanted) == blocks:
        return
    split = split_named(data, f"blocks:{blocks}:{','.join(map(str, wanted))}", guard)[0]
    train, test = split.training_rows(data), split.test_rows(data)
    assert not (train & test).any()
    for episode in data.episodes:
        here = data.episode == episode
        length = np.ptp(data.time[here])
        place = (data.time - data.time[here].min()) / length * blocks
        number = np.minimum(np.floor(place).astype(int), blocks - 1) + 1
        inside = np.abs(place - np.round(place)) > 1e-9  # on a border rounding decides
        assert (test[here & inside] == np.isin(number, wanted)[here & inside]).all()
        if train[here].any() and test[here].any():
            assert np.abs(data.time[here & train][:, None] - data.time[here & test]).min() >= guard * (1 - 1e-12)
        # a row that is on neither side lies within the guard of a held-out block, and so of its border
        for row in np.flatnonzero(here & ~train & ~test):
            borders = [number for number in range(1, blocks) if (number in wanted) != (number + 1 in wanted)]
            assert (min(abs(place[row] - border) for border in borders) * length / blocks) <= guard + 1e-12


def test_a_decimated_recording_is_divided_at_the_same_moments():
    full = recording(300, 1)
    few = full.rows(slice(None, None, 7))
    split = split_named(few, "blocks:5:3,5", 0.05)[0]
    assert (split.test_rows(full)[::7] == split.test_rows(few)).all()
    assert (split.training_rows(full)[::7] == split.training_rows(few)).all()
    assert split.test_rows(full)[-1], "rows after the last of the few belong to the last block"


@pytest.mark.parametrize(("share", "count"), [(0.4, 5), (0.08, 5), (0.03, 10), (0.97, 10), (0.0, 10), (1.0, 10)])
def test_both_sides_show_the_motion_of_every_joint(share, count):
    data = recording(300, 1)
    held, v = split_named(data, "blocks:5:3,5")[0].test_rows(data), data.v.copy()
    v[:, 0] = np.sqrt(np.where(held, share / held.sum(), (1.0 - share) / (~held).sum()))
    split = split_named(dataclasses.replace(data, v=v), "auto")[0]
    assert len(split.held_out) == 2 * count // 5
    assert split.name.startswith(f"blocks-{count}-3-5")


WRONG = [
    ("episodes:7", r"held-out episodes are \[7\]; name some of \[0, 1, 2\]"),
    ("episodes:0,1,2", "leave one to learn from"), ("episodes:", "give auto, folds, episodes:N"),
    ("blocks:5:6", r"name some of \[1, 2, 3, 4, 5\]"), ("thirds", "give auto, folds, episodes:N"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "message"), WRONG, ids=[text for text, _ in WRONG])
def test_what_makes_no_split_is_refused(text, message):
    with pytest.raises(InvalidInput, match=message):
        split_named(recording(), text)


def test_overlap_is_refused():
    with pytest.raises(InvalidInput, match="guard is -1"):
        Split("s", "", ((0, 0.0, 1.0),), guard=-1.0)
    data = recording()
    with pytest.raises(InvalidInput, match="leaves no row to learn from"):
        split_named(data, "blocks:2:1", 10.0)[0].apply(data)
    again = {name: getattr(data, name).copy() for name in ("q", "v", "u")}
    for values in again.values():
        values[20:40] = values[:20]  # episode 1 repeats episode 0
    with pytest.raises(DatasetError, match="20 of 20 test rows are also training rows"):
        split_named(data, "episodes:1")[0].apply(dataclasses.replace(data, **again))
    with pytest.raises(InvalidInput, match="leave one to learn from, or hold out blocks"):
        split_named(recording(60, 1), "leave-one-out")
    assert len(split_named(recording(64, 8), "auto")[0].held_out) == 2, "a quarter"
    for share, whole in ((0.7, False), (0.5, True)):
        unequal = recording(60, 2, episode=(np.arange(60) >= 60 * share).astype(int), time=0.01 * np.arange(60))
        assert split_named(unequal, "auto", 0.01)[0].name.startswith("episode") == whole


def rows_of(data) -> set[float]:
    return set(data.time.tolist())


def test_seeds_choose_other_training_rows_that_lie_far_apart():
    train = arm_data(300, seed=1)
    chosen = [training_subset(train, 40, seed) for seed in range(3)]
    assert all(len(subset) == 40 and rows_of(subset) <= rows_of(train) for subset in chosen)
    assert rows_of(training_subset(train, 40, 2)) == rows_of(chosen[2])
    shared = [len(rows_of(a) & rows_of(b)) for i, a in enumerate(chosen) for b in chosen[:i]]
    assert max(shared) < 36, "seeds would hardly differ"

    def nearest(data) -> float:
        x = np.hstack([data.q, data.v, data.u]) / np.hstack([train.q, train.v, train.u]).std(0)
        return float((np.linalg.norm(x[:, None] - x, axis=-1) + 1e9 * np.eye(len(x))).min(axis=1).mean())

    assert nearest(chosen[0]) > 1.2 * nearest(train.rows(np.random.default_rng(0).choice(300, 40, replace=False)))
    for points in (1, 201):
        with pytest.raises(InvalidInput, match="from 2 to 200, two thirds"):
            training_subset(train, points, 0)


def test_what_is_held_out_is_what_it_was():
    found, arm = {}, moving_arm(0.5, 4)
    for text in ("auto", "folds", "leave-one-out", "episodes:1,3", "blocks:5:2,4"):
        for split in split_named(arm, text, guard=0.03):
            rows = split.test_rows(arm), split.training_rows(arm)
            motions = held_out_motions(arm, rows[0], None, 3)
            starts = [at for _, at in motions.stretches]
            found[f"{text} {split.name}"] = {**split.to_dict(), "rows": rows, "h": motions.horizons, "starts": starts}
    for seed in range(3):
        found[f"subset {seed}"] = training_subset(arm, 12, seed).time
    model = given_system()
    usual = usual_identification(model)
    names = *default_models(model), "viscous+stribeck@torques", "gp:joint"
    for name, each in candidates(names, model, usual).items():
        found[name] = each.kind, each.identification, [each.all_rows, len(each.evidence), len(each.motions)]
    found["at once"] = [all_rows_at_once(count, 3) != {} for count in range(200, 600, 9)]
    assert_unchanged("scores/splits", found)
    assert [len(split_named(moving_arm(0.1, count), "folds")) for count in (8, 9)] == [4, 2]
