"""`score`: models side by side on the same rows of a log, fitted to the rest of it or before."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from forcegp import __version__
from forcegp.atomic_files import write_json, write_text
from forcegp.data import Dataset, with_strokes
from forcegp.data.dataset import require_rows
from forcegp.data.views import decided
from forcegp.errors import InvalidInput, require_type
from forcegp.integration import integrator_named
from forcegp.jobs import JobStore, machine, run_jobs
from forcegp.model import Model
from forcegp.parallel import checked_jobs
from forcegp.posterior.posterior import Posterior
from forcegp.progress import part
from forcegp.robots.arguments import whole_number
from forcegp.scores.experiment import Experiment, fingerprint, kept, scored
from forcegp.scores.held_out import STARTS, Split, held_out_motions, split_named
from forcegp.scores.models import Candidate, Given, candidate, candidates, default_models, identified_model
from forcegp.scores.page import page, preparation_lines
from forcegp.scores.scores import Scores

KIND = "forcegp score"
RESULTS, PAGE = "results.json", "report.md"


def score(
    models: Posterior | Mapping[str, Given] | Sequence[str] | None,
    log: Dataset,
    *,
    split: str | Sequence[Split] | None = None,
    horizons: Sequence[float] | None = None,
    folder: str | Path | None = None,
    model: Model | None = None,
    recording: Dataset | None = None,
    points: int = 100,
    seeds: int = 5,
    starts: int = STARTS,
    integrator: str = "rk4",
    identification: str | None = None,
    restarts: int | None = None,
    iterations: int | None = None,
    jobs: int | Executor = 1,
    source: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> Scores:
    """Score models on the same rows: errors, densities, coverage, motions, and paired differences.

    Posteriors alone and no `split`: they are scored on all rows of `log`. Otherwise every model is fitted for every
    split and seed to one side and scored on the other, `identified` (from all training rows) always among them. The
    same call goes on after an interruption, and one with more models or seeds computes only these. Failures are rows.

    Parameters
    ----------
    models: a posterior; or by name posteriors, models to fit, and names of models (`scores.models`), of which a list
        will do. None takes some of every kind.
    split: text of `split_named` or its result; None is "auto" where anything is fitted.
    horizons: of predicted motions in s; none with (). None takes .1, .2, .5 and 1 s where anything is fitted.
    folder: where every finished piece is kept, with the page report.md and results.json; None keeps nothing.
    model, recording: the robot as given, and the log at its full rate, for motions; None takes the log's, and the log.
    points, seeds: rows that models of many inputs learn from, and how many choices of them.
    starts, integrator: of the motions of every held-out stretch.
    identification: what `identified` is, as in "bodies+viscous+coulomb+rotor@torques"; its mass matrix turns errors of
        accelerations into forces.
    restarts, iterations: of searches for hyper-parameters; None leaves them to the model.
    jobs: pieces at once, in as many processes of this machine, or an executor in which they run.
    source: where the data come from, for the page: "title", and "data", a list of lines.
    overwrite: compute everything anew, also where the folder holds results.

    Raises InvalidInput for arguments out of range, a log of another robot, nothing held out, horizons that no stretch
    lasts for, a folder of something else, or one where another process is at work.
    """
    log = with_strokes(require_type("log", log, Dataset))
    recording = None if recording is None else with_strokes(require_type("recording", recording, Dataset))
    wrong = isinstance(models, str) or not isinstance(models, Posterior | Mapping | Sequence)
    given: Any = {"model": models} if isinstance(models, Posterior) else models
    if models is not None and wrong:
        raise InvalidInput(f"models is a {type(given).__name__}; give a Posterior, a mapping from names, or names.")
    seeds = whole_number("seeds", seeds, 1)
    about = {"kind": KIND, "machine": machine(), "forcegp": __version__, "source": dict(source or {}), "rows": len(log),
             "preparation": preparation_lines(log.metadata)}  # fmt: skip
    if horizons is not None and not isinstance(horizons, Sequence):
        raise InvalidInput(f"horizons is {horizons!r}; give a sequence of seconds.")
    horizons = None if horizons is None else tuple(horizons)
    named = given.items() if isinstance(given, Mapping) else ()
    before = {name: each for name, each in named if isinstance(each, Posterior)}
    if before and len(before) == len(given) and split is None:
        known = {name: candidate(name, each, each.model, "") for name, each in before.items()}
        digests = {name: each.digest for name, each in known.items()}
        how = {"rows_sha256": fingerprint(log), "models": digests, "horizons": horizons, "integrator": integrator}
        log, recording = decided(log), decided(recording or log)
        motions = held_out_motions(recording, np.ones(len(recording), dtype=bool), horizons or (), starts)
        for posterior in before.values():
            require_rows("log", log, posterior.joint_names, "the model")
            integrator_named(integrator, posterior.model)
        if folder is not None:  # where nothing is left if the arguments are refused
            JobStore.open(Path(folder), KIND, how, overwrite=overwrite)
        runs = {}
        for place, (name, posterior) in enumerate(before.items()):  # one run of each, on all rows
            run = {"split": "all rows", "seed": 0, "error": None, "cpu_seconds": None}
            run |= {"training_rows": len(posterior.training)}
            with part(place, len(before), name):
                runs[name] = [run | scored(posterior, log, motions, integrator)]
        about |= {"splits": [], "seeds": [0], "notes": list(motions.notes)}
        scores = _scores(log, runs, known, about, lambda name, _: before[name])
        if folder is not None:
            write(scores, Path(folder))
        return scores
    robot = log.model if model is None else model
    splits = split_named(log, split or "auto") if split is None or isinstance(split, str) else tuple(split)
    settings: Any = (points, horizons, starts, integrator, identification, restarts, iterations)
    experiment = Experiment(log, recording or log, robot, splits, *settings)
    chosen = candidates(default_models(robot) if given is None else given, robot, experiment.identifies)
    checked_jobs(jobs)
    with tempfile.TemporaryDirectory() as nowhere:
        place = Path(nowhere, "scores") if folder is None else Path(folder)
        store = JobStore.open(place, KIND, experiment.configuration, overwrite=overwrite)
        identifications, fits = experiment.jobs(chosen, seeds)
        run_jobs(store, [*identifications, *fits], jobs)
        runs = {name: [kept(store, job.name) for job in fits if job.spec["name"] == name] for name in chosen}
        for name in (name for name, each in chosen.items() if each.all_rows):  # they use no chance
            runs[name] = [{**run, "seed": seed} for seed in range(seeds) for run in runs[name]]
        facts = list[dict[str, Any]]()
        about |= {"splits": facts, "configuration": experiment.configuration, "seeds": list(range(seeds))}
        for each in splits:
            (train, test), motions = each.apply(experiment.rows), experiment.motions(each)
            sides = {"training_rows": len(train), "test_rows": len(test), "motions": len(motions)}
            facts.append(each.to_dict() | sides | {"notes": list(motions.notes)})
        scores = _scores(log, runs, chosen, about, partial(_on_all_rows, experiment, chosen))
        if folder is not None:
            with store.locked():
                write(scores, store.folder)
    return scores


def _on_all_rows(
    experiment: Experiment, chosen: Mapping[str, Candidate], name: str, before: Mapping[str, Posterior]
) -> Posterior:
    work, of = chosen[name], chosen[name].identification
    identified = None if of is None else identified_model(of, experiment.model, experiment.rows, before.get(of))
    return experiment.fitted(work, experiment.rows_for(identified), experiment.recording, identified)


def write(scores: Scores, folder: Path) -> None:
    """The page and all numbers into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / RESULTS, scores.to_dict())
    write_text(folder / PAGE, page(scores))


def _scores(
    log: Dataset,
    runs: Mapping[str, Sequence[Mapping[str, Any]]],
    models: Mapping[str, Candidate],
    about: Mapping[str, Any],
    fit: Callable[[str, Mapping[str, Posterior]], Posterior],
) -> Scores:
    units = {name: log.units[name] for name in ("q", "v", "u", "a")}
    return Scores(
        models={name: {"kind": each.kind, "summary": each.summary} for name, each in models.items()},
        runs=runs,
        joint_names=tuple(log.joint_names),
        units={name: unit if isinstance(unit, str) else list(unit) for name, unit in units.items()},
        about=about,
        fit=fit,
    )
