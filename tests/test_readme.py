"""The README's Python example runs as it stands and prints what its comments say."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

from benchmarks.force_pictures import PICTURES
from tests.cli.in_process import run_here
from tests.examples import run_example

from forcegp import KukaSurfaceConfig, simulate_kuka_surface
from forcegp.cli.arguments import parse_arguments
from forcegp.experiments import published
from forcegp.experiments.model_names import MODELS
from forcegp.priors import KERNELS, NAMED_PRIORS, named_prior


def test_the_python_example_runs(repository: Path, tmp_path: Path):
    (example,) = re.findall(r"```python\n(.*?)```", (repository / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert len([line for line in example.splitlines() if line.strip()]) <= 12
    done = subprocess.run([sys.executable, "-c", example], cwd=tmp_path, capture_output=True, text=True, check=True)
    acceleration, forces, error = done.stdout.splitlines()
    assert acceleration == "torch.Size([1200, 7]) torch.Size([1200, 7, 7])"
    assert forces == "torch.Size([1200, 1]) torch.Size([1200, 7])"
    assert float(error.split()[3]) < 0.2
    assert {path.name for path in (tmp_path / "model").iterdir()} == {"model.json", "tensors.safetensors", "robot.urdf"}


def test_the_page_on_ones_own_robot_runs(repository: Path, tmp_path: Path):
    page = (repository / "docs" / "your-robot.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    printed = run_example(example, tmp_path)
    noise, error, *_, any_force, friction = printed.splitlines()
    assert f"{float(any_force):.2f} and {float(friction):.2f}" == "0.80 and 0.10"  # the comment on the page
    assert all(0.05 < float(std) < 0.2 for std in re.findall(r"\d\.\d+", noise))
    assert float(error) < 0.3


def test_the_pictures_and_pages_that_it_names_exist(repository: Path):
    links = re.findall(r"\]\(([^)#]+)\)", (repository / "README.md").read_text(encoding="utf-8"))
    missing = [link for link in links if not link.startswith("http") and not (repository / link).exists()]
    assert not missing


def test_the_page_on_comparing_priors_runs(repository: Path, tmp_path: Path):
    page = (repository / "docs" / "comparing-priors.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    printed = run_example(example, tmp_path)
    verdict, joint, contact, none, left_out = printed.splitlines()
    assert verdict.startswith("The data support contact: ")
    scores = [float(re.search(r"functions, (\S+) nats per row", line)[1]) for line in (joint, contact, none)]
    assert scores[1] > scores[0] > scores[2]
    assert left_out.endswith("torch.Size([30, 7]) torch.Size([30, 7, 7])")
    for commands in re.findall(r"```sh\n(.*?)```", page, re.DOTALL):
        for command in re.findall(r"^ *forcegp (.*)$", commands.replace("\\\n", " "), re.MULTILINE):
            parse_arguments(shlex.split(command.partition(">")[0].replace("$seed", "1")))


def test_the_page_on_forces_runs(repository: Path, tmp_path: Path):
    page = (repository / "docs" / "forces.md").read_text(encoding="utf-8")
    example, _ = re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)  # the other has tests of its own
    printed = run_example(example, tmp_path)
    tool, total, curve, error, free = printed.splitlines()
    assert tool == "torch.Size([2400, 1]) torch.Size([2400, 7, 7]) torch.Size([2400, 3])"
    assert total == "torch.Size([2400, 7]) torch.Size([2400, 1])"
    assert re.fullmatch(r"sliding speed \[m/s\] from \S+ to \S+, 200 values in N", curve)
    assert float(error.split()[-2]) < 20.0
    assert free == "torch.Size([2400, 0])"
    assert {"friction.png", "normal-force.png"} <= {path.name for path in tmp_path.iterdir()}


def test_the_commands_and_priors_of_the_page_on_forces_exist(repository: Path):
    page = (repository / "docs" / "forces.md").read_text(encoding="utf-8")
    rows = page.partition("## Which prior?")[2].partition("\n## ")[0]
    told = {name.partition(":")[0] for name in re.findall(r"^\| `([^`]+)` \|", rows, re.MULTILINE)}
    assert told == set(NAMED_PRIORS) - {"air-drag"}
    rows = page.partition("## Kernels")[2].partition("\n## ")[0]
    told = {
        name for cell in re.findall(r"^\| (`[^|]+) \|", rows, re.MULTILINE) for name in re.findall(r"`(.+?)`", cell)
    }
    assert told == set(KERNELS)
    system = simulate_kuka_surface(KukaSurfaceConfig(seconds=0.1)).system
    count = 0
    for commands in re.findall(r"```sh\n(.*?)```", page, re.DOTALL):
        for line in re.findall(r"^forcegp (.*)$", commands.replace("\\\n", " "), re.MULTILINE):
            command = parse_arguments(shlex.split(line))
            for prior in getattr(command, "prior", ()):
                named_prior(prior, system)
                count += 1
    assert count > 10


def test_the_pictures_and_pages_that_the_page_on_forces_names_exist(repository: Path):
    page = (repository / "docs" / "forces.md").read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)#]+)\)", page)
    assert not [link for link in set(links) if not (repository / "docs" / link).exists()]
    drawn = re.findall(r"\]\(forces/(.*)\.png\)", page)
    assert set(drawn) == set(PICTURES)


def test_the_page_on_identification_runs(repository: Path, tmp_path: Path):
    page = (repository / "docs" / "identification.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    printed = run_example(example, tmp_path)
    mass, verdict, _ = printed.splitlines()[-3:]
    found, error = (float(number) for number in re.fullmatch(r"(\S+) \+- (\S+) kg", mass).groups())
    assert abs(found - 2.0) < 0.1
    assert 0.0 < error < 0.05
    assert verdict == "The data identify every parameter that was learned."
    assert 'xyz="' in (tmp_path / "identified.urdf").read_text()


def test_the_commands_of_the_page_on_identification_run(repository: Path, tmp_path: Path):
    page = (repository / "docs" / "identification.md").read_text(encoding="utf-8")
    commands, _ = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)  # the second needs a log of the reader's own
    for command in commands.splitlines():
        program, *words = command.split()
        assert program == "forcegp"
        done = run_here(*words, folder=tmp_path)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "identified" / "identified.urdf").exists()


def test_the_page_on_rollouts_runs(repository: Path, tmp_path: Path):
    page = (repository / "docs" / "rollouts.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    printed = run_example(example, tmp_path)
    states, more, diverged, free, held = printed.splitlines()[-5:]
    assert states == "torch.Size([2, 241, 7]) torch.Size([2, 241, 7]) torch.Size([2, 240, 7])"
    assert more == "torch.Size([2, 241, 1]) torch.Size([10, 2, 241, 7])"
    assert diverged == "tensor([-1, -1])"
    assert float(held.split()[0]) < 0.5 * float(free.split()[0])


def test_the_page_on_learning_while_working_runs(repository: Path, tmp_path: Path):
    page = (repository / "docs" / "incremental.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    printed = run_example(example, tmp_path)
    assert printed.splitlines()[-1] == "70 40"


def test_the_page_on_large_data_runs(repository: Path, tmp_path: Path):
    page = (repository / "docs" / "large-data.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    printed = run_example(example, tmp_path)
    engine, refined, left_out = printed.splitlines()
    assert engine == "inducing: as asked for"
    assert refined.startswith("on all rows, ")
    assert float(left_out.split()[2]) <= 1.0
    (commands,) = re.findall(r"```console\n(.*?)```", page, re.DOTALL)
    names = [parse_arguments(command.split()[1:]).__class__.__name__ for command in commands.splitlines()]
    assert names == ["Fit", "Fit", "Fit"]


def test_the_page_on_gpus_runs_on_the_cpu(repository: Path, tmp_path: Path):
    page = (repository / "docs" / "gpu.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    printed = run_example(example, tmp_path)
    assert printed.splitlines()[-1] == "cpu"


def test_the_commands_of_the_page_on_rollouts_are_commands(repository: Path):
    page = (repository / "docs" / "rollouts.md").read_text(encoding="utf-8")
    (commands,) = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    names = [parse_arguments(command.split()[1:]).__class__.__name__ for command in commands.splitlines()]
    assert names == ["Simulate", "Simulate", "Fit", "Rollout"]


def test_the_reproduced_numbers_are_those_of_the_reproduction(repository: Path):
    document = json.loads((repository / "docs" / "reproduction" / "fig2b.json").read_text(encoding="utf-8"))
    readme = (repository / "README.md").read_text(encoding="utf-8")
    for model, curve in document["summary"]["curves"].items():
        cells = [
            f"{dict(zip(published.FIG2B_POINTS, published.FIG2B_MAE[model], strict=True))[count]:.4f} / "
            f"**{curve[str(count)]['mae']['median']:.4f}**"
            for count in (100, 200, 400, 1000)
        ]
        assert f"| {MODELS[model].label} | {' | '.join(cells)} |" in readme
