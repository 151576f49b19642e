"""The examples of docs/how-to/control.md: they run, and with the tools of others where these are installed."""

import pytest
from tests.examples import blocks, run_example


@pytest.fixture(scope="module")
def examples() -> list[str]:
    return blocks("control")


@pytest.mark.nightly
def test_the_examples_run(examples, tmp_path):
    pytest.importorskip("gymnasium")
    pytest.importorskip("mujoco")
    printed = run_example("".join(examples[:5]), tmp_path).splitlines()
    limited, plan, states, many, lasted, *touched, rows, kept = printed
    assert (lasted, rows, kept) == ("True", "2400", "True True")
    assert touched == []
    assert (tmp_path / "next.csv").exists()
    assert many == "(64, 14)"
    assert limited == "torch.Size([7]) tensor(False)"
    assert (plan, states) == ("torch.Size([7])", "torch.Size([5, 14])")
