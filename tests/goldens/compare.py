"""Numbers that do not move in silence: what a test computes is compared with what was stored before.

An oracle says that a number is right, at the few places that it can reach; a golden says that a number is what it was,
at every place that it passes through. `FORCEGP_WRITE_GOLDENS=1` stores them anew, and what has changed is for the
reviewer to see. Goldens are of short computations, so that no processor and no number of threads moves them.
"""

import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

WRITE = os.environ.get("FORCEGP_WRITE_GOLDENS") == "1"
FEW = 6  # longer arrays are stored as their size and sums of them, which every entry moves


def assert_unchanged(name: str, values: Any, rtol: float = 1e-6) -> None:
    """`values` are numbers, arrays or None in mappings, sequences and dataclasses; name is "package/what"."""
    # Numbers may differ by `rtol` of themselves, and those of arrays by that of their largest
    package, _, name = name.partition("/")
    file = Path(__file__).with_name(f"{package}.json")
    stored = json.loads(file.read_text()) if file.exists() else {}
    found = dict(_condensed(values))
    if WRITE:
        rounded = {path: [float(f"{x:.8g}") for x in numbers] for path, numbers in found.items()}
        lines = [f'"{key}": {json.dumps(each)}' for key, each in sorted((stored | {name: rounded}).items())]
        file.write_text("{\n" + ",\n".join(lines) + "\n}\n")
        pytest.skip(f"{file.name} has the numbers of now; look at what has changed")
    known = stored.get(name, {})
    assert found.keys() == known.keys(), f"{file.name} has others; FORCEGP_WRITE_GOLDENS=1 stores these"
    moved = {}
    for path, numbers in found.items():
        most = 0.0 if path.endswith("}") else max(map(abs, known[path]), default=0.0)
        if not np.allclose(numbers, known[path], rtol=rtol, atol=rtol * most + 1e-12):
            moved[path] = numbers, known[path]
    assert not moved, moved


def _condensed(values: Any, path: str = "") -> Iterator[tuple[str, list[float]]]:
    if is_dataclass(values):
        values = {field.name: getattr(values, field.name) for field in fields(values)}
    if isinstance(values, Mapping):
        plain = {key: value for key, value in values.items() if isinstance(value, int | float)}
        if plain:
            yield f"{path}/{{{', '.join(map(str, plain))}}}", [*map(float, plain.values())]
        for key, value in values.items():
            if key in plain:
                continue
            yield from _condensed(value, f"{path}/{key}")
        return
    if values is None or isinstance(values, str):
        yield f"{path} {values}", []
        return
    try:
        x = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):  # of several lengths, or of several kinds
        for number, value in enumerate(values):
            yield from _condensed(value, f"{path}/{number}")
        return
    known = x[np.isfinite(x)]
    path = f"{path} {'x'.join(map(str, x.shape))}" + f" but {x.size - known.size}" * (known.size < x.size)
    if known.size > FEW:
        places = np.arange(known.size)
        waves = [np.cos(rate * places + 1.0) @ known / known.size for rate in (0.3, 2.4)]
        known = np.array([np.sqrt(np.square(known).mean()), *waves])
    yield path, known.tolist()


def drawn(figure: Any) -> dict[str, Any]:
    """What a matplotlib figure shows: lines, bands, limits and numbers of artists of all axes."""
    return {
        f"{number}": {
            "lines": [line.get_xydata() for line in axes.lines],
            "bands": [path.vertices for part in axes.collections for path in part.get_paths()],
            "limits": [*axes.get_xlim(), *axes.get_ylim()],
            "shown": [axes.get_visible(), len(axes.texts), len(axes.patches)],
        }
        for number, axes in enumerate(figure.axes)
    }


def numbers_in(text: str) -> list[float]:
    """All numbers of what a command prints, in their order."""
    return [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?", text)]
