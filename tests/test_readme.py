"""The README's Python example runs as it stands and prints what its comments say."""

import json
import re
import shlex
from pathlib import Path

import pytest
from benchmarks.paper import published
from benchmarks.paper.fits import MODELS
from tests.examples import run_example
from tests.prose import sentences, words

from forcegp import KukaSurfaceConfig, simulate_kuka_surface
from forcegp.cli.main import parse_arguments
from forcegp.forces import KERNELS, parse_forces
from forcegp.forces.registry import is_unknown


def test_the_python_example_runs(repository: Path, tmp_path: Path):
    (example,) = re.findall(r"```python\n(.*?)```", (repository / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert len([line for line in example.splitlines() if line.strip()]) <= 12
    acceleration, forces, error = run_example(example, tmp_path).splitlines()
    assert acceleration == "torch.Size([1200, 7]) torch.Size([1200, 7, 7])"
    assert forces == "torch.Size([1200, 1]) torch.Size([1200, 7])"
    assert float(error.split()[3]) < 0.2
    assert {path.name for path in (tmp_path / "model").iterdir()} == {
        "model.json", "tensors.safetensors", "robot.urdf", "SHA256SUMS",
    }  # fmt: skip


def test_the_pictures_and_pages_that_it_names_exist(repository: Path):
    links = re.findall(r"\]\(([^)#]+)\)", (repository / "README.md").read_text(encoding="utf-8"))
    assert not [link for link in links if not link.startswith("http") and not (repository / link).exists()]


def test_it_is_short_and_the_answer_is_the_one_that_was_measured(repository: Path):
    readme = (repository / "README.md").read_text(encoding="utf-8")
    assert len(readme.split()) <= 600
    assert max(len(words(sentence)) for sentence in sentences(readme)) <= 30
    answer = (repository / "docs" / "how-to" / "auto" / "answer.txt").read_text(encoding="utf-8")
    assert f"```text\n{answer}```" in readme
    assert f"```text\n{answer}```" in (repository / "docs" / "how-to" / "auto.md").read_text(encoding="utf-8")


ROBOTS = {"EMPS": 0, "passive pendulum": 1, "driven double pendulum": 2}
"""How a row of the README begins -> the column of the page with its motions."""
COLUMNS = (
    "as given", "independent GP, without physics", "identified by accelerations",
    "`joint-friction` beside the identified model",
)  # fmt: skip


def test_results_and_torques_of_real_robots_are_those_of_their_page(repository: Path):
    readme = (repository / "README.md").read_text(encoding="utf-8")
    page = (repository / "docs" / "benchmarks" / "real-robots.md").read_text(encoding="utf-8")
    lines = (line.split("|") for line in page.splitlines())
    rows = {cells[1].strip(): cells[2:5] for cells in lines if len(cells) == 6}
    for robot, column in ROBOTS.items():
        (quantity, shown) = re.findall(rf"^\| {robot}[^|]*\|([^|]*)\|(.*)\|$", readme, re.MULTILINE)[0]
        if "nRMSE" in quantity:  # which the page has of the recommended model alone
            assert "nRMSE .022 against .040" in rows["**for accelerations**"][column]
            assert [cell.strip(" *") for cell in shown.split("|")][2:] == [".040", ".022"]
            continue
        for model, cell in zip(COLUMNS, shown.split("|"), strict=True):
            assert cell.strip(" *") == rows[model][column].split(",")[2].strip(" *"), (robot, model)
    (least, learned) = re.findall(r"^\| Stäubli TX40 .*\| ([\d.]+) \| \*\*([\d.]+)\*\* \|$", readme, re.MULTILINE)[0]
    (of_page, ratio) = re.findall(r"^\| Stäubli TX40 \| ([\d.]+) Nm \|[^|]*\| \*\*([\d.]+)", page, re.MULTILINE)[0]
    assert least == of_page
    assert abs(float(learned) - float(ratio) * float(least)) < 0.01


def test_errors_of_tracking_are_those_of_the_benchmark(repository: Path):
    page = (repository / "docs" / "benchmarks" / "control.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| computed torque, ([^|]*)\| \**([\d.]+)", page, re.MULTILINE)
    (urdf, laws, learned, true) = (value for _, value in rows)
    for name in ("README.md", "docs/start/features.md"):
        shown = (repository / name).read_text(encoding="utf-8")
        assert {f"{float(urdf):.0f} mrad", f"**{learned} mrad**"} <= set(re.findall(r"\**[\d.]+ mrad\**", shown)), name
        assert f"{float(laws):.1f}" in shown
        assert true in shown


def test_the_times_of_the_features_are_those_of_the_benchmarks(repository: Path):
    """docs/start/features.md repeats some numbers of benchmarks/results.json."""
    measured = json.loads((repository / "benchmarks" / "results.json").read_text(encoding="utf-8"))
    shown = (repository / "docs" / "start" / "features.md").read_text(encoding="utf-8")
    for text in (
        "{nll_speedup_n400:.1f} times faster than the paper's dense formulation at N = 400",
        "{nll_speedup_n1000:.1f} times at N = 1000",
        "it is {nll_vs_cholesky_n400:.1f} times faster with one contact",
    ):
        assert text.format(**measured) in shown, text
    page = (repository / "docs" / "paper" / "reproduction.md").read_text(encoding="utf-8")
    (hours,) = re.findall(r"^(\S+ CPU-hours) for", page, re.MULTILINE)
    assert f"It takes {hours}" in shown


@pytest.mark.nightly
def test_the_page_on_forces_runs(repository: Path, tmp_path: Path):
    page = (repository / "docs" / "how-to" / "forces.md").read_text(encoding="utf-8")
    example, *_ = re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)  # others have own tests
    tool, total, curve, error, free = run_example(example, tmp_path).splitlines()
    assert tool == "torch.Size([2400, 1]) torch.Size([2400, 7, 7]) torch.Size([2400, 3])"
    assert total == "torch.Size([2400, 7]) torch.Size([2400, 1])"
    assert re.fullmatch(r"sliding speed \[m/s\] from \S+ to \S+, 200 values in N", curve)
    assert float(error.split()[-2]) < 20.0
    assert free == "torch.Size([2400, 0])"
    assert {"friction.png", "normal-force.png"} <= {path.name for path in tmp_path.iterdir()}


def test_the_commands_and_forces_of_the_page_on_forces_exist(repository: Path):
    page = (repository / "docs" / "how-to" / "forces.md").read_text(encoding="utf-8")
    rows = page.partition("## Which force?")[2].partition("\n## ")[0]
    told = {name.partition(":")[0] for name in re.findall(r"^\| `([^`]+)` \|", rows, re.MULTILINE)}
    assert all(is_unknown(name) for name in told)
    assert len(told) == 9
    rows = page.partition("## Kernels")[2].partition("\n## ")[0]
    cells = re.findall(r"^\| (`[^|]+) \|", rows, re.MULTILINE)
    told = {name for cell in cells for name in re.findall(r"`(.+?)`", cell)}
    assert told == set(KERNELS)
    model, count = simulate_kuka_surface(KukaSurfaceConfig(seconds=0.1)).model, 0
    for commands in re.findall(r"```sh\n(.*?)```", page, re.DOTALL):
        for line in re.findall(r"^forcegp (.*)$", commands.replace("\\\n", " "), re.MULTILINE):
            command = parse_arguments(shlex.split(line))
            for force in parse_forces([x for x in getattr(command, "forces", None) or () if x not in ("only", "none")]):
                count += 1
                model.with_forces(force)
    assert count > 6


def test_the_reproduced_numbers_are_those_of_the_reproduction(repository: Path):
    document = json.loads((repository / "docs" / "paper" / "reproduction" / "fig2b.json").read_text(encoding="utf-8"))
    readme = (repository / "docs" / "start" / "features.md").read_text(encoding="utf-8")
    for model, curve in document["summary"]["curves"].items():
        cells = [
            f"{published.FIG2B_MAE[model][count]:.4f} / **{curve[str(count)]['mae']['median']:.4f}**"
            for count in (100, 200, 400, 1000)
        ]
        assert f"| {MODELS[model].label} | {' | '.join(cells)} |" in readme
