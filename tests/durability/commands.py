"""Every command that writes, as small as it goes, and what is expected of its output whatever happens meanwhile."""

import json
import math
import os
import subprocess
import sys
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from tests.fuzz.made import PAIR

from forcegp import Dataset, load_posterior
from forcegp.atomic_files import require_unchanged

FEW = "--points 10 --iterations 3 --restarts 1"
SCORE = "--split blocks:5:3 --forces given --seeds 1 --points 10 --starts 1 --horizon 0.02"


@dataclass(frozen=True)
class Writing:
    """A command line in which OUT stands for its output, which is a "file", a "folder", or a "store" of jobs."""

    words: str
    kind: str = "folder"
    again: str = " --overwrite"

    def line(self, out: object, *, again: bool = False) -> list[str]:
        """The arguments, `again` where the output is there already."""
        return [str(out) if word == "OUT" else word for word in (self.words + self.again * again).split()]

    def require_whole(self, out: Path) -> None:
        """Fail unless the output is complete and as it was written."""
        if self.kind == "file":
            assert len(Dataset.load(out)) > 0
        elif self.kind == "store":
            assert (out / "jobs.json").exists()
            for job in out.glob("jobs/**/job.json"):
                json.loads(job.read_text())
        else:
            require_unchanged(out, "")
            for model in (file.parent for file in out.rglob("model.json")):
                load_posterior(model)


COMMANDS = {
    "simulate": Writing("simulate kuka-surface --seconds 1 --out OUT", "file"),
    "import": Writing("import log.csv --time time --q q_a,q_a --u u_a,u_a --robot pair.urdf --out OUT", "file"),
    "prepare": Writing("import train.h5 --cutoff 20 --out OUT", "file"),
    "fit": Writing(f"fit train.h5 {FEW} --out OUT"),
    "identification": Writing("fit air.h5 --forces bodies,viscous --no-checks --out OUT"),
    "demo": Writing("demo --seconds 2 --points 10 --iterations 2 --out OUT"),
    "score": Writing(f"score train.h5 {SCORE} --out OUT", "store", again=""),
}
KILLED = ("simulate", "import", "fit", "identification", "score")


def make_inputs(folder: Path, forcegp) -> None:
    """What the commands read: two recordings on a surface, one in the air, a log and a model."""
    for name, more in (("train", ()), ("test", ("--seed", 2)), ("air", ("--surface", "none"))):
        forcegp("simulate", "kuka-surface", "--seconds", 2, *more, "--out", f"{name}.h5", folder=folder).ok()
    assert forcegp("fit", "train.h5", *FEW.split(), "--out", "run", folder=folder).returncode == 0
    rows = (f"{k / 200},{math.sin(k / 60)},{math.cos(k / 90)}" for k in range(20_000))
    (folder / "pair.urdf").write_text(PAIR)
    (folder / "log.csv").write_text("time,q_a,u_a\n" + "\n".join(rows) + "\n")


def start(line: list[str], folder: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "forcegp", *line]
    streams = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, cwd=folder, env={**os.environ, "COLUMNS": "100"}, text=True, **streams)


def run(line: list[str], folder: Path) -> tuple[int, str]:
    """Exit code and stderr of the command as a process of its own."""
    process = start(line, folder)
    _, errors = process.communicate(timeout=1200)
    return process.returncode, errors


def assert_one_line(code: int, errors: str) -> None:
    """Done, or an error of the user in one line at the end."""
    assert code in (0, 2), errors
    own = [text for text in errors.splitlines() if text.startswith("forcegp: ")]
    assert len(own) == (code == 2), errors
    assert "Traceback" not in errors, errors
    assert "Exception ignored" not in errors, errors
    if own:
        assert errors.splitlines()[-1] == own[0], errors


def snapshot(path: Path) -> dict[str, str]:
    """Digests of a file, or of every file of a folder."""
    root, files = (path.parent, [path]) if path.is_file() else (path, [x for x in path.rglob("*") if x.is_file()])
    return {str(file.relative_to(root)): sha256(file.read_bytes()).hexdigest() for file in files}


def leftovers(folder: Path) -> list[str]:
    """Hidden files and folders that no run should leave; a store keeps its lock."""
    return [str(entry.relative_to(folder)) for entry in folder.rglob(".*") if entry.name != ".lock"]
