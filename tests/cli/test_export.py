"""`forcegp export` from end to end, and whatever can be asked wrongly."""

import errno
import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from tests.posterior.arm import arm_data

QUICK = ("--points", 12, "--iterations", 2, "--restarts", 1, "--no-checks")
FILES = {"arm.c", "arm.h", "arm.hpp", "CMakeLists.txt", "example.c", "self_test.c", "README.txt"}


@pytest.fixture(scope="module")
def folder(forcegp, tmp_path_factory):
    """A model of the small arm, and a folder of something else."""
    place = tmp_path_factory.mktemp("export")
    arm_data(40, 0).save(place / "arm.h5")
    forcegp("fit", "arm.h5", *QUICK, "--out", "run", folder=place).ok()
    (place / "mine").mkdir()
    (place / "mine" / "thesis.txt").write_text("years of work")
    return place


@pytest.mark.skipif(not shutil.which("cc"), reason="needs a C compiler")
def test_a_model_becomes_a_program(forcegp, folder):
    words = ("export", "run", "--to", "c", "--out", "deployed", "--steps", 0.02)
    summary, out = json.loads(forcegp(*words, "--json", folder=folder).ok().stdout), folder / "deployed"
    assert set(summary["files"]) == FILES
    assert {file.name for file in out.iterdir()} == FILES | {"config.json", "SHA256SUMS"}
    assert set(summary["differences"]) == {"arm_mean", "arm_step", "arm_inverse_dynamics", "arm_forces"}
    assert summary["differences"]["arm_mean"] < 5e-12
    assert "model: run" in (out / "arm.h").read_text()
    subprocess.run(["cc", "-std=c99", "self_test.c", "arm.c", "-o", "../x", "-lm"], cwd=out, check=True)
    assert subprocess.run(["../x"], cwd=out, capture_output=True, check=False).returncode == 0

    forcegp(*words, folder=folder).refused("add --overwrite")
    shown = forcegp(*words, "--overwrite", "--unchecked", folder=folder)
    assert shown.returncode == 0
    assert "self_test.c" in shown.stdout
    assert "arm_mean" not in shown.stdout  # nothing was compared


@pytest.mark.usefixtures("unchecked")  # explicit steps add and scale CasADi's expressions as they do tensors
def test_a_model_becomes_casadi_functions(forcegp, folder):
    casadi = pytest.importorskip("casadi", reason="CasADi is not installed: pip install 'forcegp[casadi]'")
    words = ("export", "run", "--to", "casadi", "--out", "planner", "--steps", 0.02, "--integrator", "rk4")
    differences = json.loads(forcegp(*words, "--json", folder=folder).ok().stdout)["differences"]
    assert differences["arm.casadi"] < 1e-11
    assert differences["arm_step.casadi"] < 1e-8
    assert casadi.Function.load(str(folder / "planner" / "arm_step.casadi")).name_out() == ["q_next", "v_next"]
    refused = forcegp("export", "run", "--to", "casadi", "--out", "never", "--jacobian", folder=folder)
    refused.refused("--jacobian is for --to c")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("run", "--steps", 0), "dt is 0.0; give the time step as a positive number of seconds"),
        (("run", "--integrator", "rk4"), "--integrator was given without --steps"),
        (("run", "--steps", 0.1, "--integrator", "leap"), "no integrator 'leap'"),
        (("nowhere",), "nowhere does not exist; give the folder that `forcegp fit --out` wrote"),
    ],
)
def test_what_cannot_be_exported_is_one_line(forcegp, folder, words, message):
    done = forcegp("export", *words, "--to", "c", "--out", "never", folder=folder)
    assert (done.refused(message), done.stdout) == (done.stderr.strip(), "")
    assert not (folder / "never").exists()
    assert not list(folder.glob(".*"))


@pytest.mark.parametrize("target", ["c", "casadi"])
@pytest.mark.parametrize(
    ("out", "message"),
    [("arm.h5/deployed", "arm.h5"), ("/proc/deployed", "/proc"), ("mine", "was not written by `forcegp export`")],
)
def test_a_folder_that_cannot_be_written_is_one_line(forcegp, folder, target, out, message):
    before = sorted(folder.rglob("*"))
    done = forcegp("export", "run", "--to", target, "--out", out, "--overwrite", folder=folder)
    assert (done.refused(message), done.stdout) == (done.stderr.strip(), "")
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize(("target", "file"), [("c", "arm.h"), ("casadi", "arm.casadi")])
def test_a_full_disk_is_one_line_and_leaves_the_old_program(forcegp, folder, monkeypatch, target, file):
    if target == "casadi":
        pytest.importorskip("casadi", reason="CasADi is not installed: pip install 'forcegp[casadi]'")
    words = ("export", "run", "--to", target, "--out", f"kept-{target}", *(("--unchecked",) if target == "c" else ()))
    assert forcegp(*words, folder=folder).returncode == 0
    before = {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
    write = Path.write_bytes

    def full(path, *given, **more):
        if path.name == file:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        return write(path, *given, **more)

    monkeypatch.setattr(Path, "write_bytes", full)
    monkeypatch.setattr(Path, "write_text", lambda path, text, **_: full(path, text.encode()))
    forcegp(*words, "--overwrite", folder=folder).refused("No space left on device")
    assert {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()} == before
