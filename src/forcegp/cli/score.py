"""`forcegp score`: models side by side on rows of a log that none of them has seen."""

from __future__ import annotations

import time
from collections.abc import Mapping
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
from forcegp.cli.command import THERE, Command, listed, unless_given
from forcegp.cli.fit import warn_of_wrong
from forcegp.cli.logs import FilterOptions, prepared_rows
from forcegp.cli.robot_options import CandidateOptions, RobotOptions, SearchOptions, forces_of, require_same_joints
from forcegp.cli.terminal import Terminal, columns
from forcegp.errors import InvalidInput, require_number

IDENTIFICATION = "bodies+viscous+coulomb+rotor@accelerations, @torques:both where the base moves"


@dataclass(frozen=True, kw_only=True)
class Score(Command):
    """Score models on rows of a log that they have not seen: errors, densities, coverage, motions; and compare them.

    Folders of forcegp fit are scored on the whole log. With --forces, or without folders, models are fitted to one side
    of a split and scored on the other, `identified` always among them. After an interruption the same command resumes.
    The page is report.md in --out, all numbers are in results.json, and the model to take, learned from all rows, is in
    model; see docs/how-to/scoring.md.

    For example:
      forcegp score run test.h5 --horizon .1,1 --out scores
      forcegp score run test.h5 --json | jq .models.run.scores.acceleration.mae.all.median
      forcegp score log.h5 --robot arm.urdf --split episodes:3,7 --cutoff 20 --trim 0.1 --out results
      forcegp score run log.h5 --forces given --forces gp:joint,viscous@accelerations --out few
    """

    interrupted, replaces = "finished pieces are kept, and the same command resumes", False

    paths: Annotated[Positional[tuple[Path, ...]], THERE, arg(metavar="[RUN...] LOG", help_behavior_hint="")]
    """A dataset (HDF5), and before it, if wished, folders of models."""
    identification: Annotated[str | None, unless_given("FORCES@EVIDENCE", IDENTIFICATION, str)] = None
    """What `identified` is, whose mass matrix turns errors of accelerations into forces."""
    split: Annotated[str | None, unless_given("SPLIT", "auto, where anything is fitted", str)] = None
    """What is held out. episodes:N,N...: these episodes. leave-one-out: every episode once. blocks:N:K,K...: of N
    blocks of time of every episode those of these numbers, from 1. auto: a quarter of episodes, or blocks:5:3,5."""
    guard: Annotated[float, arg(metavar="S")] = 0.25
    """Seconds of training rows left out beside held-out blocks; at least two time constants of the filter."""
    seeds: Annotated[int, arg(metavar="N")] = 5
    """Number of random choices of the rows that models learn from, among two thirds of the training rows."""
    horizon: Annotated[tuple[float, ...], listed(float), unless_given("S,...", ".1,.2,.5,1 after a fit")] = ()
    """Lengths of the motions that are predicted from recorded states under recorded forces, in s."""
    starts: Annotated[int, arg(metavar="N")] = 10
    """Motions from every held-out stretch of time."""
    integrator: Annotated[str, arg(metavar="NAME")] = "rk4"
    """How motions are predicted: rk4, symplectic-euler (as kuka-surface), implicit-midpoint (stiff friction)."""
    observe: Annotated[float, arg(metavar="S")] = 0.0
    """Seconds at the beginning of LOG that a RUN learns from, as a robot at work could; the rest is scored."""
    out: Annotated[Path | None, unless_given("FOLDER", "no folder")] = None
    """The folder of results: page, numbers, models; of one RUN also report.html. An unfinished run resumes."""
    models: CandidateOptions = CandidateOptions()
    search: SearchOptions = SearchOptions(points=100)
    robot: RobotOptions = RobotOptions()
    filter: FilterOptions = FilterOptions()

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Compute what is missing, write, and show."""
        if not self.paths:
            raise InvalidInput("no LOG is given; give a dataset (.h5), and before it folders of models if wished.")
        require_number("--guard", self.guard, "give seconds, 0 or more", 0.0)
        *runs, data = self.paths
        fits = bool(self.models.forces or self.split) or not runs
        if data.is_dir():
            raise InvalidInput(f"{data} is a folder; give a dataset (.h5) last.")
        if fits and self.out is None:
            raise InvalidInput("models are fitted, which takes time; give --out FOLDER, where all of it is kept.")
        start, raw = time.monotonic(), forcegp.Dataset.load(data)
        models: dict[str, Any] = {}
        for path in runs:
            posterior = forcegp.load_posterior(path)
            require_same_joints(posterior, raw, data)
            if not models:
                warn_of_wrong(terminal, data, raw, posterior.model)
            models[path.name if path.name not in models else str(path)] = posterior
        if self.observe:
            seen = raw.time < raw.time[0] + self.observe
            if fits or len(raw.episodes) > 1 or not 0 < seen.sum() < len(raw):
                remedy = "give seconds that one record is longer than, with folders of models alone, without --forces"
                raise InvalidInput(f"--observe is {self.observe:g} s; {remedy} and --split.")
            models = {name: posterior.update(raw.rows(seen)) for name, posterior in models.items()}
            raw = raw.rows(~seen)
        models |= {name: name for name in self.models.names()}
        rows, recording, model, split = raw, raw, None, None
        if fits:
            model = self.robot.chosen_model(raw, data)
            for note in forces_of(model):
                terminal.note(note)
            given, thin = replace(raw, model=model), self.filter.every is None
            rows, recording = prepared_rows(terminal, self.filter.preparation(), given, thin=thin)
            guard, cutoff = self.guard, forcegp.data.preparation_report(rows.metadata).get("cutoff")
            if cutoff is not None:  # a filter mixes what lies on both sides of a border, two time constants wide
                guard = max(guard, 2.5 * forcegp.data.LowPass(float(cutoff)).memory)
            split = forcegp.scores.split_named(rows, self.split or "auto", guard)
        elif self.robot != RobotOptions():
            raise InvalidInput("a RUN has its own robot; leave options of the robot out, or name models by --forces.")
        else:
            rows, recording = prepared_rows(terminal, self.filter.preparation(), raw, thin=False)
        with terminal.progress(f"scoring {len(rows)} rows"):
            scores = forcegp.score(
                models or None, rows, split=split, horizons=self.horizon or (None if fits else ()), folder=self.out,
                model=model, recording=recording,
                source={"title": str(data), "data": [f"{data} (SHA-256 {file_digest(data)[:16]}…)"]},
                overwrite=self.overwrite, **vars(self.search),
                **{name: getattr(self, name) for name in ("seeds", "starts", "integrator", "identification")},
            )  # fmt: skip
        for warning in scores.warnings if not fits else ():
            terminal.warn(warning)
        content = scores.to_dict() | {"warnings": [terminal.worded(each) for each in scores.warnings]}
        if fits and (best := scores.recommended) is not None and self.out is not None:
            with terminal.progress(f"learning {best} from all rows"):
                forcegp.save_posterior(scores.fitted_on_all_rows(), self.out / "model", overwrite=True)
            terminal.note(f"{best}, learned from all rows: {self.out / 'model'}")
        if not fits and len(runs) == 1:
            self._of_one(terminal, next(iter(models.values())), rows, scores, content)
        else:
            count = len(scores.about["seeds"])
            terminal.show(*comparison(scores, f"{data}{f': medians over {count} seeds' if count > 1 else ''}"))
        if self.out is not None:
            terminal.note(f"{time.monotonic() - start:.0f} s; the page: {self.out / 'report.md'}")
        return {name: value for name, value in content.items() if name != "runs"}

    def _of_one(
        self,
        terminal: Terminal,
        posterior: forcegp.posterior.Posterior,
        rows: forcegp.Dataset,
        scores: forcegp.scores.Scores,
        content: Mapping[str, Any],
    ) -> None:
        name = next(iter(scores.models))
        title = f"{scores.models[name]['summary']}; {len(rows)} rows of {self.paths[-1]}"
        if self.out is not None:
            posterior, rows = forcegp.posterior.observing(posterior, rows)
            with terminal.progress("writing the report"):
                page = forcegp.report.model_page(
                    posterior, rows, title=f"{name} on {self.paths[-1].name}: {posterior.description}",
                    best=forcegp.report.scores_sentence(scores),
                    findings=[("warning", each) for each in content["warnings"]],
                    tables=[forcegp.report.scores_table(scores)],
                    details={key: value for key, value in content.items() if key != "runs"},
                )  # fmt: skip
            forcegp.report.write_page(self.out / "report.html", page)
            for picture in page.pictures:
                picture.save(self.out)
        header, each = forcegp.scores.model_table(scores)
        terminal.show(columns(f"{title}; accelerations in {forcegp.scores.unit_of(scores, 'a')}", header, each))


def comparison(scores: forcegp.scores.Scores, title: str) -> list[Any]:
    """Models side by side, which to take, and what failed."""
    header, rows = forcegp.scores.overall(scores)
    brief = [[cell.partition(" (")[0] for cell in row] for row in rows]
    taken = [f"take {scores.winner.model}: {scores.winner.sentence}"] if scores.winner is not None else []
    return [columns(title, [name.replace(" [", "\n[") for name in header], brief, long_names=True),
            *scores.about.get("notes", ()), *scores.failures, *taken]  # fmt: skip
