"""Stored models: documents of any shape, tensors and robots of another kind, with the digests left or rewritten."""

import hashlib
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file
from tests.fuzz.made import INPUTS, MODELS
from tests.fuzz.oracle import DefectError, Target, allowed, require_ended_well, require_no_code
from tests.fuzz.values import DAMAGE, JSON, JSON_EDITS, XML_EDITS, Damage, damaged, edited_json, edited_xml
from tests.robots.random_positions import random_positions

from forcegp import Model, load_posterior
from forcegp.atomic_files import write_digests

TENSORS = "tensors.safetensors"
CHANGES = {
    "float32": lambda x: x.float(), "integers": lambda x: x.long(), "booleans": lambda x: x > 0,
    "nan": lambda x: x * float("nan"), "infinite": lambda x: x + float("inf"), "huge": lambda x: x * 1e300,
    "zero": lambda x: x * 0.0, "negative": lambda x: -1.0 * x - 1.0, "flat": lambda x: x.reshape(-1),
    "one": lambda x: x.reshape(-1)[:1], "empty": lambda x: x.reshape(-1)[:0], "scalar": lambda x: x.sum(),
    "deeper": lambda x: x[None], "longer": lambda x: torch.cat([x.reshape(-1)] * 2),
    "fewer rows": lambda x: x[:1] if x.dim() else x,
}  # fmt: skip


@dataclass(frozen=True)
class Stored:
    """A model, what is done to one of its files, and whether its digests are written again."""

    model: str
    change: Any
    again: bool


@dataclass(frozen=True)
class TensorEdit:
    where: int
    how: str


DOCUMENT = st.tuples(st.just("model.json"), st.lists(JSON_EDITS, min_size=1, max_size=3) | JSON)
TENSOR = st.tuples(
    st.just(TENSORS),
    st.lists(
        st.builds(TensorEdit, st.integers(0, 60), st.sampled_from((*CHANGES, "drop", "rename", "swap"))),
        min_size=1,
        max_size=2,
    ),
)
ROBOT = st.tuples(st.just("robot.urdf"), st.lists(XML_EDITS, min_size=1, max_size=2))
FILE = st.tuples(st.sampled_from(("model.json", TENSORS, "robot.urdf", "SHA256SUMS")), DAMAGE)
GONE = st.tuples(
    st.sampled_from(("model.json", TENSORS, "robot.urdf", "SHA256SUMS")), st.sampled_from(("missing", "folder", "loop"))
)
CASES = st.builds(
    Stored, st.sampled_from(MODELS), DOCUMENT | DOCUMENT | DOCUMENT | TENSOR | ROBOT | FILE | GONE,
    st.sampled_from((True, True, True, False)),
)  # fmt: skip


def apply(case: Stored, folder: Path) -> Path:
    """The changed model, as a folder in that folder."""
    run = folder / "run"
    shutil.copytree(INPUTS.folder / case.model, run)
    name, change = case.change
    file = run / name
    if isinstance(change, Damage):
        file.write_bytes(damaged(file.read_bytes(), change))
    elif isinstance(change, str) and change in ("missing", "folder", "loop"):
        file.unlink()
        if change == "folder":
            file.mkdir()
        elif change != "missing":
            file.symlink_to(file)
    elif name == "model.json":
        document = json.loads(file.read_text())
        edits = isinstance(change, list) and change and all(hasattr(edit, "how") for edit in change)
        file.write_text(edited_json(document, change) if edits else json.dumps(change))
    elif name == TENSORS:
        tensors = load_file(file)
        for edit in change:
            if not tensors:
                break
            key, other = (sorted(tensors)[(k * edit.where + k - 1) % len(tensors)] for k in (1, 5))
            if edit.how == "drop":
                del tensors[key]
            elif edit.how == "rename":
                tensors["parameters.x" + key] = tensors.pop(key)
            elif edit.how == "swap":
                tensors[key] = tensors[other]
            else:
                tensors[key] = CHANGES[edit.how](tensors[key])
        save_file({key: value.clone().contiguous() for key, value in tensors.items()}, file)
    else:
        file.write_text(edited_xml(file.read_text(), change), encoding="utf-8", errors="replace")
    if case.again:
        _write_again(run)
    return run


def _write_again(run: Path) -> None:
    """Digests, and the one of the robot in the document, as a program that writes models would make them."""
    try:
        document = json.loads((run / "model.json").read_text())
        digest = hashlib.sha256((run / "robot.urdf").read_bytes()).hexdigest()
        if isinstance(document, dict) and isinstance(document.get("urdf_sha256"), str):
            (run / "model.json").write_text(json.dumps(document | {"urdf_sha256": digest}))
    except (OSError, ValueError, RecursionError):
        pass
    if (run / "SHA256SUMS").is_file() and not (run / "SHA256SUMS").is_symlink():
        write_digests(run)


def check(case: Stored, folder: Path) -> None:
    """Refused, or a model that predicts numbers; refused whenever the digests were left."""
    run = apply(case, folder)
    same = all(
        (run / path.name).is_file() and (run / path.name).read_bytes() == path.read_bytes()
        for path in (INPUTS.folder / case.model).iterdir()
    )
    with allowed():
        posterior = load_posterior(run)
        if not case.again and not same:
            raise DefectError("a changed model was loaded")
        repr(posterior)
        states = (torch.full((2, posterior.model.robot.nv), 0.3, dtype=torch.float64),) * 3
        predicted = posterior.predict(*states)
        if not bool(torch.isfinite(predicted.mean).all() and torch.isfinite(predicted.covariance).all()):
            raise DefectError("a prediction that is not finite")
    require_no_code(folder)


def check_commands(case: Stored, folder: Path) -> None:
    """The same models under the commands that read models."""
    apply(case, folder)
    shutil.copyfile(INPUTS.folder / "train.h5", folder / "train.h5")
    rolled = "score run train.h5 --starts 1 --horizon 0.02" if len(repr(case)) % 3 == 0 else ""
    require_ended_well((rolled or "score run train.h5").split(), folder)


@dataclass(frozen=True)
class StoredSystem:
    """A model of thrusters and switches, with these edits."""

    which: int
    edits: list[Any]


def check_system(case: StoredSystem, folder: Path) -> None:
    """Refused, or a model that moves and is stored again."""
    text = edited_json(json.loads(INPUTS.models[case.which]), case.edits)
    with allowed():
        model = Model.from_json(text)
        repr(model)
        robot = model.robot
        q = random_positions(robot, torch.Generator().manual_seed(0))
        dynamics = model.dynamics(q, 0.0 * q[:, : robot.nv], torch.ones(1, len(model.inputs)).double())
        if not bool(torch.isfinite(dynamics.M).all()):
            raise DefectError("a mass matrix that is not finite")
        Model.from_json(model.to_json())
    require_no_code(folder)


SYSTEMS_TARGET = Target(
    st.builds(StoredSystem, st.integers(0, 1), st.lists(JSON_EDITS, min_size=1, max_size=3)), check_system, fast=20,
    nightly=2000,
)  # fmt: skip
COMMANDS_TARGET = Target(CASES, check_commands, fast=4, nightly=1500)
TARGET = Target(CASES, check, fast=24, nightly=4000)
