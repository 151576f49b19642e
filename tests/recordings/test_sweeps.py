"""Where an import begins to refuse, to leave out or to cut: defects that grow across what decides, as they were."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.goldens.compare import assert_unchanged
from tests.recordings.broken_logs import urdf
from tests.recordings.log_files import STEP, motion, table
from tests.recordings.test_importing import NAMES
from typing_extensions import override

from forcegp import Model, Robot
from forcegp.errors import DataWarning, ForceGPError
from forcegp.recordings import ColumnMapping, ImportOptions, Source, import_recordings, importing
from forcegp.recordings.recording import read_poses
from forcegp.recordings.ros_bag import Read, _at
from forcegp.recordings.source import HARMLESS, require_plausible_size
from forcegp.recordings.tables import _is_number, seconds_of

ARM = Model(Robot.from_urdf_text(urdf("shoulder", "elbow")))
FREE = Model(Robot.from_urdf_text(urdf("shoulder", "elbow").replace("revolute", "continuous")))


class Table(Source):
    """Columns that no file holds."""

    def __init__(self, columns):
        super().__init__(Path("log"))
        self.held = columns

    @override
    def columns(self):
        return tuple(self.held)

    @override
    def table(self, names):
        return {name: self.held[name] for name in names}

    @override
    def files(self):
        return ()


@pytest.fixture
def imported(monkeypatch):
    """What becomes of columns, or the refusal."""

    def made(columns, mapping=NAMES, model=ARM, **options):
        monkeypatch.setattr(importing, "_sources", lambda paths, mapping: [("log", Table(columns))])
        try:
            log = import_recordings(["log"], mapping, model=model, options=ImportOptions(**options))
        except (ForceGPError, DataWarning) as error:
            return str(error)
        done = log.metadata["import"]
        return [log.time, log.episode, log.q, log.v, log.u, log.a, done["recordings"], done["resampled_to_step"]]

    return made


def test_stamps(imported):
    found, columns = {}, table(motion(60))
    for rate in (1.9, 2.1, 499.3, 499.6, 500.4, 1e4, 1.9e5, 2.1e5, 1e6):
        found[f"rate {rate:g}"] = imported({**columns, "time": np.arange(60) / rate})
        found[f"slow {rate:g}"] = imported({**columns, "time": 1e3 * np.arange(60) / rate})
    for late in (0.02, 0.04, 0.06, 0.5, 5.0, 8.4, 9.5):
        time = columns["time"] + STEP * ((np.arange(60) > 40) * late - (np.arange(60) == 20) * (1.0 - late / 10.0))
        for rate in ("auto", "log"):
            found[f"late {late:g} {rate}"] = imported({**columns, "time": time}, rate=rate)
    for jitter in (1e-5, 1e-4, 1e-3, 1e-2, 0.1):
        time = columns["time"] + STEP * jitter * np.sin(np.arange(60.0))
        found[f"jitter {jitter:g}"] = imported({**columns, "time": time})
    for rows in range(3, 8):
        episode = np.where(np.arange(60) < rows, 3.0, 4.0)
        found[f"rows {rows}"] = imported({**columns, "run": episode}, replace(NAMES, episode="run"))
    for rate in (440.0, 455.0, 470.0, 1700.0):
        found[f"asked {rate:g}"] = imported(columns, rate=rate, start=0.01, end=0.1, without=(0.04, 0.0401), gap=0.009)
    assert_unchanged("recordings/stamps", found)


def test_values(imported):
    found, columns = {}, table(motion(100))
    for size in (0.9, 1.5, 1.79, 1.81, 12.4, 12.7, 100.0, 1790.0, 1810.0):
        wave = size * np.sin(20.0 * columns["time"])
        for name, model in (("limits", ARM), ("none", FREE)):
            for unit in ("", "rad", "deg"):
                mapping = replace(NAMES, unit={"q": (unit,)} if unit else {})
                given = {**columns, "q_elbow": wave, "q_shoulder": -wave}
                found[f"{name} {size:g} {unit}"] = imported(given, mapping, model)
    for rows in (4, 5, 6):
        for names in (["u_elbow"], [*columns][1:], ["v_elbow", "time"]):
            there = {n: np.where((np.arange(100) % 16 == 3) & (np.arange(100) < 16 * rows) & (n in names), np.nan, x)
                     for n, x in columns.items()}  # fmt: skip
            for how in ("skip", "refuse"):
                found[f"lost {rows} {len(names)} {how}"] = imported(there, bad_rows=how)
    for steep in (3.1, 3.2, 6.2):
        q = columns["q_elbow"] + steep * (np.arange(100) > 50)
        found[f"jump {steep}"] = [imported({**columns, "q_elbow": q}, model=FREE, unwrap=way) for way in (False, True)]
    assert_unchanged("recordings/values", found)


def test_turns_of_a_base():
    space, found = Robot.from_urdf_text(urdf("knee"), base="floating").space, {}
    q, angle = np.zeros((12, 8)), np.linspace(0.0, 2.0, 12)
    q[:, 3], q[:, 6] = np.sin(0.5 * angle), np.cos(0.5 * angle)
    for error in (1e-10, 1e-8, 0.009, 0.011):
        for jump in (1.5, 1.64, 3.2):
            own, turned = q.copy(), angle + jump * (np.arange(12) > 6)
            own[:, 3], own[:, 6] = np.sin(0.5 * turned), np.cos(0.5 * turned)
            own[8, 3:7] *= 1.0 + error
            try:
                found[f"{error} {jump}"] = read_poses(space, "xyzw", Table({}), own, np.array([0, 5]))
            except ForceGPError as refusal:
                found[f"{error} {jump}"] = str(refusal)
    found["angles"] = read_poses(space, "angles", Table({}), np.delete(q, 3, axis=1), np.array([0]))
    assert_unchanged("recordings/turns", found)


def test_topics_beside_each_other(imported):
    rng, found = np.random.default_rng(0), {}
    time, stamps = np.sort(rng.uniform(0.0, 1.0, 25)), np.sort(rng.uniform(0.1, 0.9, 9))
    values = rng.normal(size=(9, 5))
    for most in (0.0, 1.0, np.inf):
        largest = np.array([most, np.inf, 2.0, 0.0, 0.5]) if most else np.zeros(5)
        found[f"at {most}"] = _at(time, stamps, values, largest, [[1, 2]])
    read = Read({"q": time}, (), silent=((0.05, time), (0.2, 1.0 - time)))
    found["paused"] = [read.paused(gap, 3.0).sum() for gap in (None, 0.1, 0.5, 0.99)]
    columns = {name: x.astype(float) for name, x in table(motion(90)).items()}
    for every in (2, 3, 40):
        sparse = {n: np.where(np.arange(90) % every == (n[0] == "u"), x, np.nan) if n != "time" else x
                  for n, x in columns.items()}  # fmt: skip
        found[f"every {every}"] = imported(sparse)
    guessed = {"t": columns["time"], **{n.replace("q_", "position."): x for n, x in columns.items() if n[0] in "qu"}}
    found["guessed"] = imported(guessed, ColumnMapping())
    assert_unchanged("recordings/topics", found)


def test_texts_that_are_numbers_times_and_sizes():
    texts = "1", "-1.5e3", ".5", "1,5", "+inf", "nan", "1e", "1 2", "12:30", "23:59:59.5", "00:00:01", "2024-02-29"
    texts += "31.12.1999 23:59:60", "2024/3/1T06:00:00Z", "1970-01-01 00:00:01,25+01:00", "1:2", "12-30", "", "x"
    found = {"numbers": [_is_number(text) for text in texts], "seconds": [*seconds_of(texts), *seconds_of(texts[8:11])]}
    for declared in (HARMLESS - 1, HARMLESS + 1, 3 * HARMLESS):
        for share in (190, 199, 201):
            try:
                require_plausible_size(Path("log"), "it", declared, declared // share)
                found[f"{declared} {share}"] = ""
            except ForceGPError as refusal:
                found[f"{declared} {share}"] = str(refusal)
    assert_unchanged("recordings/texts", found)
