"""Bytes that are changed, lost or added anywhere in a log: a dataset or a refusal, never anything else."""

import warnings

import numpy as np
import pytest
from tests.recordings.log_files import motion
from tests.recordings.test_importing import FORMATS

from forcegp.errors import ForceGPError
from forcegp.recordings import import_recordings

MUTATIONS = 12


def damaged(content: bytes, random: np.random.Generator) -> bytes:
    changed = bytearray(content)
    for _ in range(random.integers(1, 6)):
        place, count = int(random.integers(len(changed))), int(random.integers(1, 40))
        match random.integers(4):
            case 0:
                changed[place] = random.integers(256)
            case 1:
                del changed[place : place + count]
            case 2:
                changed[place:place] = random.bytes(count)
            case _:
                changed[place : place + 8] = b"\xff" * 8
    return bytes(changed)


@pytest.mark.parametrize("name", FORMATS)
def test_damage_is_refused_or_harmless(tmp_path, name):
    if name in ("bag", "mcap", "db3"):
        pytest.importorskip("rosbags")
    file, write, mapping = FORMATS[name]
    path = write(tmp_path / file, motion(60))
    files = [item for item in ([path] if path.is_file() else sorted(path.rglob("*"))) if item.is_file()]
    random = np.random.default_rng(1)
    refused = 0
    for _ in range(MUTATIONS):
        victim = files[random.integers(len(files))]
        content = victim.read_bytes()
        victim.write_bytes(damaged(content, random))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # libraries may say what they find odd
                import_recordings([path], mapping)
        except ForceGPError:
            refused += 1
        victim.write_bytes(content)
    assert refused > MUTATIONS // 2
    assert [item.name for item in tmp_path.iterdir()] == [path.name]
    import_recordings([path], mapping)
