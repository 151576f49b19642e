"""Tasks that tell where and how they ran, wait, or end their own process."""

import os
import signal
import time
from pathlib import Path


def seeded_sum(seed):
    import numpy as np

    return float(np.random.default_rng(seed).standard_normal(1000).sum())


def folder_of_work(_):
    return Path.cwd()


def slow_first(index):
    time.sleep(0.2 if index == 0 else 0.0)
    return index


def wait_for_the_gate(gate, index):
    for _ in range(12_000):
        if index == 0 or gate.exists():
            return index
        time.sleep(0.05)
    return "the gate stayed shut"


def sleep_long(file):
    if file is not None:
        Path(file).write_text(str(os.getpid()))
        time.sleep(3600)


def process(_):
    time.sleep(0.1)
    return os.getpid()


def mark(file):
    Path(file).touch()
    return file


def mark_or_fail(file):
    if file is None:
        raise TypedError("no luck", 7)
    return mark(file)


class TypedError(ValueError):
    def __init__(self, text, code):
        super().__init__(text, code)
        self.code = code


def die(folder):
    """SIGKILL the worker; files count the attempts."""
    (Path(folder) / str(os.getpid())).touch()
    os.kill(os.getpid(), signal.SIGKILL)


def threads(_):
    """The threads of every linear algebra library in a worker."""
    import torch
    from threadpoolctl import threadpool_info

    return [torch.get_num_threads(), *(library["num_threads"] for library in threadpool_info())]
