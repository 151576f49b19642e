"""What every random input must end in, and the search that feeds it: each distinct defect is named once, by a case.

The seed is that of the day, so that every day tries other cases. `FORCEGP_FUZZ_SEED=20260101` repeats a day, and
`FORCEGP_FUZZ_CASES=5000` runs so many cases of each target.
"""

import contextlib
import datetime
import os
import resource
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis.strategies import SearchStrategy
from tests.cli.in_process import run_here

import forcegp
from forcegp.errors import ForceGPError

SEED = int(os.environ.get("FORCEGP_FUZZ_SEED") or datetime.date.today().strftime("%Y%m%d"))
LONGEST = 60.0  # CPU seconds of one case
MOST_MEMORY = 2**30  # bytes by which the memory of this process may grow
CANARY = "canary"  # a folder that code hidden in a file would make
PACKAGE = str(Path(forcegp.__file__).parent)


class DefectError(AssertionError):
    """An input that did not end as it has to."""


@dataclass(frozen=True)
class Target:
    """`check(case, folder)` raises for a defect; `cases` gives the cases; in the fast tier so many of them run."""

    cases: SearchStrategy[Any]
    check: Callable[[Any, Path], None]
    fast: int
    nightly: int


def search(target: Target, folder: Path, count: int) -> None:
    """Run `count` cases, each in an empty folder; fails with every distinct defect and its shortest case."""
    count = int(os.environ.get("FORCEGP_FUZZ_CASES") or count)
    defects: dict[str, tuple[str, str]] = {}
    ran = 0

    @seed(SEED)
    @settings(
        max_examples=count, deadline=None, database=None, derandomize=False, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(target.cases)
    def one(case: Any) -> None:
        nonlocal ran
        ran += 1
        top = Path(tempfile.mkdtemp(dir=folder))
        own = top / "some" / "folders" / "deep"
        own.mkdir(parents=True)
        try:
            with limited(), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of numbers that overflow, say
                target.check(case, own)
        except Exception as error:
            key, text = _place(error), repr(case)
            if key not in defects or len(text) < len(defects[key][0]):
                defects[key] = text, "".join(traceback.format_exception(error)[-4:])
        finally:
            shutil.rmtree(top, ignore_errors=True)

    one()
    found = "\n\n".join(f"--- {key}\ncase: {text[:3000]}\n{told[:4000]}" for key, (text, told) in defects.items())
    print(f"{ran} cases, {len(defects)} defects")
    assert not defects, f"FORCEGP_FUZZ_SEED={SEED}, {ran} cases, {len(defects)} distinct defects\n\n{found}"


def _place(error: Exception) -> str:
    """What kind of defect this is: the type, and the last line of forcegp on the way."""
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.startswith(PACKAGE)]
    where = f"{Path(own[-1].filename).name}:{own[-1].lineno}" if own else ""
    said = str(error).split(":")[0][:60] if isinstance(error, DefectError) else ""
    return f"{type(error).__name__} {said} {where}"


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """Raise DefectError after `LONGEST` CPU seconds, and where the memory of this process grew too far."""

    def stop(*_: object) -> None:
        raise DefectError("hangs")

    before, handler = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, LONGEST)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, handler)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * (1 if sys.platform == "darwin" else 1024)
    if grown > MOST_MEMORY:
        raise DefectError(f"needs too much memory: {grown >> 20} MiB")


def allowed(*more: type[Exception]) -> contextlib.AbstractContextManager[None]:
    """`with allowed():` what forcegp may raise for input that is wrong."""
    return contextlib.suppress(ForceGPError, *more)


def require_no_code(folder: Path) -> None:
    """Raise DefectError where something in a file was executed."""
    if any(folder.rglob(CANARY)) or Path(CANARY).exists():
        raise DefectError("code was executed")


def snapshot(folder: Path) -> dict[str, str]:
    """Every file and folder, with a digest of what it holds."""
    found = {}
    for path in folder.rglob("*"):
        content = sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
        found[os.fsdecode(os.path.relpath(path, folder))] = content
    return found


def require_ended_well(words: list[str], folder: Path) -> int:
    """Run a command line there: 0, or 2 with one line and nothing written; returns the code, raises DefectError."""
    top = folder.parents[2]  # so that what ".." names is seen, too
    before, done = snapshot(top), run_here(*words, folder=folder)
    after, own = snapshot(top), [line for line in done.stderr.splitlines() if line.startswith("forcegp: ")]
    if done.returncode not in (0, 2) or "Traceback" in done.stderr or "Exception ignored" in done.stderr:
        raise DefectError(f"exit {done.returncode}: {own or done.stderr[-600:]}")
    if done.returncode == 2 and (len(own) != 1 or done.stderr.splitlines()[-1] != own[0]):
        raise DefectError(f"not one line: {done.stderr[-600:]}")
    if done.returncode == 2 and "out of memory" in own[0]:
        raise DefectError(f"needs too much memory: {own[0]}")
    if done.returncode == 2 and after != before:
        raise DefectError(f"refused and wrote: {sorted(set(after.items()) ^ set(before.items()))}")
    lost = {name for name, digest in before.items() if after.get(name) != digest}
    if lost and "--overwrite" not in words:
        raise DefectError(f"changed its inputs: {lost}")
    require_no_code(top)
    return done.returncode
