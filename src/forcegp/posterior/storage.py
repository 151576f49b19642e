"""Fitted models on disk: a folder with `model.json`, `tensors.safetensors` and `robot.urdf`. No code, no pickle.

`SHA256SUMS` holds the digest of each: a flipped bit would hardly ever be noticed otherwise. A model that was carried to
another system (`with_system`) has `target.urdf`, too, the robot there. The folder holds the training points and
parameters; loading runs the same conditioning as fitting, so predictions are the same.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save

from forcegp import __version__
from forcegp.atomic_files import added_files, atomic_folder, require_unchanged, write_digests
from forcegp.data import units_for
from forcegp.errors import FileFormatError, ForceGPError, InvalidInput, require_type, usable_arguments
from forcegp.evidence.training_data import TrainingData
from forcegp.inference import OptimizationResult, engine_from_dict
from forcegp.model import Model
from forcegp.posterior.estimates import Estimates
from forcegp.posterior.posterior import Posterior

KIND = "forcegp posterior"


RESULT = {"value": float, "history": tuple, "status": str, "converged": bool, "evaluations": int, "cpu_seconds": float}
"""What is stored of a search."""
FORMAT_VERSION = 1
FEATURES = {
    "target": "it was carried to another system, for which it predicts",
    "reference": "its rows are standardised by others than those that it is conditioned on",
    "windows": "it learned from windows, whose nodes are no rows",
    "measured-torque": "its torques are noisy measurements",
}
"""What a stored model may hold beyond rows and parameters: a program that ignored one of these would predict wrongly,
so each is declared in `model.json`, and a program refuses those that it cannot read.
"""
STATES = ("q", "v", "u", "a")
NOISE, WEIGHTS = "noise_std", "weights"
SOLUTION = "latent.solution"
TRAINING, REFERENCE, PARAMETERS = "training.", "reference.", "parameters."
ROBOT, TARGET = "robot.urdf", "target.urdf"


def save_posterior(posterior: Posterior, path: str | Path, *, overwrite: bool = False) -> None:
    """Write `posterior` as the folder `path`, whole or not at all; with `overwrite` an old model stays until then.

    Raises
    ------
    FileFormatError: `path` is there, is not an empty folder, and `overwrite` is false, or is not a model folder, or is
        one to which files were added.
    ContactError: a surface of the system holds code.
    """
    require_type("posterior", posterior, Posterior)
    path = Path(path)
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        if not overwrite:
            raise FileFormatError(f"{path} exists already; choose another name or pass overwrite=True")
        try:
            _document(path)
        except FileFormatError:
            what = "exists and is not a folder written by forcegp, so it is not overwritten"
            raise FileFormatError(f"{path} {what}") from None
        others = added_files(path, ("model.json", "tensors.safetensors", ROBOT, TARGET))
        if others:
            raise FileFormatError(
                f"{path} holds files that forcegp did not write there ({', '.join(others[:3])}), so it is not "
                "overwritten; move them away or choose another name"
            )
    model = posterior.trained.to_dict()
    target = None if posterior.target is None else posterior.target.to_dict()
    robots = {ROBOT: model.pop("urdf")} | ({} if target is None else {TARGET: target.pop("urdf")})
    document = {
        "kind": KIND,
        "format_version": FORMAT_VERSION,
        "features": _features(posterior),
        "forcegp_version": __version__,
        "torch_version": torch.__version__,
        "joint_names": list(posterior.joint_names),
        "units": _plain(units_for(posterior.model.robot)),
        "urdf_sha256": _sha256(robots[ROBOT]),
        "model": model,
        **({} if target is None else {"target": target, "target_urdf_sha256": _sha256(robots[TARGET])}),
        "result": {name: getattr(posterior.result, name) for name in RESULT},
        "engine": None if posterior.engine is None else posterior.engine.to_dict(),
        "settings": dict(posterior.settings),
        "estimates": posterior.estimates.to_dict(),
    }
    training = posterior.training
    tensors = _row_tensors(TRAINING, training)
    if training.reference is not None:
        tensors |= _row_tensors(REFERENCE, training.reference)
    tensors |= {
        f"{PARAMETERS}{name}": value.detach().cpu().clone() for name, value in posterior.hyperparameters.items()
    }

    if (solution := posterior.solution) is not None:
        tensors[SOLUTION] = solution.detach().cpu().contiguous()

    with atomic_folder(path, overwrite=overwrite) as folder:
        folder.mkdir()
        # safetensors' own `save_file` ignores the umask: only the user could read its files
        (folder / "tensors.safetensors").write_bytes(save(tensors))
        for name, urdf in robots.items():
            (folder / name).write_bytes(urdf.encode("utf-8"))  # as text, line ends would change
        (folder / "model.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
        write_digests(folder)


@usable_arguments("load_posterior")
def load_posterior(path: str | Path) -> Posterior:
    """Read a folder that `save_posterior` wrote; it predicts without the training file.

    Raises
    ------
    FileFormatError: not such a folder, damaged, or written by another version.
    """
    path = Path(path)
    document = _document(path)
    declared = _declared(path / "model.json", document)
    require_unchanged(path, "fit the model again")
    try:
        urdf = _robot(path, ROBOT, document.get("urdf_sha256"))
        moved_to = None
        if "target" in declared or "target" in document:
            moved_to = _robot(path, TARGET, document.get("target_urdf_sha256"))
        tensors = load_file(path / "tensors.safetensors")
    except (OSError, SafetensorError, UnicodeDecodeError) as error:
        raise FileFormatError(f"{path} is incomplete or damaged: {error}; fit the model again") from None
    try:
        model = Model.from_dict({**document["model"], "urdf": urdf})
        settings = dict(document["settings"])
        estimates = Estimates.from_dict(document["estimates"])
        engine = None if document["engine"] is None else engine_from_dict(document["engine"])
        moved = None if moved_to is None else {**document["target"], "urdf": moved_to}
        target = None if moved is None else Model.from_dict(moved)
        training = _rows(TRAINING, tensors)
        if "reference" in declared or any(name.startswith(REFERENCE) for name in tensors):
            training = replace(training, reference=_rows(REFERENCE, tensors))
        parameters = {
            name.removeprefix(PARAMETERS): value for name, value in tensors.items() if name.startswith(PARAMETERS)
        }
        found: dict[str, Any] = {name: kind(document["result"][name]) for name, kind in RESULT.items()}
        optimization = OptimizationResult(parameters, **found)
        names = document["joint_names"]
        if not all(isinstance(name, str) for name in names) or not isinstance(settings.get("data", {}), dict):
            raise ValueError("joint_names or the data of its settings are of another type")
        numbers = [settings.get("rows_added", 0), *(settings.get("data") or {}).get("episodes", ())]
        if {int(number) for number in numbers} and not 0.0 < float(settings.get("widening", 1.0)) < float("inf"):
            raise ValueError("its widening is no positive number")
    except (KeyError, TypeError, ValueError, RuntimeError, ForceGPError) as error:
        raise FileFormatError(f"{path / 'model.json'} is incomplete or damaged: {error}") from None
    if document.get("units") != _plain(units_for(model.robot)):
        raise FileFormatError(f"{path / 'model.json'} states units that are not those of its robot's joints")
    if list(model.robot.joint_names) != names:
        raise FileFormatError(
            f"{path} was trained on joints {', '.join(names)}, its robot has {', '.join(model.robot.joint_names)}"
        )
    file = path / "tensors.safetensors"
    for name, value in tensors.items():
        if value.dtype != torch.float64 or not bool(torch.isfinite(value).all()):
            raise FileFormatError(f"{file} is damaged: {name} is {value.dtype} or has values that are not finite")
    for prefix, rows in ((TRAINING, training), (REFERENCE, training.reference)):
        if rows is not None:
            _check_rows(file, model, prefix, rows)
    given = {name: tuple(value.shape) for name, value in parameters.items()}
    if given != Posterior.parameter_shapes(model, training):
        raise FileFormatError(f"{file} does not hold the parameters of its model")
    try:
        found_before = parameters, optimization, settings, engine, tensors.get(SOLUTION), estimates
        posterior = Posterior.conditioned(model, training, *found_before)
    except (InvalidInput, RuntimeError) as error:
        raise FileFormatError(f"{path} is damaged: {error}; fit the model again") from None
    if target is not None:
        try:
            posterior = posterior.with_model(target).with_settings(**settings)  # as it was stored
        except ForceGPError as error:
            raise FileFormatError(f"{path / 'model.json'} does not fit its target: {error}") from None
    held = set(_features(posterior))
    if declared != held:
        raise FileFormatError(
            f"{path} is damaged: it declares {_listed(declared)} and holds {_listed(held)}; fit the model again"
        )
    return posterior


def _features(posterior: Posterior) -> list[str]:
    """The names in `FEATURES` of what the posterior has."""
    has = {
        "target": posterior.target is not None,
        "reference": posterior.training.reference is not None,
        "windows": posterior.training.weights is not None,
        "measured-torque": posterior.trained.noise is not None and posterior.trained.noise.measured_torque,
    }
    return [name for name in FEATURES if has[name]]


def _declared(file: Path, document: Mapping[str, Any]) -> set[str]:
    """The features that `model.json` declares. Raises FileFormatError for those that this version cannot read."""
    features = document.get("features")
    if not isinstance(features, list) or not all(isinstance(name, str) for name in features):
        raise FileFormatError(f"{file} is damaged: its features are {features!r}, not a list of names")
    unknown = set(features) - set(FEATURES)
    if unknown:
        raise FileFormatError(
            f"{file} has the features {_listed(unknown)}, which this forcegp {__version__} does not have (it has "
            f"{_listed(FEATURES)}); use the version that wrote it ({document.get('forcegp_version')}) or fit again"
        )
    return set(features)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(map(repr, sorted(names))) or "no features"


def _row_tensors(prefix: str, rows: TrainingData) -> dict[str, torch.Tensor]:
    """Tensors by their name in the file, which are contiguous copies: rows of one may share memory with another's."""
    names = [*STATES, *(name for name in (NOISE, WEIGHTS) if getattr(rows, name) is not None)]
    return {f"{prefix}{name}": getattr(rows, name).detach().cpu().clone().contiguous() for name in names}


def _rows(prefix: str, tensors: Mapping[str, torch.Tensor]) -> TrainingData:
    states = (tensors[prefix + name] for name in STATES)
    return TrainingData(*states, noise_std=tensors.get(prefix + NOISE), weights=tensors.get(prefix + WEIGHTS))


def _check_rows(file: Path, model: Model, prefix: str, rows: TrainingData) -> None:
    states = {name: getattr(rows, name) for name in STATES}
    if rows.noise_std is not None:
        states[NOISE] = rows.noise_std
        if not bool((rows.noise_std > 0).all()):
            raise FileFormatError(f"{file} is damaged: {prefix}noise_std has values that are not positive")
    sizes = dict(zip("qvu", model.sizes, strict=True))
    count = rows.q.shape[0] if rows.q.dim() == 2 else -1
    for name, value in states.items():
        if value.shape != (count, sizes.get(name, model.robot.nv)):
            raise FileFormatError(f"{file} is damaged: {prefix}{name} has shape {tuple(value.shape)}")
    if rows.weights is not None and (rows.weights.dim() != 2 or rows.weights.numel() != len(rows.q)):
        raise FileFormatError(f"{file} is damaged: {prefix}{WEIGHTS} has shape {tuple(rows.weights.shape)}")


def _document(path: Path) -> dict[str, Any]:
    if not path.is_dir():
        what = "does not exist" if not path.exists() else "is a file"
        raise FileFormatError(f"{path} {what}; give the folder that `forcegp fit --out` wrote")
    file = path / "model.json"
    if file.is_fifo():  # to open it would wait for a writer for ever
        raise FileFormatError(f"{file} is not a regular file; give the folder that `forcegp fit --out` wrote")
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except OSError:
        raise FileFormatError(f"{path} holds no model.json; give the folder that `forcegp fit --out` wrote") from None
    except (ValueError, RecursionError) as error:  # also numbers of 5000 digits
        raise FileFormatError(f"{file} is damaged: {error}") from None
    if not isinstance(document, dict) or document.get("kind") != KIND:
        raise FileFormatError(f"{file} is not a stored forcegp model.")
    version = document.get("format_version")
    if version != FORMAT_VERSION:
        raise FileFormatError(
            f"{file} has format version {version!r}, this forcegp {__version__} reads {FORMAT_VERSION}; use the "
            f"version that wrote it ({document.get('forcegp_version')}) or fit again"
        )
    return document


def _robot(path: Path, name: str, sha256: str | None) -> str:
    """URDF text of a robot in the folder, as it was written."""
    urdf = (path / name).read_bytes().decode("utf-8")
    if _sha256(urdf) != sha256:
        what = "that the model was trained with" if name == ROBOT else "that the model was carried to"
        raise FileFormatError(f"{path / name} is not the robot {what} (its hash differs)")
    return urdf


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    return list(value) if isinstance(value, tuple) else value
