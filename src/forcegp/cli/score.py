"""`forcegp score`: models side by side on rows of a log that none of them has seen."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import forcegp
import forcegp.data
import forcegp.posterior
import forcegp.report
import forcegp.scores
from forcegp.atomic_files import file_digest
from forcegp.cli.command import NUMBERS, URDF, InputPath, Overwriting, Resuming, listed, unless_given
from forcegp.cli.contact_syntax import CONTACTS, parse_contacts
from forcegp.cli.input_options import (
    CandidateOptions,
    PreparationOptions,
    RobotOptions,
    SystemChoice,
    for_system,
    forces_of,
    require_same_joints,
)
from forcegp.cli.terminal import Terminal, columns, nats, number, percent
from forcegp.errors import ForceGPError, InvalidInput

THERE = InputPath(" does not exist; give folders of forcegp fit, and a dataset (.h5) after them.", Path.exists)
IDENTIFICATION = "bodies+viscous+coulomb+rotor@accelerations, @torques:both where the base moves"
SAME = ("points", "starts", "integrator", "identification", "restarts", "iterations")
"""Options that have the names of arguments of `forcegp.score`."""
NORMAL_FORCES = "forces along the contact normal rest on the prior alone, since accelerations do not show them"
NORMAL_FORCES_KNOWN = "it follows from the known forces alone"
NORMAL_FORCES_SEEN = "this prior leaves no force along the contact normal free, so accelerations decide it"


@dataclass(frozen=True, kw_only=True)
class Score(CandidateOptions, Resuming, PreparationOptions, RobotOptions, Overwriting):
    """Score models on rows of a log that they have not seen: errors, densities, coverage, motions; and compare them.

    Folders of forcegp fit are scored on the whole log. With --forces, or without folders, models are fitted to one side
    of a split and scored on the other, `identified` always among them. After an interruption the same command resumes.
    The page is report.md in --out, all numbers are in results.json, and the model to take, learned from all rows, is in
    model; see docs/how-to/scoring.md.

    For example:
      forcegp score run test.h5 --horizon .1,1 --report report.html
      forcegp score run test.h5 --json | jq .models.run.scores.acceleration.mae.all.median
      forcegp score log.h5 --robot arm.urdf --split episodes:3,7 --cutoff 20 --trim 0.1 --out results
      forcegp score run log.h5 --forces given --forces gp:joint,viscous@accelerations --out few
    """

    paths: Annotated[Positional[tuple[Path, ...]], THERE, arg(metavar="[RUN...] LOG")]
    """A dataset (HDF5), and before it, if wished, folders of models."""
    identification: Annotated[str | None, unless_given("FORCES@EVIDENCE", IDENTIFICATION, str)] = None
    """What `identified` is, whose mass matrix turns errors of accelerations into forces."""
    split: Annotated[str | None, unless_given("SPLIT", "auto, where anything is fitted", str)] = None
    """What is held out. episodes:N,N...: these episodes. leave-one-out: every episode once. fraction:F[:SEED]: a
    fraction of the episodes. blocks:N:K,K...: of N blocks of time of every episode those of these numbers, from 1.
    auto: a quarter of the episodes, or with one episode blocks:5:3,5. leave-out: nothing; stretches of time are left
    out of one fit in closed form."""
    every: Annotated[int | None, unless_given("N", "what the filter leaves", int)] = None
    """Keep every N-th row, after the filter."""
    guard: Annotated[float, arg(metavar="S")] = 0.25
    """Seconds of training rows left out beside held-out blocks."""
    points: Annotated[int, arg(metavar="N")] = 100
    """Rows that models learn from: those that lie farthest apart among two thirds of the training rows. Friction of the
    joints and other functions of one or two inputs learn from all, as identifications do."""
    seeds: Annotated[int, arg(metavar="N")] = 5
    """Number of random choices of the rows that models learn from."""
    horizon: Annotated[tuple[float, ...], listed("S,...", ".1,.2,.5,1 where anything is fitted", of=float)] = ()
    """Lengths of the motions that are predicted from recorded states under recorded forces, in s."""
    starts: Annotated[int, arg(metavar="N")] = 10
    """Motions from every held-out stretch of time."""
    integrator: Annotated[str, arg(metavar="NAME")] = "rk4"
    """How motions are predicted: rk4, symplectic-euler (as PyBullet), implicit-midpoint (stiff friction), projected
    (contacts hold exactly)."""
    restarts: Annotated[int | None, unless_given("R", "4 up to 400 points, else 1")] = None
    """Starts of every search for hyper-parameters; the best is kept."""
    iterations: Annotated[int | None, unless_given("N", "200", int)] = None
    """Most iterations of each start."""
    system: SystemChoice = "model"
    """Robot and contacts that a RUN predicts for: model, those that it was trained with; data, those of the log."""
    contact: Annotated[tuple[str, ...], listed(CONTACTS, "those of --system", goes_on=NUMBERS)] = ()
    """A RUN predicts under these contacts instead, for example a stuck joint; same form as for forcegp fit."""
    jobs: Annotated[int, arg(metavar="J")] = 1
    """So many pieces of work at once, each on one core."""
    out: Annotated[Path | None, unless_given("FOLDER", "no folder")] = None
    """The folder of results: page, figures, numbers, models. An unfinished run resumes."""
    report: Annotated[Path | None, unless_given("FILE.html", "no report")] = None
    """Also write a report on the one RUN in one file: the robot in motion with its forces, figures and errors."""
    shapes: Annotated[Path | None, URDF, unless_given("ROBOT.urdf", "capsules")] = None
    """A URDF with visual elements for the links in the report, its meshes beside it."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Compute what is missing, write, and show."""
        if not self.paths:
            raise InvalidInput("no LOG is given; give a dataset (.h5), and before it folders of models if wished.")
        *runs, data = self.paths
        fits = bool(self.forces or self.split) or not runs
        if data.is_dir():
            raise InvalidInput(f"{data} is a folder; give a dataset (.h5) last.")
        self.require_free_file(self.report, forcegp.report.is_page, "a report")
        if fits and self.out is None:
            raise InvalidInput(
                "models are fitted, which takes time; give --out FOLDER, where all that is done is kept."
            )
        if self.report is not None and len(runs) != 1:
            raise InvalidInput(f"{len(runs)} runs were given; a report is of one RUN.")
        start = time.monotonic()
        raw = forcegp.Dataset.load(data)
        models: dict[str, Any] = {}
        for path in runs:
            models[path.name if path.name not in models else str(path)] = self._loaded(terminal, path, raw, data)
        models |= {name: name for name in self.candidates()}
        rows, recording, model = self._prepared(terminal, raw, data) if fits else (self._thinned(raw), raw, None)
        split = self.split if self.split == "leave-out" else (
            forcegp.split_named(rows, self.split or "auto", self.guard) if fits else None
        )  # fmt: skip
        horizons = self.horizon or (None if fits else ())
        source = {"title": str(data), "data": [f"{data} (SHA-256 {file_digest(data)[:16]}…)"]}
        with terminal.progress(f"scoring {len(rows)} rows") as report:
            scores = forcegp.score(
                models or None,
                rows,
                split=split,
                horizons=horizons,
                folder=self.out,
                model=model,
                recording=recording,
                seeds=self.seeds,
                jobs=self.jobs,
                source=source,
                overwrite=self.overwrite,
                progress=report,
                **{name: getattr(self, name) for name in SAME},
            )
        for warning in scores.warnings if not fits else ():
            terminal.warn(warning)
        best = scores.recommended
        if fits and best is not None and self.out is not None:
            with terminal.progress(f"learning {best} from all rows"):
                forcegp.save_posterior(scores.fitted_on_all_rows(), self.out / "model", overwrite=True)
            terminal.note(f"{best}, learned from all rows: {self.out / 'model'}")
        content = scores.to_dict() | {"warnings": [terminal.worded(each) for each in scores.warnings]}
        if not fits and len(runs) == 1:
            [posterior] = models.values()
            content |= self._of_one(terminal, posterior, rows, scores, content)
        else:
            terminal.show(*comparison(scores, f"{data}: medians over {len(scores.about['seeds'])} seed(s)"))
        if self.out is not None:
            terminal.note(f"{time.monotonic() - start:.0f} s; the page: {self.out / 'report.md'}")
        return {name: value for name, value in content.items() if name not in ("runs", "identifications")}

    def _loaded(self, terminal: Terminal, path: Path, log: forcegp.Dataset, data: Path) -> forcegp.posterior.Posterior:
        """A fitted model for the chosen system and contacts."""
        posterior = forcegp.load_posterior(path)
        require_same_joints(posterior, log, data)
        posterior = for_system(terminal, posterior, log, self.system)
        if self.contact:
            contacts = [*parse_contacts(self.contact), *posterior.model.loops]
            posterior = posterior.with_model(posterior.model.with_contacts(contacts))
        return posterior

    def _thinned(self, log: forcegp.Dataset) -> forcegp.Dataset:
        if self.every is not None and self.every < 1:
            raise InvalidInput(f"--every is {self.every}; it must be at least 1.")
        return log.rows(slice(None, None, self.every))

    def _prepared(
        self, terminal: Terminal, raw: forcegp.Dataset, data: Path
    ) -> tuple[forcegp.Dataset, forcegp.Dataset, forcegp.Model]:
        """Rows to learn from and to score, the same at the full rate, and the robot as given."""
        model = self.chosen_model(raw, data)
        for note in forces_of(model):
            terminal.note(note)
        raw = replace(raw, model=model)
        preparation = self._preparation()
        if preparation.changes_nothing:
            return raw, raw, model
        preparation = preparation.resolved(raw)
        if self.every is None:
            preparation = replace(preparation, every=preparation.thinning(raw))
        rows = preparation.apply(raw)
        recording = rows if preparation.every == 1 else replace(preparation, every=1).apply(raw)
        if preparation.cutoff is not None and (self.split or "auto").startswith(("blocks", "auto")):
            # a filter mixes what lies on both sides of a border
            memory = 2.0 * forcegp.data.LowPass(float(preparation.cutoff)).time_constant
            if self.guard < memory:
                terminal.warn(
                    f"--guard {self.guard:g} s is shorter than two time constants of the filter ({memory:.2g} s), so "
                    "rows on both sides of a border share measurements; give a longer one."
                )
        return rows, recording, model

    def _of_one(
        self,
        terminal: Terminal,
        posterior: forcegp.posterior.Posterior,
        rows: forcegp.Dataset,
        scores: forcegp.Scores,
        content: Mapping[str, Any],
    ) -> dict[str, Any]:
        """What is shown, drawn and written of a single model."""
        name = next(iter(scores.models))
        # what an observer reports is neither robot nor contact
        trained, here = ({**each.to_dict(), "forces": None} for each in (posterior.trained, posterior.model))
        where = ", carried to another robot or contacts" if trained != here else ""
        title = f"{scores.models[name]['summary']}{where}; {len(rows)} rows of {self.paths[-1]}"
        title += f"; errors in {unit_of_a(rows)}"
        known = not posterior.latent_names
        rests = forcegp.scores.normal_force_rests_on_prior(posterior)
        why = NORMAL_FORCES_KNOWN if known else NORMAL_FORCES if rests else NORMAL_FORCES_SEEN
        posterior, rows = forcegp.posterior.observing(posterior, rows)
        if self.out is not None:
            draw(terminal, self.out, posterior, rows)
        if self.report is not None:
            with terminal.progress("writing the report") as progress:
                page = forcegp.report.model_page(
                    posterior,
                    rows,
                    title=f"{name} on {self.paths[-1].name}: {posterior.description}",
                    best=forcegp.report.scores_sentence(scores, unit_of_a(rows)),
                    findings=[forcegp.report.Finding("warning", each) for each in content["warnings"]],
                    tables=[forcegp.report.scores_table(scores)],
                    details={key: value for key, value in content.items() if key != "runs"},
                    shapes=self.shapes,
                    progress=progress,
                )
                forcegp.report.write_page(self.report, page, overwrite=self.overwrite)
            terminal.note(f"report: {self.report}")
        terminal.show(joint_table(title, scores), quantity_table(scores))
        if "contact force" in scores.quantities():
            terminal.show(f"Contact force: {why}.")
        return {"normal_force_rests_on_prior": rests}


def draw(
    terminal: Terminal, folder: Path, posterior: forcegp.posterior.Posterior, dataset: forcegp.Dataset
) -> list[str]:
    """Write every plot of one model that these data allow to `folder`; returns the names of the files."""
    figures, drawn = forcegp.scores.model_figures(posterior, dataset), []
    with terminal.progress("drawing") as report:
        for done, (name, (_, figure)) in enumerate(figures.items()):
            report(done, len(figures), name)
            with contextlib.suppress(ForceGPError):  # what these data do not allow
                forcegp.scores.save_figure(figure(), folder / f"{name}.png")
                drawn.append(f"{name}.png")
    return drawn


def unit_of_a(dataset: forcegp.Dataset) -> str:
    """Of the accelerations of all joints, or that each has its own."""
    units = dataset.units["a"]
    return units.replace("^2", "²") if isinstance(units, str) else "the units of each joint"


def comparison(scores: forcegp.Scores, title: str) -> list[Any]:
    """Models side by side, which to take by every criterion, and what failed."""
    header, rows = forcegp.scores.overall(scores)
    brief = [[cell.partition(" (")[0] for cell in row] for row in rows]
    answers = [
        f"By the {forcegp.scores.CRITERIA[criterion]} take {found['model']}: {found['why'].replace('**', '')}"
        for criterion, found in scores.winners.items()
    ]
    return [columns(title, [name.replace(" [", "\n[") for name in header], brief, long_names=True),
            *scores.failures, *answers]  # fmt: skip


QUANTITY = {"mae": number, "rmse": number, "relative_rmse": percent, "coverage_95": percent}
BY_JOINT = (
    ("MAE", "acceleration", "mae", number),
    ("noise-\nfree", "true acceleration", "mae", number),
    ("RMSE", "acceleration", "rmse", number),
    ("NLPD", "acceleration", "nlpd", nats),
    ("in 95 %\nband", "acceleration", "coverage_95", percent),
    ("MAE, known\nphysics", "acceleration", "known_physics_mae", number),
)


def joint_table(title: str, scores: forcegp.Scores) -> Any:
    """One line per joint and their mean, of one model."""
    held = scores.quantities()
    cells: list[Sequence[str]] = []
    for _, quantity, score, show in BY_JOINT:
        known = score in held.get(quantity, ())
        each = scores.columns(score, quantity) if known else [None] * len(scores.joint_names)
        mean = scores.value(score, quantity) if known else None
        mean = scores.value("nlpd", "all joints") if score == "nlpd" else mean
        cells.append([show(value) for value in (*each, mean)])
    rows = [list(row) for row in zip([*scores.joint_names, "mean (NLPD: joint)"], *cells, strict=True)]
    return columns(title, ["joint", *(name for name, *_ in BY_JOINT)], rows[:-1], last=rows[-1])


def quantity_table(scores: forcegp.Scores) -> Any:
    """What was scored beside accelerations by joint: of all columns together, in the units of each quantity."""
    rows = []
    for name, held in scores.quantities().items():
        shown = {each: scores.value(each, name) if each in held else None for each in QUANTITY}
        if name not in ("acceleration", "all joints") and any(value is not None for value in shown.values()):
            rows.append([name, *(show(shown[each]) for each, show in QUANTITY.items())])
    return columns("", ["all joints", "MAE", "RMSE", "RMSE /\nits size", "in 95 %\nband"], rows)
