"""Faults put into the source one at a time, to see whether the fast tests notice: `make mutants`.

Each package of `PACKAGES` gets a sample of the faults that cosmic-ray's operators make (`-` for `+`, `<` for `<=`,
a number one larger, a condition negated, a decorator removed). A digest of the line and the operator ranks them, so
the same source has the same sample, and an edit changes little of it. Left out is what no test should notice:
annotations, error messages, `__repr__`, caches.

One run of a package's tests under coverage says which tests execute which line. A mutant then runs only those, one of
each test function first and quick ones first, for at most `--budget` CPU seconds by their usual time, in a fork of this
process: torch is imported once, forcegp not before the mutant lies in a copy of `src`. The checkout is not changed.

Results are kept in `.mutants/`: the same command goes on where the last one ended. A kill stays valid while the module
and the test that failed are unchanged, a survival while the module and the package's tests are. `--list` prints the
sample and runs nothing. `equivalent_mutants.toml` explains the survivors that behave as the original does; exit code 1
means that another one survived, or that fewer than 90 % were killed.
"""

from __future__ import annotations

import argparse
import compileall
import contextlib
import itertools
import json
import os
import py_compile
import resource
import shutil
import signal
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from tests.mutant_sample import REPOSITORY, Mutant, digest, mutants, python_files

FOLDER = REPOSITORY / ".mutants"
COPY = FOLDER / "src"
EXPLAINED = Path(__file__).with_name("equivalent_mutants.toml")
PACKAGES = ("inference", "mechanics", "robots", "forces", "data", "evidence", "posterior", "fit")
ENOUGH = 0.9
"""Share of killed mutants that is asked for."""
IMPORTED_ONCE = ("torch", "torch.func", "gpytorch", "scipy.optimize", "scipy.signal", "scipy.stats", "scipy.spatial")
IMPORTED_ONCE += ("hypothesis.strategies", "jaxtyping", "h5py", "safetensors.torch", "joblib", "pinocchio", "pytest")


class Watch:
    """Plugin of pytest: runs the named tests in the given order, and records seconds, outcomes and lines."""

    def __init__(self, chosen: list[str] | None = None, coverage: Any = None) -> None:
        self.chosen, self.coverage = chosen, coverage
        self.seconds: dict[str, float] = {}
        self.failed: list[str] = []

    def pytest_collection_modifyitems(self, items: list) -> None:
        """Keep the chosen tests."""
        if self.chosen is not None:
            order = {name: place for place, name in enumerate(self.chosen)}
            items[:] = sorted((item for item in items if item.nodeid in order), key=lambda item: order[item.nodeid])

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Lines from here on are this test's."""
        self.begin = time.process_time()
        if self.coverage is not None:
            self.coverage.switch_context(nodeid)

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        """So long it took."""
        self.seconds[nodeid] = time.process_time() - self.begin

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Remember what failed."""
        if report.failed:
            self.failed.append(report.nodeid)

    pytest_collectreport = pytest_runtest_logreport


def forked(work: Callable[[], object], seconds: float, log: Path) -> object:
    """What `work` returns in a fork of this process, None where it used more CPU seconds or died."""
    answer = log.with_suffix(".json")
    answer.unlink(missing_ok=True)
    child = os.fork()
    if child == 0:
        os.setpgid(0, 0)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds) + 1, int(seconds) + 5))
        resource.setrlimit(resource.RLIMIT_AS, (12 << 30, 12 << 30))  # a wrong shape may ask for all there is
        descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(descriptor, 1)
        os.dup2(descriptor, 2)
        sys.path.insert(0, str(COPY))
        os.environ |= {"PYTHONPATH": str(COPY), "XDG_CACHE_HOME": str(FOLDER / "cache")}
        try:
            answer.write_text(json.dumps(work()))
        finally:
            os._exit(0)
    deadline = time.monotonic() + 20 * seconds  # for one that sleeps; a busy machine does not reach it
    try:
        while os.waitpid(child, os.WNOHANG) == (0, 0) and time.monotonic() < deadline:
            time.sleep(0.02)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # it and the processes that it started
        with contextlib.suppress(ChildProcessError):
            os.waitpid(child, 0)
    return json.loads(answer.read_text()) if answer.exists() else None


def tested(chosen: list[str]) -> object:
    """The first of these tests that fails, or "" where none does."""
    import pytest

    sys.dont_write_bytecode = True
    watch = Watch(chosen)
    paths = list(dict.fromkeys(name.partition("::")[0] for name in chosen))
    code = int(pytest.main([*paths, "-x", "-q", *PYTEST], plugins=[watch]))
    return watch.failed[0] if watch.failed else ("" if code == 0 else f"exit code {code}")


# Pytest marks packages with plugins for rewriting; those are imported already, and the failed test's name is enough.
PYTEST = ["--assert=plain", "--tb=line", "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:randomly"]


def executed_lines(package: str, tests: list[str]) -> dict:
    """Seconds of every test, those that fail, and for every line of the package the tests that execute it."""
    import coverage
    import pytest

    cover = coverage.Coverage(data_file=None, source=[str(COPY / "forcegp" / package)], config_file=False)
    cover.start()
    watch = Watch(coverage=cover)
    pytest.main([*tests, "-q", *PYTEST], plugins=[watch])
    cover.stop()
    data = cover.get_data()
    lines = {
        str(Path(file).relative_to(COPY)): {str(line): names for line, names in data.contexts_by_lineno(file).items()}
        for file in data.measured_files()
    }
    return {"seconds": watch.seconds, "failed": watch.failed, "lines": lines}


def selected(mutant: Mutant, executed: dict, budget: float) -> list[str]:
    """Tests that execute the mutant's lines: one of each function first, quick ones first, up to so many seconds."""
    seconds = {name: used for name, used in executed["seconds"].items() if name not in executed["failed"]}
    lines = executed["lines"].get(mutant.module, {})
    touching = {name for line in mutant.lines for name in lines.get(str(line), []) if name in seconds}
    order: Counter[str] = Counter()
    turns = []
    for name in sorted(touching if mutant.lines else seconds, key=lambda name: (seconds[name], name)):
        function = name.partition("[")[0]
        turns.append((order[function], seconds[name], name))
        order[function] += 1
    chosen, total = [], 0.0
    for _, used, name in sorted(turns):
        if total + used <= budget or f"test_{Path(mutant.module).stem}.py::" in name:
            chosen.append(name)
            total += used
    return chosen or [name for _, _, name in sorted(turns)[:1]]


def result(package: str, mutant: Mutant, budget: float) -> tuple[str, str]:
    """The outcome of a mutant and the test that decided it: stored, or by running it."""
    stored = FOLDER / "results" / f"{package}-{digest(mutant.module, mutant.mutated)}.json"
    if stored.exists():
        outcome, by, tests, spent = json.loads(stored.read_text())
        if tests == tests_digest(package, by) and (outcome == "killed" or spent >= budget):
            return outcome, by
    chosen = selected(mutant, lines_of(package), budget)
    if not chosen:
        return "survived", "no test executes it"
    copy = COPY / mutant.module
    copy.write_text(mutant.mutated)
    usual = sum(lines_of(package)["seconds"][name] for name in chosen)
    by = forked(lambda: tested(chosen), 15 + 3 * usual, FOLDER / "last.log")
    copy.write_text(mutant.original)
    outcome = "timeout" if by is None else "killed" if by else "survived"
    content = json.dumps([outcome, by or "", tests_digest(package, str(by or "")), budget])
    write(stored, content)
    return outcome, str(by or "")


def lines_of(package: str) -> dict:
    """The tests of a package, their seconds and the lines that each executes; only files that changed run again."""
    if package in LINES:
        return LINES[package]
    stored = FOLDER / f"lines-{package}.json"
    texts = {str(file.relative_to(REPOSITORY)): file.read_text() for file in python_files(f"tests/{package}")}
    tests = {file: digest(text) for file, text in texts.items() if Path(file).name.startswith("test_")}
    source = [file.read_text() for file in python_files(f"src/forcegp/{package}")]
    key = digest(*(text for file, text in texts.items() if file not in tests), *source)
    known = json.loads(stored.read_text()) if stored.exists() else {}
    if known.get("key") != key:
        known = {"tests": {}, "seconds": {}, "failed": [], "lines": {}}
    stale = [file for file in tests if known["tests"].get(file) != tests[file]]

    def kept(name: str) -> bool:
        file = name.partition("::")[0]
        return file in tests and file not in stale

    new: object = {"seconds": {}, "failed": [], "lines": {}}
    if stale:
        new = forked(lambda: executed_lines(package, stale), 3600, FOLDER / f"lines-{package}.log")
    if not isinstance(new, dict):
        raise SystemExit(f"The tests of {package} did not end; see .mutants/lines-{package}.log.")
    for module, old in known["lines"].items():
        here = new["lines"].setdefault(module, {})
        for line, names in old.items():
            here[line] = [*here.get(line, []), *filter(kept, names)]
    seconds = {name: used for name, used in known["seconds"].items() if kept(name)} | new["seconds"]
    failed = [*filter(kept, known["failed"]), *new["failed"]]
    LINES[package] = {"key": key, "tests": tests, "seconds": seconds, "failed": failed, "lines": new["lines"]}
    write(stored, json.dumps(LINES[package]))
    return LINES[package]


LINES: dict[str, dict] = {}


def tests_digest(package: str, by: str) -> str:
    """Digest of the file of this test, or of all tests of the package."""
    file = REPOSITORY / by.partition("::")[0]
    chosen = [file] if file.is_file() else python_files(f"tests/{package}")
    return digest(*(file.read_text() for file in chosen))


def write(file: Path, content: str) -> None:
    """Whole or not at all."""
    file.parent.mkdir(exist_ok=True)
    temporary = file.with_suffix(".tmp")
    temporary.write_text(content)
    temporary.replace(file)


def main() -> int:
    """Run what is not known yet and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("packages", nargs="*", default=PACKAGES, metavar="PACKAGE", help=f"of {', '.join(PACKAGES)}")
    parser.add_argument("--count", type=int, default=50, help="mutants of each package (default: 50)")
    parser.add_argument("--budget", type=float, default=20.0, help="CPU seconds of tests for a mutant (default: 20)")
    parser.add_argument("--list", action="store_true", help="print the sample and run nothing")
    parser.add_argument("--fresh", action="store_true", help="forget the results of before")
    given = parser.parse_args()
    os.chdir(REPOSITORY)
    if given.list:
        for mutant in itertools.chain.from_iterable(mutants(package, given.count) for package in given.packages):
            print(mutant)
        return 0
    prepare(given.fresh)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended"))  # not without the forks
    explained = tomllib.loads(EXPLAINED.read_text()).get("mutant", []) if EXPLAINED.exists() else []
    reasons = {(each["module"], each["line"], each["mutant"]): each["why"] for each in explained}
    table: dict[str, Counter[str]] = {}
    used = set()
    for package in given.packages:
        table[package] = Counter()
        killers = set()
        for mutant in mutants(package, given.count):
            begin = time.monotonic()
            outcome, by = result(package, mutant, given.budget)
            reason = reasons.get((mutant.module, *mutant.change()))
            used.add((mutant.module, *mutant.change()))
            if outcome == "survived" and reason:
                outcome, by = "equivalent", reason
            table[package][outcome] += 1
            killers.add(by)
            print(f"{outcome:10} {time.monotonic() - begin:5.1f} s  {mutant}  [{by}]", flush=True)
        known = [name for name in lines_of(package)["seconds"] if name in killers]
        by = forked(lambda known=known: tested(known), 3600, FOLDER / f"control-{package}.log") if known else ""
        if by != "":
            raise SystemExit(f"{by} fails without a mutant, too, when run after others: its kills mean nothing.")
    for module, line, change in reasons.keys() - used:
        if module.split("/")[1] in given.packages:
            print(f"explained, but not in the sample: {module}: {line}  ->  {change}")
    return printed(table)


def prepare(fresh: bool) -> None:
    """The copy of the source, and what every fork shares."""
    if fresh:
        shutil.rmtree(FOLDER, ignore_errors=True)
    shutil.rmtree(COPY, ignore_errors=True)
    FOLDER.mkdir(exist_ok=True)
    shutil.copytree(REPOSITORY / "src", COPY, ignore=shutil.ignore_patterns("__pycache__"))
    # Checked by contents: by time and size, two mutants of the same second could pass for each other.
    compileall.compile_dir(COPY, quiet=1, invalidation_mode=py_compile.PycInvalidationMode.CHECKED_HASH)
    os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    for name in IMPORTED_ONCE:
        import_module(name)
    sys.modules["torch"].set_num_threads(1)


def printed(table: dict[str, Counter[str]]) -> int:
    """Print the counts; 1 where too few were killed or one survived without a reason."""
    outcomes = ("killed", "timeout", "equivalent", "survived")
    table["all"] = sum(table.values(), Counter())
    print(f"\n{'package':12}" + "".join(f"{outcome:>12}" for outcome in outcomes) + f"{'share killed':>14}")
    for package, counts in table.items():
        share = (counts["killed"] + counts["timeout"]) / max(counts.total(), 1)
        print(f"{package:12}" + "".join(f"{counts[outcome]:12}" for outcome in outcomes) + f"{share:14.1%}")
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"{(usage.ru_utime + usage.ru_stime + time.process_time()) / 60:.1f} CPU minutes")
    return int(share < ENOUGH or table["all"]["survived"] > 0)


if __name__ == "__main__":
    sys.exit(main())
