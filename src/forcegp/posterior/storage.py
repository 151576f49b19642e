"""Fitted models on disk: a folder with `model.json`, `tensors.safetensors`, `robot.urdf`, digests. No code, no pickle.

It holds training points and parameters, after `with_model` also `target.urdf`; loading conditions as fitting does.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save

from forcegp import __version__
from forcegp.atomic_files import atomic_folder, read_json, require_replaceable, require_unchanged, write_digests
from forcegp.data import units_for
from forcegp.data.dataset import BEYOND, FORCE, IMU, LARGEST_MEASURED
from forcegp.errors import FileFormatError, ForceGPError, require_type, usable_arguments
from forcegp.evidence.likelihood import TrainingData
from forcegp.inference import OptimizationResult, engine_from_dict
from forcegp.model import Model
from forcegp.posterior.fitted import Estimates
from forcegp.posterior.posterior import Posterior
from forcegp.robots.urdf_file import read_text

KIND = "forcegp posterior"
FORMAT_VERSION = 1
RESULT = {"value": float, "history": tuple, "status": str, "converged": bool, "evaluations": int, "cpu_seconds": float}
"""What is stored of a search."""
ROWS = ("q", "v", "u", "a")
SETTINGS: dict[str, tuple[int | str, ...]] = {
    **dict.fromkeys(("widening", "correlated_rows", "rows_added", "points", "learning_points"), ()),
    "data.episodes": ("episodes",),
    "hidden_force": ("nv",),
    "motion_intervals.horizons": ("horizons",),
    "motion_intervals.rms": ("horizons", 2, "nv"),
    "motion_intervals.factors": (2, "horizons", 2, "nv"),
    **{"air.coefficients": (6, 20), "air.deviations": (6,), "air.wind": (3,)},
}
"""Shapes of the numbers in the settings of a model that are read after loading."""
POSITIVE = ("widening", "hidden_force", "correlated_rows", "horizons", "deviations")
UNUSABLE = (ArithmeticError, AttributeError, LookupError, OSError, RuntimeError, TypeError, ValueError)
UNUSABLE += (SafetensorError, ForceGPError)
TRAINING, REFERENCE, PARAMETERS = "training.", "reference.", "parameters."
ROBOT, TARGET = "robot.urdf", "target.urdf"


def save_posterior(posterior: Posterior, path: str | Path, *, overwrite: bool = False) -> None:
    """Write `posterior` as the folder `path`, whole or not at all; with `overwrite` an old model stays until then.

    Raises FileFormatError where `path` is no empty folder and may not be replaced, ContactError for surfaces with code.
    """
    require_type("posterior", posterior, Posterior)
    path = Path(path)
    own = ("model.json", "tensors.safetensors", ROBOT, TARGET)
    require_replaceable(path, "forcegp", _document, overwrite=overwrite, own=own)
    models = {"model": posterior.trained.to_dict()}
    if posterior.target is not None:
        models["target"] = posterior.target.to_dict()
    robots = {file: model.pop("urdf") for file, model in zip((ROBOT, TARGET), models.values(), strict=False)}
    document = {
        "kind": KIND,
        "format_version": FORMAT_VERSION,
        "forcegp_version": __version__,
        "torch_version": torch.__version__,
        "joint_names": posterior.joint_names,
        "units": units_for(posterior.model.robot),
        **models,
        "result": {name: getattr(posterior.result, name) for name in RESULT},
        "engine": None if posterior.engine is None else posterior.engine.to_dict(),
        "settings": dict(posterior.settings),
        "estimates": posterior.estimates.to_dict(),
    }
    tensors = {f"{PARAMETERS}{name}": value for name, value in posterior.hyperparameters.items()}
    for prefix, rows in ((TRAINING, posterior.training), (REFERENCE, posterior.training.reference)):
        tensors |= {prefix + name: value for name in ROWS if (value := getattr(rows, name, None)) is not None}
        tensors |= {f"{prefix}{name}": value for name, value in (rows.sensed if rows else {}).items()}
    with atomic_folder(path, overwrite=overwrite) as folder:
        folder.mkdir()
        # safetensors' own `save_file` ignores the umask; rows of one tensor may share memory with another's
        kept = {name: value.detach().cpu().clone().contiguous() for name, value in tensors.items()}
        (folder / "tensors.safetensors").write_bytes(save(kept))
        for name, urdf in robots.items():
            (folder / name).write_bytes(urdf.encode("utf-8"))  # as text, line ends would change
        (folder / "model.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
        write_digests(folder)


@usable_arguments("load_posterior")
def load_posterior(path: str | Path) -> Posterior:
    """Read what `save_posterior` wrote. FileFormatError for others, damaged, or of another version."""
    path = Path(path)
    document = _document(path)
    require_unchanged(path, "fit the model again")
    try:
        tensors = load_file(path / "tensors.safetensors")
        for name, value in tensors.items():
            if value.dtype != torch.float64 or not bool(value.isfinite().all()):
                raise ValueError(f"{name} is {value.dtype} or has values that are not finite")
            if name.startswith((TRAINING, REFERENCE)) and bool((value.abs() > LARGEST_MEASURED).any()):
                raise ValueError(f"{name} has values {BEYOND.rstrip('.')}")
        model = Model.from_dict({**document["model"], "urdf": read_text(path / ROBOT)})
        training = _rows(TRAINING, tensors, model)
        if any(name.startswith(REFERENCE) for name in tensors):
            training = replace(training, reference=_rows(REFERENCE, tensors, model))
        own = [name for name in tensors if name.startswith(PARAMETERS)]
        parameters = {name.removeprefix(PARAMETERS): tensors[name] for name in own}
        found: dict[str, Any] = {name: kind(document["result"][name]) for name, kind in RESULT.items()}
        stored, settings = document["engine"], dict(document["settings"])
        _require_numbers(settings, model.robot.nv)
        engine = None if stored is None else engine_from_dict(stored)
        learned = training, parameters, OptimizationResult(parameters, **found)
        posterior = Posterior.conditioned(model, *learned, settings, engine, Estimates.from_dict(document["estimates"]))
        of_rows = posterior.likelihood
        needed = of_rows.kernels.initial_parameters() | of_rows.noise.parameters(model.robot.nv)
        wanted, there = ({name: x.shape for name, x in each.items()} for each in (needed, parameters))
        if wanted != there:
            raise ValueError("its parameters are not those of its model")
        if "target" in document:
            posterior = posterior.with_model(Model.from_dict({**document["target"], "urdf": read_text(path / TARGET)}))
            posterior = posterior.with_settings(**settings)  # as it was stored
    except UNUSABLE as error:
        raise FileFormatError(f"{path} is incomplete or damaged: {error}; fit the model again") from None
    return posterior


def _rows(prefix: str, tensors: Mapping[str, torch.Tensor], model: Model) -> TrainingData:
    """Raises ValueError, or what Python does, for tensors of other shapes than the rows of the model have."""
    given: dict[str, Any] = {name: tensors[prefix + name] for name in ROWS if prefix + name in tensors}
    count, columns = len(given["q"]), dict(zip("qvu", model.sizes, strict=True))
    for name, value in given.items():
        if value.shape != (count, columns.get(name, model.robot.nv)):
            raise ValueError(f"{prefix}{name} has shape {tuple(value.shape)}, which is not that of {count} rows")
    own = (f"{prefix}{FORCE}", f"{prefix}{IMU}")
    sensed = {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(own)}
    if any(value.shape != (count, 3) for value in sensed.values()):
        raise ValueError(f"sensors have other shapes than ({count}, 3)")
    return TrainingData(**given, sensed=sensed)


def _require_numbers(settings: Mapping[str, Any], nv: int) -> None:
    """Raises ValueError, or what Python does, where settings that are read later are not numbers of their shape."""
    sizes = {"nv": nv}
    for name, shape in SETTINGS.items():
        group, _, key = name.rpartition(".")
        if (holder := settings.get(group) if group else settings) is None or not (group or key in settings):
            continue
        given = np.asarray(value := holder.get(key) if isinstance(holder, Mapping) else holder)
        same = given.ndim == len(shape) and given.dtype.kind in "if" and np.isfinite(given).all()
        for asked, size in zip(shape, given.shape, strict=False):
            same = same and size == (sizes.setdefault(asked, size) if isinstance(asked, str) else asked)
        if not same or (key in POSITIVE and not (given > 0.0).all()):
            raise ValueError(f"model.json has settings in which {name} is {str(value)[:60]}")


def _document(path: Path) -> dict[str, Any]:
    if not path.is_dir():
        what = "does not exist" if not path.exists() else "is a file"
        raise FileFormatError(f"{path} {what}; give the folder that `forcegp fit --out` wrote")
    file = path / "model.json"
    if not file.is_file():  # to open a pipe would wait for a writer for ever
        raise FileFormatError(f"{path} holds no model.json; give the folder that `forcegp fit --out` wrote")
    document = read_json(file, "fit the model again")
    if document.get("kind") != KIND:
        raise FileFormatError(f"{file} is not a stored forcegp model.")
    version = document.get("format_version")
    if version != FORMAT_VERSION:
        seen = f"{file} has format version {version!r}, this forcegp {__version__} reads {FORMAT_VERSION}"
        raise FileFormatError(f"{seen}; use the version that wrote it ({document.get('forcegp_version')}) or fit again")
    return document
