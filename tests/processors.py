"""The tests as other processors run them: `make test-processors`, or `make test-processors ARGS="tests/inference"`.

Linear algebra and vector instructions are chosen by processor, so the last bits of a result differ between machines.
Variables of OpenBLAS (numpy, scipy), of torch and of MKL (torch on Intel and AMD) choose them as on another one; two
threads and a machine at work on something else change the order of operations and the clock.

Every variant runs, whatever failed before. Results are kept in `.processors/` by the contents of src and tests: the
same command goes on after the last one that ended, and computes anew what changed. A table is printed at the end.
"""

import argparse
import contextlib
import hashlib
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
FOLDER = REPOSITORY / ".processors"
BUSY = 6  # processes that compute beside the tests in the variant `loaded`

VARIANTS: dict[str, dict[str, str]] = {
    "as-it-is": {}, **{f"openblas-{core}": {"OPENBLAS_CORETYPE": core} for core in ("Haswell", "SkylakeX", "Zen")},
    **{f"torch-{kind}": {"ATEN_CPU_CAPABILITY": kind} for kind in ("default", "avx2", "avx512")},
    **{f"mkl-{branch}": {"MKL_CBWR": branch} for branch in ("COMPATIBLE", "AVX2", "AVX512")},
    "two-threads": {"FORCEGP_TEST_THREADS": "2"}, "loaded": {},
}  # fmt: skip


def main() -> int:
    """Run what is asked for and not done; 1 where anything failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=VARIANTS, metavar="VARIANT", help=f"out of {', '.join(VARIANTS)}")
    parser.add_argument("--fresh", action="store_true", help="run again what has ended before, too")
    parser.add_argument("--workers", default="2", help="of pytest-xdist (default: 2)")
    given, arguments = parser.parse_known_args()
    FOLDER.mkdir(exist_ok=True)
    code, rows = contents(), []
    for name in given.only or possible():
        key = hashlib.sha256(json.dumps([code, name, arguments]).encode()).hexdigest()[:16]
        file = FOLDER / f"{name}-{key}.json"
        if given.fresh or not file.exists():
            result = run(
                name, ["-n", given.workers, "--dist", "loadfile", "-q", *arguments], FOLDER / f"{name}-{key}.log"
            )
            temporary = file.with_suffix(".tmp")
            temporary.write_text(json.dumps(result))
            temporary.replace(file)  # so that what was interrupted is run again
        rows.append((name, json.loads(file.read_text()), file.with_suffix(".log")))
        print(line(*rows[-1]), flush=True)
    print("\n".join(["", *(line(*row) for row in rows)]))
    return int(any(result["code"] for _, result, _ in rows))


def possible() -> list[str]:
    """The variants that mean something to the torch that is installed."""
    import torch

    return [name for name in VARIANTS if not name.startswith("mkl-") or torch.backends.mkl.is_available()]


def contents() -> str:
    """A digest of everything that the tests read."""
    digest = hashlib.sha256()
    files = (file for folder in ("src", "tests", "benchmarks", "docs") for file in (REPOSITORY / folder).rglob("*"))
    for file in sorted(file for file in files if file.is_file() and "__pycache__" not in file.parts):
        digest.update(str(file.relative_to(REPOSITORY)).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def run(name: str, arguments: list[str], log: Path) -> dict[str, object]:
    """One run of pytest: its exit code, seconds, last line, and the tests that failed."""
    environment, begin = {**os.environ, **VARIANTS[name]}, time.monotonic()
    with log.open("w") as output, busy(BUSY if name == "loaded" else 0):
        command = [sys.executable, "-m", "pytest", *arguments]
        code = subprocess.run(command, cwd=REPOSITORY, env=environment, stdout=output, stderr=output).returncode
    text = log.read_text()
    return {
        "code": code, "seconds": round(time.monotonic() - begin), "last": (text.strip().splitlines() or [""])[-1],
        "failed": re.findall(r"^(?:FAILED|ERROR) (\S+)", text, re.MULTILINE),
    }  # fmt: skip


@contextlib.contextmanager
def busy(count: int) -> Iterator[None]:
    """So many processes that compute all the time; they end with this one, however it ends."""
    code = "import os\nparent = os.getppid()\nwhile os.getppid() == parent:\n    sum(range(100_000))"
    processes = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def line(name: str, result: dict[str, object], log: Path) -> str:
    """A row of the table, and below it the tests that failed."""
    failed = result["failed"]
    assert isinstance(failed, list)
    verdict = "ok" if result["code"] == 0 else f"FAILED, see {log.relative_to(REPOSITORY)}"
    told = f"{name:20} {result['seconds']:>6} s  {verdict:8}  {str(result['last']).strip('= ')}"
    return "\n".join([told, *(f"    {test}" for test in failed)])


if __name__ == "__main__":
    sys.exit(main())
