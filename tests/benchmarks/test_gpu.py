"""The benchmark for GPUs compares devices, and says what it needs."""

import json

import pytest
import torch
from benchmarks import gpu


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
