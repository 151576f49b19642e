"""The commands from end to end on real files."""

import contextlib
import functools
import hashlib
import json
import os
import pty
import re
import signal
import subprocess

import numpy as np
import pytest
from tests.goldens.compare import assert_unchanged, numbers_in

from forcegp import Dataset, load_posterior, score

PNG = b"\x89PNG\r\n\x1a\n"


def test_simulate_writes_the_dataset_that_its_summary_describes(workshop):
    summary, data = json.loads((workshop / "train.json").read_text()), Dataset.load(workshop / "train.h5")
    assert summary["rows"] == len(data) == 480
    assert summary["joint_names"] == list(data.joint_names)
    assert summary["config"]["seed"] == data.metadata["config"]["seed"] == 1
    np.testing.assert_array_equal(data.noise_std, summary["noise_std"])
    np.testing.assert_array_equal(data.noise_std, np.full(7, 0.1))
    assert set(summary["truth"]) == {"Q_U", "Q_U.tool-friction", "a", "force.tool-friction", "lambda"}
    assert Dataset.load(workshop / "test.h5").metadata["config"]["seed"] == 2


def test_fit_writes_a_model_and_everything_needed_to_repeat_it(workshop):
    run = workshop / "run"
    config = json.loads((run / "config.json").read_text())
    assert config["kind"] == "forcegp fit"
    assert config["options"]["points"] == config["resolved"]["points"] == 15
    assert config["options"]["forces"] == ["gp:joint"]
    assert config["resolved"]["noise"]["acceleration"] == [0.1] * 7
    assert config["data"]["sha256"] == hashlib.sha256((workshop / "train.h5").read_bytes()).hexdigest()
    assert {"python", "torch", "forcegp"} <= config["versions"].keys()
    assert sorted(config["files"]) == sorted(file.name for file in run.iterdir())
    posterior = load_posterior(run)
    assert len(posterior.result.history) - 1 <= 8
    assert len(posterior.settings["restart_objective"]) == 2
    told = (workshop / "fit.txt").read_text()
    assert "learned from 15 points" in told
    assert f"{posterior.negative_log_likelihood:.1f} nats" in told
    assert "forcegp score run TEST.h5" in told


def test_score_prints_exactly_one_json_object(workshop, forcegp):
    done = forcegp("score", "run", "train.h5", "--every", 4, "--json", folder=workshop).ok()
    content = json.loads(done.stdout)
    scores = content["models"]["run"]["scores"]
    assert scores["constraint"]["mae"]["all"]["median"] < 1e-10
    medians = {name: {score: (each["all"] or {}).get("median") for score, each in own.items()}
               for name, own in scores.items()}  # fmt: skip
    assert_unchanged("cli/scores", {"scores": medians, "told": numbers_in(done.stderr)}, rtol=1e-2)
    expected = score(load_posterior(workshop / "run"), Dataset.load(workshop / "train.h5").rows(slice(None, None, 4)))
    np.testing.assert_allclose(scores["acceleration"]["mae"]["each"], expected.columns("mae"), rtol=1e-6)
    (warning,) = [each for each in content["warnings"] if "training rows" in each]
    assert re.search(r"\d of 120 test rows have the very \(q, v, u\) of training rows", warning)
    assert f"warning: {warning}" in done.stderr


def test_score_shows_a_line_per_joint_and_draws(workshop, forcegp, tmp_path):
    words = ("score", "run", "test.h5", "--every", 8, "--out", tmp_path / "out")
    done = forcegp(*words, folder=workshop).ok()
    lines = re.findall(r"^\s*lbr_iiwa_joint_\d\s.*$", done.stdout, re.M)
    assert (len(lines), len({len(line.split()) for line in lines})) == (7, 1)
    assert re.search(r"contact force +\S+ +\S+ +\S+ +– +\S+ %", done.stdout)
    assert (tmp_path / "out" / "normal_force.png").read_bytes().startswith(PNG)
    assert json.loads((tmp_path / "out" / "results.json").read_text())["rows"] == 60
    assert "95 % intervals contain" in (tmp_path / "out" / "report.html").read_text()


def test_the_demo_tells_the_whole_story(forcegp, tmp_path, monkeypatch):
    small = ("demo", "--seconds", "1", "--points", "12", "--iterations", "3", "--overwrite")
    monkeypatch.setattr("forcegp.report.page.model_pictures", lambda *_: ([], []))  # as drawn for a score
    done = forcegp(*small, folder=tmp_path).ok()
    for row in ("S-GP ", "S-GP + analytical mean"):
        assert re.search(rf"^\s*{re.escape(row)}.*\d\.\d{{4}}", done.stdout, re.M), done.stdout
    results = json.loads((tmp_path / "demo" / "results.json").read_text())
    assert results["seeds"] == {"train": 21, "test": 22}
    models = results["models"]
    assert list(models) == ["S-GP", "S-GP + analytical mean"]
    warnings = results["scores"]["warnings"]
    assert not any("of the data" in warning for warning in warnings)
    for name, model in models.items():
        assert results["scores"]["models"][name]["scores"]["constraint"]["mae"]["all"]["median"] < 1e-10
        assert any(warning.startswith(f"{name}: the search") for warning in warnings)
        assert 0 < model["fit"]["wall_seconds"] < results["wall_seconds"]
        assert len(load_posterior(tmp_path / model["run"]).likelihood.training.q) == 12
    assert "95 % intervals contain" in (tmp_path / "demo" / "report.html").read_text()
    assert [entry.name for entry in tmp_path.iterdir()] == ["demo"]


@pytest.mark.nightly
def test_ctrl_c_ends_in_one_line_and_leaves_nothing_behind(executable, tmp_path):
    screen, terminal = pty.openpty()
    command = [executable, "simulate", "kuka-surface", "--seconds", "5000", "--out", "long.h5"]
    heard = functools.partial(signal.signal, signal.SIGINT, signal.default_int_handler)  # also in the background
    to = {"stdout": subprocess.DEVNULL, "stderr": terminal, "preexec_fn": heard}
    with subprocess.Popen(command, cwd=tmp_path, **to) as process:
        os.close(terminal)
        seen = b""
        while b" left " not in seen:  # the bar tells the remaining time, so the work is under way
            seen += os.read(screen, 4096)
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(OSError):  # how Linux reports the end of a terminal; others with an empty read
            while chunk := os.read(screen, 4096):
                seen += chunk
        assert process.wait(600) == 130  # a guard against a hang
    os.close(screen)
    assert b"forcegp: interrupted; no partial output was kept." in seen.splitlines()[-1]
    assert b"Traceback" not in seen
    assert list(tmp_path.iterdir()) == []
