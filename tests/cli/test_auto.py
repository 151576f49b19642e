"""`forcegp auto`: mistakes are named with the command that corrects them, and that command gives the whole answer."""

import json
import re
import shlex
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.checks import corruptions
from tests.checks.clean_logs import with_motion
from tests.checks.corruptions import recorded_under
from tests.checks.logs import clean
from tests.goldens.compare import assert_unchanged
from tests.simulation.pendulum import double_pendulum

from forcegp import Dataset, Robot, load_posterior
from forcegp.cli.answer import FIRST, heavy_links, is_explained, seen_in, verdict
from forcegp.cli.auto import default_models, more_laws
from forcegp.cli.logs import prepared_rows
from forcegp.cli.main import parse_arguments
from forcegp.cli.terminal import Terminal
from forcegp.data import Preparation
from forcegp.doubts import Doubts, look, ok, wrong
from forcegp.evidence import motion_residuals
from forcegp.scores import Scores

COLUMNS = shlex.split("--time Zeit --q Winkel_{1..2} --v Tempo_{1..2} --u Moment_{1..2} --robot arm.urdf")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A log of a double pendulum in ms, degrees and degrees per second, with one torque turned, and its URDF."""
    place, data = tmp_path_factory.mktemp("auto"), double_pendulum(8.0, seed=1, noise=0.0)
    (place / "arm.urdf").write_text(data.model.robot.urdf_text)
    q = data.q + 1e-5 * np.random.default_rng(0).standard_normal(data.q.shape)
    table = np.column_stack([1e3 * data.time, np.rad2deg(q), np.rad2deg(data.v), data.u * [1.0, -1.0]])
    names = ("Zeit", *(f"{what}_{k}" for what in ("Winkel", "Tempo", "Moment") for k in (1, 2)))
    np.savetxt(place / "log.csv", table, delimiter=";", header=";".join(names), comments="", fmt="%.9g")
    return place


@pytest.fixture(scope="module")
def answered(folder, forcegp):
    """The command that the first one printed, and what it answered."""
    words = ("auto", "log.csv", *COLUMNS, "--forces", "given", "--forces", "identified", "--out", "answer")
    refused = forcegp(*words, folder=folder)
    assert refused.returncode == 2
    assert "forcegp: unit of q, unit of time, velocity, torque sign: wrong." in refused.stderr
    assert not (folder / "answer").exists()
    command = refused.stdout[refused.stdout.index("forcegp auto") :].strip()
    assert "\n" not in command
    for flag in ("q=deg", "v=deg/s", "time=ms", "--sign u=1,-1"):
        assert flag in command
    done = forcegp(*shlex.split(command)[1:], "--json", folder=folder)
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    stages = ["checking", "preparing", "identifying", "looking for a payload", "scoring", "learning from all rows"]
    assert [line.removesuffix(" ...") for line in lines if line.removesuffix(" ...") in stages] == stages
    return command, json.loads(done.stdout)


def test_the_corrected_command_gives_a_model_that_works(folder, answered, forcegp):
    command, content = answered
    (folder / "other.csv").write_text("".join((folder / "log.csv").read_text().splitlines(keepends=True)[:1600]))
    again = forcegp(*shlex.split(command.replace("log.csv", "other.csv"))[1:], folder=folder)
    assert (again.returncode, "answer is of another log" in again.stderr) == (2, True)
    again = forcegp(*shlex.split(command)[1:], "--cutoff", "9", folder=folder)
    assert (again.returncode, "answer was filtered otherwise; choose" in again.stderr) == (2, True)
    assert content["mistakes"] == []
    test, model = double_pendulum(3.0, seed=2, noise=0.0), load_posterior(folder / "answer" / "model")
    error = np.abs(model.predict(test.q, test.v, test.u).mean.numpy() - test.a).mean()
    assert error < 0.1 * np.abs(motion_residuals(test, test.model)[1]).mean()  # of the URDF
    assert len(Dataset.load(folder / "answer" / "log.h5")) == 1920
    assert Robot.from_urdf(folder / "answer" / "identified.urdf").joint_names == test.joint_names
    assert (folder / "answer" / "validation" / "report.md").is_file()


def test_the_answer_holds_what_was_simulated(answered):
    _, content = answered
    values = content["identified"]["parameters"]
    for joint in ("upper_hinge", "lower_hinge"):
        assert values[f"gear.level.{joint}"]["value"] == pytest.approx(0.4, rel=0.05)  # 0.02 of 20 Nm
        assert values[f"viscous.{joint}"]["value"] == pytest.approx(0.2, rel=0.1)
    assert_unchanged("cli/auto", {name: each["value"] for name, each in values.items()}, rtol=2e-2)
    answer = "\n".join(content["answer"])
    assert "payload: none" in answer
    assert re.search(r"u was logged 2\.\d ms early", answer)  # of steps of 4.2 ms, in which a controller holds it
    assert 8 <= len(content["answer"]) <= 12


@pytest.mark.nightly
def test_correct_does_it_at_once(folder, forcegp, monkeypatch):
    """Up to the check: what comes after it is the same."""
    monkeypatch.setattr("forcegp.cli.auto.Auto._prepared_rows", _stopped)
    done = forcegp("auto", "log.csv", *COLUMNS, "--correct", "--out", "other", folder=folder)
    assert "InvalidInput" not in done.stderr
    assert "reached" in done.stderr
    rows = Dataset.load(folder / "other" / "log.h5")
    assert np.abs(rows.q).max() < 4.0
    assert rows.time[-1] == pytest.approx(8.0, abs=0.01)


def test_a_base_on_a_wall_is_corrected(tmp_path, forcegp, monkeypatch):
    monkeypatch.setattr("forcegp.cli.auto.Auto._prepared_rows", _stopped)
    data = recorded_under(corruptions.clean(corruptions.two_links(), 0, noise="qvu"), (0.0, -9.81, 0.0))
    (tmp_path / "arm.urdf").write_text(data.model.robot.urdf_text)
    names = ("t", *(f"{what}{k}" for what in "qvu" for k in range(2)))
    table = np.c_[data.time, data.q, data.v, data.u]
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=",".join(names), comments="")
    columns = [word for what in "qvu" for word in (f"--{what}", what + "{0..1}")]
    words = ("auto", "log.csv", *columns, "--robot", "arm.urdf", "--out", "answer")
    told = forcegp(*words, folder=tmp_path).stdout
    assert "--gravity=0,9.81,0" in told[told.index("Run:") :]
    assert "reached" in forcegp(*words, "--correct", folder=tmp_path).stderr
    assert Dataset.load(tmp_path / "answer" / "log.h5").model.robot.gravity.tolist() == [0.0, 9.81, 0.0]


def test_units_per_joint_are_corrected_in_one_command_for_columns_by_number(tmp_path, forcegp, monkeypatch):
    monkeypatch.setattr("forcegp.scores.identify", _stopped)
    data = corruptions.clean(corruptions.ROBOTS["crane"](), 4, noise="qvu")
    (tmp_path / "crane.urdf").write_text(data.model.robot.urdf_text)
    units, words = np.array([1e3, np.rad2deg(1.0)]), ("auto", "log.csv", "--robot", "crane.urdf", "--out", "answer")
    table = np.c_[data.time, data.q * units, data.v * units, data.u]
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header="t,q1,q2,dq1,dq2,tau1,tau2", comments="")
    assert "auto log.csv --unit q=mm,deg,v=mm/s,deg/s --robot" in forcegp(*words, folder=tmp_path).stdout
    done = forcegp(*words, "--correct", folder=tmp_path).stderr
    assert (done.count("reached"), done.count("u is taken to be on time")) == (1, 1)


@pytest.mark.parametrize("in_degrees", [False, True])
def test_torques_decide_whether_a_joint_turns_often_or_is_in_degrees(tmp_path, forcegp, monkeypatch, in_degrees):
    monkeypatch.setattr("forcegp.cli.auto.Auto._prepared_rows", _stopped)
    q = np.sin(np.arange(2000)[:, None] / 250.0 * [2.1, 1.3]) * [0.3, 20.0 / 15.0**in_degrees]
    data = with_motion(corruptions.ROBOTS["crane"](), q, 250.0, 4)
    (tmp_path / "crane.urdf").write_text(data.model.robot.urdf_text)
    table = np.c_[data.time, np.c_[data.q, data.v] * ([1.0, np.rad2deg(1.0) ** in_degrees] * 2), data.u]
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header="t,q1,q2,dq1,dq2,tau1,tau2", comments="")
    done = forcegp("auto", "log.csv", "--robot", "crane.urdf", "--out", "answer", folder=tmp_path)
    assert ("--unit q=m,deg,v=m/s,deg/s " in done.stdout, "reached" in done.stderr) == (in_degrees, not in_degrees)


def test_the_printed_command_keeps_every_option():
    columns = "--headerless 1,2 --side-by-side --time a:c1 --q b --u 0 --sign u=1,-1 --robot arm.urdf"
    others = "--accept --overwrite --cutoff 9 --every 3 --lock finger=0.1 --gravity=-9.81,0,0 --link tool"
    others += " --without 1,2.5 --forces given --forces gp:joint,viscous --out here"
    command = parse_arguments(["auto", "a.txt", "b.txt", *columns.split(), *others.split()])
    mapping = command.columns.mapped([], Terminal(json=False))
    assert parse_arguments(shlex.split(command._command(mapping, command.robot))[1:]) == command


def test_a_log_that_needs_no_filter_says_so():
    data = double_pendulum(8.0, seed=1, noise=0.0)
    found = Preparation(cutoff="auto").resolved(data)
    assert found.changes_nothing
    rows, same = prepared_rows(Terminal(json=True), found, data, thin=True)
    assert rows.metadata["preparation"]["why"] == found.why
    assert len(rows) == len(same) == len(data)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("auto log.csv --robot arm.urdf --out log.csv", "log.csv"),
        ("auto log.csv --out x", "--robot"),
        ("auto log.csv --robot arm.urdf --out deep/er", "the folder deep does not exist"),
        ("auto log.csv --robot arm.urdf --q Wnkel_{1..2} --u Moment_{1..2} --time Zeit --out x", "Wnkel_1"),
        ("auto log.csv --robot arm.urdf --out mine", "mine was not written by forcegp auto"),
        (f"auto log.csv {' '.join(COLUMNS)} --link zz --out x", "no frame 'zz'"),
        (f"auto log.csv {' '.join(COLUMNS)} --forces zz --out x", "no model is called 'zz'"),
    ],
)
def test_what_cannot_be_is_one_line(folder, forcegp, words, message):
    (folder / "mine").mkdir(exist_ok=True)
    (folder / "mine" / "log.h5").write_text("keep")
    forcegp(*words.split(), folder=folder).refused(message)
    assert not (folder / "x").exists()


def _stopped(*_):
    from forcegp.errors import InvalidInput

    raise InvalidInput("reached")


@pytest.mark.usefixtures("unchecked")  # its dataset is none
def test_the_verdict_names_joints_for_which_a_model_is_no_better_than_none():
    numbers, explained = list[list[str]](), list[bool]()
    dataset = SimpleNamespace(units={"q": "rad"}, q=np.array([[-0.5] * 3, [0.5] * 3]))
    doubts = [{"about": "unknown cause", "joints": ["hip", "knee"], "numbers": x} for x in ({}, {"seconds": [1, 2]})]

    def told(errors, moved=0.01, shares=None, covered=0.94, still=()):
        table = {
            "acceleration": {"nrmse": errors, "coverage_95": covered if isinstance(covered, list) else [covered] * 3}
        }
        table |= {"position after 1 s": {"rmse": [moved] * 3}}
        table |= {"torque": {"share": shares}} if shares else {}
        motions = {"horizons": [1.0], "squared": [[1e-4]]}
        run = {"split": "s", "seed": 0, "error": None, "table": table, "motions": motions, "stretches": []}
        names = ("hip", "knee", "wrist")
        about = {"given": {"kind": "given", "summary": ""}}
        scores = Scores(models=about, runs={"given": [run]}, joint_names=names, units={})
        numbers.append(scores.not_known("given", still))
        explained.extend(is_explained(doubt, scores, "given") for doubt in doubts)
        return verdict(scores, dataset, still)

    lost = told([328.2, 0.9, None], None)
    assert lost.startswith("Do not use any of these models: on unseen time the best one, “the URDF”, leaves of the acc")
    assert "hip 32820 %, knee 90 %, wrist not known from this log" in lost
    some = told([0.1, 0.16, 2.8])
    assert some.startswith("Use “the URDF” for hip, knee: on unseen time it leaves 10 to 16 % of each acceleration")
    assert some.endswith("Not for the others, of whose acceleration is left: wrist 280 %.")
    # a light wrist has no acceleration to speak of, and a torque that is known to 5 %
    assert told([0.1, 0.16, 2.8], shares=[0.02, 0.03, 0.05]) == (
        "Use “the URDF”: on unseen time it leaves 2 to 5 % of each torque, "
        "but it is for torques: do not predict motions, positions 1 s ahead are wrong by 0.01 rad."
    )
    assert "do not predict" not in told([0.1, 0.16, 2.8], shares=[0.02, 0.03, 0.05], still=["wrist"])
    assert told([0.1, 0.16, 2.6], shares=[0.02, 0.03, 0.05]).endswith("and positions 1 s ahead are wrong by 0.01 rad.")
    assert "wrist 51 %" in told([0.1] * 3, shares=[0.4, 0.03, 0.51])
    assert numbers[-3:] == [["wrist"], [], ["wrist"]]
    assert explained == [False] * 4 + [True, False] * 3 + [False] * 2, "of torques, by a tenth of their power"
    assert told([0.1] * 3, None).endswith("but its motions diverge: do not simulate with it.")
    assert told([0.1] * 3, covered=0.57).endswith("Do not trust its intervals: those of 95 % hold 57 %.")
    assert "intervals" not in told([0.1] * 3, covered=0.81) + told([0.1] * 3, covered=[0.9, 0.9, 0.1], still=["wrist"])
    assert "hold 63 %" in told([0.1] * 3, covered=[0.9, 0.9, 0.1])
    assert ["do not predict" in told([0.1] * 3, moved) for moved in (0.4, 0.6)] == [False, True]  # as the middle is


def test_the_answer_repeats_what_concerns_sensors_and_velocities():
    found = [
        look(about="velocity", what="v is late.", do="Shift it."),
        ok(about="force sensor", what="one agrees."),
        look(about="force sensor", what="one is in kgf.", do="State it."),
        look(about="force sensor", what="one is off.", do="Tare it."),
        ok(about="velocity", what="v is dq/dt."),
        look(about="unknown cause", what="a push.", numbers={"seconds": [1.0, 2.0]}),
        look(about="unknown cause", what="its end.", numbers={"seconds": [1.0, 2.0], "stops": {"lift": 0.1}}),
        wrong(about="saturation", what="one is clipped."),  # but accepted
        wrong(about="delay", what="u is shifted."),
    ]
    seen, off = seen_in([doubt.to_dict() for doubt in found]), "one is in kgf. State it. one is off. Tare it."
    told = {"sensor": "one agrees.", "force sensor": off, "push": "a push.", "saturation": "one is clipped."}
    assert seen == {"velocity": "v is late. Shift it.", "stop": "its end.", **told}
    assert FIRST & {*seen} == {"force sensor"}


@pytest.mark.parametrize(
    ("value", "least", "by", "loaded", "told"),
    [
        (26.0, 16.0, "log", (), "arm 26 kg, 2.6 times the URDF's: wrong there, or a balancer, a gas"),
        (24.0, 16.0, "log", (), ""), (45.0, 16.0, "log", (), "arm 45 kg"), (45.0, 14.0, "log", (), ""),
        (45.0, 25.0, "prior", (), ""), (45.0, 25.0, "log", ("arm", "tool"), ""),
    ],
)  # fmt: skip
def test_links_that_are_far_heavier_are_told(value, least, by, loaded, told):
    each = SimpleNamespace(value=value, start=10.0, interval=(least, 60.0), decided_by=by)
    found = heavy_links({"arm.mass": each, "viscous.arm": each}, loaded)
    assert found.startswith(told)
    assert bool(found) == bool(told)


def test_what_the_check_saw_is_estimated():
    pull = look(about="pull", what="", numbers={"link": "hand", "point": [0.03, -0.0008, 0.05]})
    odd = replace(pull, numbers={**pull.numbers, "link": "a+b"})
    assert more_laws(Doubts([pull, look(about="spring", what="")])) == "+spring+pull:hand:point=0.0300/-0.0008/0.0500"
    assert more_laws(Doubts([odd])) == ""


@pytest.mark.usefixtures("unchecked")  # a stand-in for a posterior
def test_accelerations_are_learned_from_where_torques_make_them_predictable():
    arm, normal, given = clean(0, noise=0.0), np.random.default_rng(0).normal, SimpleNamespace()
    given.model, u = arm.model, arm.u - 0.1 * arm.v - 0.2 * np.tanh(arm.v / 0.05)
    off = u.std(axis=0) * [1.0, 0.0, 0.0] * normal(size=u.shape)

    def last(off: np.ndarray, a: np.ndarray = arm.a, still: tuple[str, ...] = ()) -> str:
        return default_models(arm.model, given, replace(arm, u=u + off, a=a), still)[-1]

    assert last(0.15 * off) == "identified@accelerations"
    assert last(0.07 * off) == last(0.0 * off) == "identified+gp:joint-friction", "nothing is left to learn"
    assert last(0.15 * off, still=("elbow",)) == "identified+gp:joint-friction"
    wrist = arm.a + np.array([0.0, 0.0, 100.0]) * normal(size=off.shape)
    assert last(0.15 * off, wrist) == "identified@torques:both"
    assert last(30.0 * normal(size=off.shape)) == "identified+gp:joint-friction"
    ways = arm.q - arm.q.mean(axis=0)
    alone, both = (0.2 * u.std(axis=0) * x / x.std(axis=0) * [1, 0, 0] for x in (ways**3, ways * ways[:, [1, 2, 0]]))
    assert last(alone) == "identified+gp:joint-position", "which explain what accelerations would be asked for"
    assert last(both) == last(alone + both, still=("elbow",)) == "identified+gp:joint:inputs=q"
