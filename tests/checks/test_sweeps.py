"""Where a doubt begins: defects that grow across what decides, and what was said of each before.

One joint whose signals are known, so that a defect is all that can be seen.
"""

from dataclasses import replace

import numpy as np
import pytest
from tests.checks.corruptions import ROBOTS, clean, numbers, scaled
from tests.checks.logs import PENDULUM
from tests.checks.logs import clean as filtered_log
from tests.goldens.compare import assert_unchanged

from forcegp.checks import signals
from forcegp.checks.check_input import CheckInput, _drop_outs, _even, _few_stretches, _smoothed
from forcegp.checks.explanations import candidates
from forcegp.checks.report import _held, excitation_doubts
from forcegp.checks.search import DOUBTFUL, Explanation, _root, search
from forcegp.checks.torque_doubts import elastic_doubts, held_points, torque_doubts
from forcegp.checks.torques import positive_solution
from forcegp.data import Dataset
from forcegp.doubts import LEVELS
from forcegp.model import Model
from forcegp.robots import Robot

MODEL = Model(Robot.from_urdf_text(PENDULUM, locked={"elbow": 0.0}))


def swing(rate=100.0, rows=1000, **columns) -> Dataset:
    time = np.arange(rows) / rate
    waves = {"q": np.sin(2.0 * time), "v": 2.0 * np.cos(2.0 * time), "a": -4.0 * np.sin(2.0 * time)}
    made = waves | {"u": np.cos(3.0 * time + 1.0)}
    return Dataset(**{name: x[:, None] for name, x in (made | columns).items()}, time=time, model=MODEL)


def levels(doubts, subject=""):
    """How many, and of which level, as one number."""
    return sum(10.0 ** LEVELS.index(each.level) for each in doubts if subject in each.about)


def seen(log):
    return CheckInput.as_recorded(log, MODEL)


@pytest.mark.parametrize("rate", [20.0, 100.0, 400.0])
def test_frozen_channels(rate):
    found, start = {}, round(1.0 * rate)
    for name in "qvu":
        for at in (start, 3 * start):
            for jumps in (True, False):
                said = []
                for rows in range(max(10, start // 10) - 4, max(10, start // 10) + 5):
                    log = swing(rate, 5 * start + 900)
                    x = getattr(log, name)[:, 0].copy()
                    x[at : at + rows + 1] = x[at]
                    if not jumps:  # a joint that sticks goes on from where it was
                        x[at + rows + 1 :] += x[at] - x[at + rows + 1]
                    said.append(levels(signals.signal_doubts(seen(replace(log, **{name: x[:, None]}))), "frozen"))
                found[f"{name} {at} {jumps}"] = said
    u = np.cos(3.0 * np.arange(1000) / 100.0)
    for name, value in (("off", 0.0), ("extreme", u.max() + 0.1)):
        stopped = u.copy()
        stopped[100:130] = stopped[500:530] = value
        found[name] = numbers(signals.signal_doubts(seen(swing(u=stopped))))
    found["held"] = [levels(signals.signal_doubts(seen(swing(u=u[np.arange(1000) // k * k])))) for k in (2, 3)]
    assert_unchanged(f"checks/frozen {rate:g}", found)


@pytest.mark.parametrize(("turns", "frozen"), [(40, True), (20, False)])
def test_a_torque_that_stands_still_while_its_joint_turns_and_rests_is_frozen(turns, frozen):
    u, v = swing().u[:, 0].copy(), swing().v[:, 0].copy()
    u[300:400], v[300 + turns : 400] = u[300], 1e-6 * np.random.default_rng(0).normal(size=100 - turns)
    assert (levels(signals.signal_doubts(seen(swing(u=u, v=v))), "frozen") > 0) == frozen


@pytest.mark.parametrize(("counts", "still"), [(4, True), (8, False)])
def test_a_joint_whose_encoder_dithers_by_counts_stands_still_and_is_not_frozen(counts, still):
    generator = np.random.default_rng(1)
    q = 0.3 + 2e-5 * np.repeat(generator.integers(0, counts + 1, 40), 25)
    found = signals.signal_doubts(seen(swing(q=q, v=1e-3 * generator.normal(size=1000), u=generator.normal(size=1000))))
    assert ([(x.about, x.level) for x in found] == [("constant channel", "look")]) == still
    assert "frozen channel" not in [x.about for x in found]


@pytest.mark.parametrize("name", "qvu")
@pytest.mark.parametrize(("size", "rows", "told"), [(30, [200, 500], 1), (15, [500], 0), (30, [*range(9, 700, 99)], 0)])
def test_single_rows_far_from_their_neighbours_are_named(name, size, rows, told):
    x = getattr(swing(), name)[:, 0].copy()
    x[[*rows]] += size * np.abs(np.diff(x, 2)).max() / 2.0
    found = signals.signal_doubts(CheckInput.quick(swing(**{name: x}), MODEL))
    assert [each.numbers["rows"] for each in found if each.about == "spike"] == [len(rows)] * told
    assert not told or f"--without {rows[0] / 100 - 0.005:.5f},{rows[0] / 100 + 0.005:.5f}" in found[0].do


def test_steps_bounces_chatter_and_counts_are_no_spikes():
    u, k = swing().u[:, 0], np.arange(1000)
    for x in (u + (k > 500), u + 0.1 * abs(k - 500), u + (k % 500 < 20) * (-1.0) ** k, np.round(u, 1)):
        assert not signals.signal_doubts(CheckInput.quick(swing(u=x), MODEL))


@pytest.mark.parametrize(("more", "frozen"), [(0, False), (1, True)])
def test_a_velocity_that_stands_still_while_its_encoder_counts_evenly_is_right(more, frozen):
    v, count = 2.0 * np.cos(2.0 * np.arange(1000) / 100.0), 0.003
    steps = np.round(v / 100.0 / count)
    steps[501:531], v[500:531] = 5 + more * (np.arange(30) % 2), 5 * count * 100.0
    assert (
        levels(signals.signal_doubts(seen(swing(q=count * np.cumsum(steps), v=np.rad2deg(v)))), "frozen") > 0
    ) == frozen


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_clipped_torques(sign):
    found = {}
    for near in range(4):
        for run in (1, 2, 3, 9):
            said = []
            for rows in range(7, 34):
                u = np.random.default_rng(0).permutation(np.linspace(-1.0, 0.99, 2000))
                u[100 + np.arange(rows) // run * 50 + np.arange(rows) % run], u[5 : 5 + near] = 1.0, 1.0 - 1.9e-3
                doubts = signals.signal_doubts(seen(swing(rows=2000, u=sign * u, v=np.ones(2000))))
                said.append([levels(doubts), *(each.numbers.get("row", 0) for each in doubts)])
            found[f"{near} {run}"] = [sum(each) for each in said]
    u = np.random.default_rng(0).permutation(np.linspace(-1.0, 0.99, 2000))
    u[100:120] = 1.0
    speeds = [np.where(np.arange(2000) // 20 == 5, speed, 1.0) for speed in np.linspace(0.1, 0.4, 16)]
    found["slow"] = [levels(signals.signal_doubts(seen(swing(rows=2000, u=sign * u, v=v)))) for v in speeds]
    assert_unchanged(f"checks/clipped {sign:g}", found)


def test_repeated_rows_and_constant_channels():
    found = {"rows": [], "slow": []}
    for rows in range(10, 30):
        log, at = swing(), 50 + 30 * np.arange(rows)
        q = log.q.copy()
        q[at] = q[at - 1]
        for name, speed in (("rows", 2.0), ("slow", 0.1)):
            v = np.where(np.isin(np.arange(1000), at), speed, 2.0)[:, None]
            found[name].append(levels(signals.sampling_doubts(seen(replace(log, q=q, v=v)))))
    found["sampling"] = numbers(signals.sampling_doubts(seen(replace(swing(), episode=np.repeat([3, 4], [300, 700])))))
    arm = filtered_log(4)
    for names in ("q", "v", "u", "qv", "qvu"):
        for joints in ([0], [1, 2], [0, 1, 2]):
            still = {name: np.where(np.isin(np.arange(3), joints), 0.3, getattr(arm, name)) for name in names}
            found[f"{names} {joints}"] = numbers(signals._constant(CheckInput.quick(replace(arm, **still), arm.model)))
    assert_unchanged("checks/repeated", found)


def test_how_a_signal_differs_from_a_derivative():
    inputs, found, every = seen(swing()), {}, [*signals.FACTORS, -1.0, 1.0]
    grid = sorted([f * x for f in every for x in (0.94, 0.96, 1.0, 1.04, 1.06)] + np.linspace(-1.5, 1.5, 61).tolist())
    for name, source in (("v", "q"), ("a", "v")):
        for left in (0.0, 0.04, 0.06, 0.29, 0.31):
            said = {f: list(signals._differences(inputs, name, source, {0: (f, np.nan, left)}, [0])) for f in grid}
            found[f"{name} {left}"] = [levels(each) for each in said.values()]
            stated = {f"{f:.4g}": [each.correction for each in said[f]] for f in grid}
            found[f"{name} {left} corrections"] = {f: own for f, own in stated.items() if any(own)}
        shifts = np.linspace(-0.02, 0.02, 81)
        late = [list(signals._differences(inputs, name, source, {0: (1.0, shift, 0.0)}, [0])) for shift in shifts]
        found[f"{name} late"] = [levels(each) for each in late]
    time = np.arange(1000) / 100.0
    for late in (-0.0123, 0.008):
        v = 2.6 * np.cos(2.0 * (time - late)) + 0.2 * np.sin(23.0 * time)
        pieces = [swing(v=v).rows(slice(0, 400)), swing(v=v).rows(slice(400, 1000))]
        found[f"compared {late}"] = signals._compared(pieces, "v", "q", 0)
    assert signals._compared([swing(rows=12)], "v", "q", 0) is None
    assert_unchanged("checks/differences", found)


def test_registers_and_targets():
    found, time = {}, np.arange(1000) / 100.0
    for name in "qu":
        for few in range(10, 30, 2):
            wave = np.abs((np.arange(1000) - 37) % (2 * (100 + few)) - 100 - few) - few
            for stored in (np.where(wave < 0, 32768 - wave, wave), np.where(wave < 0, 65536 + wave, wave)):
                decoded, doubts = signals.without_registers(swing(**{name: stored.astype(float)}))
                found[f"{name} {few} {stored.max()}"] = levels(doubts), decoded.u
    for size in np.geomspace(3.0, 3e4, 25):
        noisy = np.round(100.0 * np.sin(time) + size * np.random.default_rng(0).standard_normal(1000))
        stored = np.where(noisy < 0.0, noisy + 65536.0, noisy) % 65536.0
        found[f"noise {size:.2g}"] = levels(signals.without_registers(swing(u=stored))[1])
    assert signals.without_registers(swing(q=np.mod(0.01 * np.arange(1000) + 3.0, 2.0 * np.pi)))[1] == []
    for factor in (0.88, 0.92, 1.0, 1.08, 1.12, 180.0 / np.pi):
        for noise in (0.0, 0.12, 0.15, 0.18):
            said = []
            for lag in np.linspace(0.02, 0.6, 12):
                ahead = np.sin(2.0 * (time + lag)) + np.sin(13.0 * (time + lag))
                u = factor * (ahead + noise * np.random.default_rng(0).standard_normal(1000))
                doubts = signals.target_doubts(seen(swing(q=np.sin(2.0 * time) + np.sin(13.0 * time), u=u)))
                said.append(doubts[0].numbers["lag"] if doubts else 0.0)
            found[f"target {factor:.3g} {noise:g}"] = said
    assert_unchanged("checks/registers", found)


def test_what_is_mended_evened_and_smoothed():
    found = {}
    for drops in (1, 2, 3):
        offsets = []
        for offset in np.linspace(0.002, 0.03, 29):
            q = offset + 1e-3 * np.abs(np.arange(1000) % 200 - 100)
            q[100 + 200 * np.arange(drops)] = 0.0
            offsets.append(float(_drop_outs(swing(q=q), "q").sum()))
        found[f"drops {drops}"] = offsets
    for rate in (50.0, 100.0, 250.0, 1000.0):
        log = replace(swing(rate, 400), episode=np.repeat([0, 1], 200), noise_std=np.ones(1))
        smooth, width = _smoothed(log)
        found[f"smooth {rate:g}"] = width, smooth.u, smooth.time, _smoothed(log.rows(slice(0, 10 * width - 1)))[1]
    few = _few_stretches(replace(swing(rows=3000), episode=np.repeat([0, 1], 1500)))
    found["stretches"] = few.time, few.episode, len(_few_stretches(swing(rows=1200)))
    log = swing(rows=400)
    for pause in np.linspace(1.0, 7.0, 13):
        time = log.time + 0.01 * (pause - 1.0) * (np.arange(400) >= 150) + 1.0 * (np.arange(400) >= 337)
        even = _even(replace(log, time=time), np.zeros((400, 1), bool))
        found[f"pause {pause}"] = even.time, even.episode, even.q
    for inputs in (CheckInput.of(swing(), MODEL), CheckInput.quick(swing(rows=3000), MODEL)):
        more = inputs.compared_noise, inputs.compared_cutoff, inputs.cutoff
        found[f"of {len(inputs.log)}"] = inputs.rows().time, *more
    assert_unchanged("checks/mended", found)


def test_joints_that_hardly_move():
    both, found = filtered_log(6), {}
    for size in (0.4, 0.8, 1.2, 1.6, 2.4):
        q = 0.01 * size * np.sin(3.0 * both.time)[:, None] + np.zeros(3)
        other = np.where(both.time[:, None] < 5.0, both.q, np.where([True, False, True], both.q, 0.5 * q))
        for name, values, episode in (("still", q, 0), ("held", other, both.time // 2.5)):
            log = replace(both, q=values, episode=np.zeros(len(q), int) + np.asarray(episode, int))
            inputs = CheckInput.as_recorded(log, log.model, prepared=log)
            found[f"{name} {size}"] = numbers([*excitation_doubts(inputs), *_held(inputs, ["pan"])])
    assert_unchanged("checks/excitation", found)


LOGS = {
    "masses": lambda: scaled(clean(ROBOTS["spatial"](), 3, noise="qvu"), (2.0, 0.6), 1.2),
    "crane": lambda: replace(log := clean(ROBOTS["crane"](), 1, noise="qvu"), u=1e3 * log.u * [1.0, -1.0]),
    "arm": lambda: replace(log := filtered_log(2), u=log.u[:, [1, 0, 2]] + 0.2 * log.q, q=np.rad2deg(log.q)),
}


@pytest.mark.parametrize("name", [pytest.param(k, marks=[pytest.mark.nightly] * (k == "arm")) for k in LOGS])
def test_what_every_cause_explains(name):
    log = LOGS[name]()
    inputs = CheckInput.quick(log, log.model)
    root, found = _root(inputs), {}
    parts = ("shares", "unexplained", "factors", "floor", "rough", "exact", "value", "unscaled", "plain")
    found["root"] = {part: getattr(root, part) for part in parts}
    for k, (cause, compared) in enumerate(candidates(root.log, inputs, root.shares > DOUBTFUL, root.factors, True)):
        made = Explanation(compared, root.floor, (cause,)).with_signs()
        label = f"{k} {cause.about} {cause.joints}"
        found[label] = [made.value, made.unscaled, cause.cost, *made.shares, *made.turned]
    explained, doubts = search(inputs)
    more = [*torque_doubts(inputs, explained), *elastic_doubts(inputs, explained.log), *held_points(inputs)]
    assert_unchanged(f"checks/causes {name}", found | numbers([*doubts, *more]), rtol=1e-4)


def test_products_that_rounding_makes_singular_have_a_solution():
    columns = np.random.default_rng(0).normal(size=(50, 3)) @ np.diag([1.0, 1.0, 1e-9])
    columns[:, 1] = columns[:, 0]
    both = np.c_[columns, 2.0 * columns[:, 0]]
    products = both.T @ both - 1e-7 * np.diag([0.0, 50.0, 0.0, 0.0])  # as differences of sums leave them
    factors, left = positive_solution(products)
    assert factors[:2].sum() == pytest.approx(2.0, rel=1e-3)
    assert left < 1e-3 * products[-1, -1]


@pytest.mark.nightly
def test_factors_of_torques_are_looked_at_or_wrong():
    log, found = clean(ROBOTS["planar"](), 1, noise="qvu"), {}
    for factors in ([1.0, 0.3], [1.0, 0.36], [1.4, 1.0], [1.0, 28.0], [1.0, 33.0], [0.5, 0.6]):
        doubts = search(CheckInput.quick(replace(log, u=log.u * factors), log.model))[1]
        found[f"{factors}"] = numbers(doubts)
    assert "% of rated torques (200, 167)" in doubts[0].do
    hidden = replace(log, u=np.c_[log.u[:, 0], 0.02 * np.tanh(log.v[:, 1] / 0.02)])  # of which friction is all
    [told] = [each.numbers for each in search(CheckInput.quick(hidden, log.model))[1] if "factor" in each.numbers]
    assert 0.0 < told["factor"]["joint2"] == told["error_95"][0] < 0.1
    assert_unchanged("checks/factors", found, rtol=1e-4)
