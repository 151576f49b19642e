"""The benchmark for GPUs runs on the CPU, says what it needs where there is no GPU, and compares devices."""

import json
import subprocess
import sys

import pytest
import torch
from benchmarks import gpu

from forcegp.inference.memory import gib


@pytest.fixture(scope="module")
def run(repository):
    def run(*words):
        command = [sys.executable, "-m", "benchmarks.gpu", *words]
        return subprocess.run(command, cwd=repository, capture_output=True, text=True, check=False)

    return run


@pytest.mark.nightly
def test_the_script_works_on_the_cpu(run, repository):
    before = gpu.RESULTS.exists()
    done = run("--device", "cpu", "--small")
    assert done.returncode == 0, done.stderr
    rows = [line for line in done.stdout.splitlines() if line.startswith("| ") and " s |" in line]
    assert len(rows) == sum(len(sizes) for sizes in gpu.SMALL.values())
    assert gpu.RESULTS.exists() == before  # only what ran on a GPU is written


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
@pytest.mark.nightly
def test_without_a_gpu_it_says_in_one_line_what_it_needs(run):
    done = run()
    assert done.returncode == 2
    assert not done.stdout
    (line,) = done.stderr.splitlines()
    assert "there is cpu" in line
    assert f"N = 8000 {gib(gpu.required_bytes(8000))}" in line


@pytest.mark.skipif(not torch.cuda.is_available(), reason="this machine has no GPU")
def test_a_gpu_computes_the_same_numbers(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu, "RESULTS", tmp_path / "gpu_results.json")
    assert gpu.main(["--small"]) == 0
    found = json.loads(gpu.RESULTS.read_text())["results"]["cuda"]
    apart = [value for key, value in found.items() if key.endswith("_apart")]
    assert apart
    assert max(apart) < 1e-6


def test_the_estimate_counts_three_covariances_and_three_kernels_of_each_joint():
    assert gpu.required_bytes(100) == 3 * 8 * 600**2 + 3 * 7 * 8 * 100**2
