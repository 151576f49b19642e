"""Tasks that take no time, for tests of the machinery."""

import errno
import os
from pathlib import Path

from forcegp.errors import FitError


def square(results, spec, folder):
    if "before" in spec:
        return {"value": results.result(spec["before"])["value"] + 1}
    (folder / "note.txt").write_text("beside the result")
    return {"value": spec["number"] ** 2, "process": os.getpid()}


def times(store, spec, folder, shared, factor):
    return {"value": spec["number"] * shared["factor"] * factor}


def fail(results, spec, folder):
    (folder / "half.txt").write_text("never seen")
    raise FitError("no luck")


def break_down(results, spec, folder):
    return {"value": 1 / 0}


def fill_the_disk(results, spec, folder):
    raise OSError(errno.ENOSPC, "No space left on device")


def not_a_number(results, spec, folder):
    return {"value": float("nan")}


def die_once(results, spec, folder):
    try:
        Path(spec["marker"]).touch(exist_ok=False)
    except FileExistsError:
        return {"survived": True}
    os._exit(3)
