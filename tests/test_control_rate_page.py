"""The example of docs/how-to/control-rate.md runs as it stands."""

import re
from pathlib import Path

import pytest
from tests.examples import run_example


@pytest.mark.nightly  # tests of predictors ask each function
def test_the_page_on_control_rates_runs(repository: Path, tmp_path: Path):
    page = (repository / "docs" / "how-to" / "control-rate.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    printed = run_example(example, tmp_path)
    rank, one, linear, many, step, inverse, gradient = printed.splitlines()
    found, excess = re.fullmatch(r"rank (\d+), standard deviations at most (\S+)% too large", rank).groups()
    assert 1 < int(found) <= 300
    assert 0.0 < float(excess) <= 1.0
    assert one == "torch.Size([7]) torch.Size([7, 7])"
    assert linear == "torch.Size([7, 7]) torch.Size([7, 7]) torch.Size([7, 7])"
    assert step == "torch.Size([14, 14]) torch.Size([14, 7]) torch.Size([14])"
    assert inverse == one
    assert (many, gradient) == ("torch.Size([1000, 7])", "torch.Size([7])")
