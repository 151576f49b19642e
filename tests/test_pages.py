"""The code of the pages in docs/ runs as it stands and prints what its comments say."""

import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from tests.cli.in_process import run_here
from tests.examples import blocks, run_example
from tests.scores.moving_arm import moving_arm

from forcegp import Dataset
from forcegp.cli.main import parse_arguments
from forcegp.scores.models import candidates, usual_identification


def test_the_page_on_ones_own_robot_runs(tmp_path: Path):
    printed = run_example("\n".join(blocks("your-robot")), tmp_path)
    noise, error, *_, any_force, friction, above, surface = printed.splitlines()
    assert f"{float(any_force):.2f} and {float(friction):.2f}" == "0.80 and 0.10"  # the comment on the page
    assert all(0.05 < float(std) < 0.2 for std in re.findall(r"\d\.\d+", noise))
    assert float(error) < 0.3
    assert (above[:11], surface) == ("tensor(0.46", "Pipe(radius=0.5)")


def test_the_own_sensor_of_the_page_on_contact_forces_is_learned_from(tmp_path: Path):
    gain, mass = map(float, run_example(blocks("contact-forces")[-1], tmp_path).split())
    assert (gain, mass) == pytest.approx((25.0, 50.0), rel=1e-3)


def test_the_page_on_moving_bases_runs(tmp_path: Path):
    example, poses = blocks("moving-bases")
    run_example(poses, tmp_path)
    _, own, *_ = (block.splitlines() for block in blocks("moving-bases", "sh"))
    for command in own:
        done = run_here(*shlex.split(command)[1:], folder=tmp_path).ok()
    for name in ("poses.h5", "flight.h5"):
        log = Dataset.load(tmp_path / name)
        t, turned = log.time, 0.4 * log.time
        velocity, acceleration = np.cos(t) * np.cos(turned) - np.sin(t) * np.sin(turned), -1.4 * np.sin(t + turned)
        np.testing.assert_allclose(log.v[:, 0], velocity, rtol=0, atol=1e-3)
        np.testing.assert_allclose(log.a[:, 0], acceleration, rtol=0, atol=2e-2)
        np.testing.assert_allclose(log.v[:, 5], 0.4, rtol=0, atol=1e-3)
    np.testing.assert_allclose(log.u, 5180 * np.pi / 30)
    assert "base: positions and velocities of 'base' agree" in done.stdout
    sizes, step, inputs, force = run_example(example, tmp_path).splitlines()
    assert sizes.startswith("8 7 ('base.x', ")
    assert [round(float(x), 6) for x in re.findall(r"-?\d\.\d+(?:e-\d+)?", step)] == [0.1, 0, 0, 0, 0, 0.3, 0.2]
    assert inputs == "('knee', 'foot_stands')"
    assert len(re.findall(r"-?\d+\.\d+", force)) == 3


@pytest.mark.nightly
def test_the_page_on_scoring_runs(repository: Path, tmp_path: Path):
    page = (repository / "docs" / "how-to" / "scoring.md").read_text(encoding="utf-8")
    (example,) = blocks("scoring")
    moving_arm(1.5, 2).save(tmp_path / "log.h5")
    alone, taken, found = run_example(example, tmp_path).splitlines()
    assert len(re.findall(r"\d\.\d+", alone)) == 5
    assert "error of predicted motions" in taken
    assert "'median'" in found
    assert (tmp_path / "mine" / "report.md").exists()
    model = moving_arm(0.1, 1).model
    (table,) = re.findall(r"\| `--forces` \|.*?\n\n", page, re.DOTALL)
    named = [name for row in table.split("|\n|")[2:] for name in re.findall(r"`([^`]+)`", row.split("|")[0])]
    words = [word for name in named for word in ("--forces", name)]
    command = parse_arguments(["score", "log.h5", *words])
    assert len(candidates(command.models.names(), model, usual_identification(model))) == len(named) >= 8


@pytest.mark.nightly
def test_the_page_on_reports_runs(tmp_path: Path):
    (example,) = blocks("reports")
    assert run_example(example, tmp_path).splitlines() == re.findall(r"print\(.*\)  # (.*)", example)


def test_the_page_on_motions_runs(tmp_path: Path):
    (example,) = blocks("motions")
    windows, rms = run_example(example, tmp_path).split()[:2]
    assert windows == "7"
    assert float(rms.strip("[]")) < 1e-3


@pytest.mark.nightly
def test_the_page_on_identification_runs(tmp_path: Path):
    (example,) = blocks("identification")
    mass, decided = run_example(example, tmp_path).splitlines()[-2:]
    found, error = (float(number) for number in re.fullmatch(r"(\S+) \+- (\S+) kg", mass).groups())
    assert abs(found - 2.0) < 0.1
    assert 0.0 < error < 0.05
    assert decided == "log - its rows show it"
    assert 'xyz="' in (tmp_path / "identified.urdf").read_text()


@pytest.mark.nightly
def test_the_commands_of_the_page_on_identification_run(tmp_path: Path):
    commands, *_ = blocks("identification", "sh")  # the others need logs of the reader's own
    for command in commands.splitlines():
        program, *words = command.split()
        assert program == "forcegp"
        run_here(*words, folder=tmp_path).ok()
    assert (tmp_path / "identified" / "identified.urdf").exists()


@pytest.mark.nightly
def test_the_page_on_rollouts_runs(tmp_path: Path):
    states, more, diverged, free, held = run_example("\n".join(blocks("rollouts")), tmp_path).splitlines()[-5:]
    assert states == "torch.Size([2, 241, 7]) torch.Size([2, 241, 7]) torch.Size([2, 240, 7])"
    assert more == "torch.Size([2, 241, 1]) torch.Size([10, 2, 241, 7])"
    assert diverged == "tensor([-1, -1])"
    assert float(held.split()[0]) < 0.5 * float(free.split()[0])


@pytest.mark.nightly
def test_the_page_on_learning_while_working_runs(tmp_path: Path):
    printed = [run_example(code, tmp_path) for code in blocks("incremental")]
    assert [text.splitlines()[-1] for text in printed] == ["100 40", "True True"]


@pytest.mark.nightly
def test_the_page_on_large_data_runs(tmp_path: Path):
    (example,) = blocks("large-data")
    engine, left_out = run_example(example, tmp_path).splitlines()
    assert engine == "inducing: as asked for"
    assert float(left_out.split()[2]) <= 1.0


@pytest.mark.nightly
def test_the_page_on_gpus_runs_on_the_cpu(tmp_path: Path):
    (example,) = blocks("gpu")
    assert run_example(example, tmp_path).splitlines()[-1] == "cpu"


@pytest.mark.skipif(not shutil.which("cc"), reason="needs a C compiler")
@pytest.mark.parametrize(
    ("program", "lines"),
    [
        (
            "swing_up",
            r"planned without friction: .*, (\S+) rad off.*\nplanned with learned friction: .*, (\S+) rad off",
        ),
        ("shooting", r"cosines .*: (\S+), (\S+)\nmedian \S+ ms of CPU, of 20 ms, for 512 x 25 steps"),
    ],
)
@pytest.mark.nightly
def test_the_examples_of_the_page_on_deploying_run(repository: Path, tmp_path: Path, monkeypatch, program, lines):
    """A model, 15 s of CPU each: what the page promises of both."""
    pytest.importorskip("casadi", reason="CasADi is not installed: pip install 'forcegp[casadi]'")
    monkeypatch.syspath_prepend(repository / "examples")
    source = (repository / "examples" / f"{program}.py").read_text(encoding="utf-8")
    first, second = (float(number) for number in re.match(lines, run_example(source, tmp_path)).groups())
    if program == "swing_up":
        assert first > 2.0
        assert second < 0.2
        assert (tmp_path / "swing-up.png").stat().st_size > 10_000
    else:
        assert min(first, second) > 0.9
    parts = (repository / "examples").glob(f"{program}*.py")
    source = "".join(part.read_text(encoding="utf-8") for part in parts)
    page = (repository / "docs" / "how-to" / "deploy.md").read_text(encoding="utf-8")
    shown = page.partition(f"[examples/{program}.py]")[2].partition("```py\n")[2].partition("```")[0]
    assert len(shown.splitlines()) >= 3
    for line in shown.splitlines():
        assert line in source


@pytest.mark.skipif(not shutil.which("cc"), reason="needs a C compiler")
@pytest.mark.nightly
@pytest.mark.usefixtures("unchecked")  # explicit steps add and scale CasADi's expressions as they do tensors
def test_the_page_on_deploying_runs(tmp_path: Path):
    (example,) = blocks("deploy")
    files, agree = run_example(example, tmp_path).splitlines()
    assert "lbr_iiwa.c" in files
    assert agree == "True"
    commands, build, _, planner = blocks("deploy", "sh")  # the live monitor waits for a robot
    for command in (commands + planner).splitlines():
        run_here(*shlex.split(command)[1:], folder=tmp_path).ok()
    for command in build.splitlines():
        subprocess.run(command, shell=True, cwd=tmp_path / "controller", check=True)
    assert {"lbr_iiwa.casadi", "lbr_iiwa_step.casadi"} <= {file.name for file in (tmp_path / "planner").iterdir()}


@pytest.mark.nightly
def test_the_page_on_robots_runs_from_files_to_learned_forces(tmp_path: Path):
    record, drone = blocks("robots")
    run_example(record, tmp_path)
    assert run_example(drone, tmp_path).strip() == "('rotor_1', 'rotor_2', 'rotor_3', 'rotor_4')"
    commands = "\n".join(blocks("robots", "sh"))
    for command in re.findall(r"^forcegp .*$", commands, re.MULTILINE):
        done = run_here(*command.split()[1:], folder=tmp_path)
        assert done.returncode == 0, f"{command}: {done.stderr}"
    for name in ("arm", "gripper", "dog", "drone"):
        test = "test.h5" if name == "drone" else f"{name}_test.h5"
        scores = json.loads(run_here("score", name, test, "--json", folder=tmp_path).stdout)
        errors = scores["models"][name]["scores"]["acceleration"]
        assert errors["mae"]["all"]["median"] < 0.25 * errors["known_physics_mae"]["all"]["median"], name


@pytest.mark.nightly  # tests of predictors ask each function
def test_the_page_on_control_rates_runs(tmp_path: Path):
    (example,) = blocks("control-rate")
    rank, one, linear, many, step, inverse, gradient = run_example(example, tmp_path).splitlines()
    found, excess = re.fullmatch(r"rank (\d+), standard deviations at most (\S+)% too large", rank).groups()
    assert 1 < int(found) <= 300
    assert 0.0 < float(excess) <= 1.0
    assert one == "torch.Size([7]) torch.Size([7, 7])"
    assert linear == "torch.Size([7, 7]) torch.Size([7, 7]) torch.Size([7, 7])"
    assert step == "torch.Size([14, 14]) torch.Size([14, 7]) torch.Size([14])"
    assert inverse == one
    assert (many, gradient) == ("torch.Size([1000, 7])", "torch.Size([7])")
