"""`forcegp validate`: models side by side on rows of a log that none of them has seen."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import forcegp
import forcegp.parallel
import forcegp.validation
from forcegp.atomic_files import file_digest
from forcegp.cli.command import DATASET, FIELDS, Resuming, listed, unless_given
from forcegp.cli.input_options import PreparationOptions, RobotOptions, forces_of
from forcegp.cli.terminal import NONE, Terminal, columns, number, percent

SAME = ("points", "starts", "integrator", "identification", "restarts", "iterations")
"""Options that have the names of fields of `forcegp.Comparison`."""
IDENTIFICATION = "bodies+viscous+coulomb+rotor@accelerations, @torques:both where the base moves"
BRIEF = ("models", "winners", "verdicts", "against_baseline", "splits", "preparation", "mass_matrix", "seeds", "points")
"""What --json prints of the document."""


@dataclass(frozen=True, kw_only=True)
class Validate(Resuming, PreparationOptions, RobotOptions):
    """Fit models side by side, score them on rows that are held out, and write one page about them.

    Every model learns from the same rows; what is held out is whole episodes, or blocks of time with a guard around
    them. After an interruption the same command resumes; with more --models or --seeds it computes only these. The
    page is report.md in the folder, the numbers are in results.json, and the recommended model, learned from
    all rows, is in model; see docs/how-to/validation.md.

    For example:
      forcegp validate log.h5 --robot arm.urdf --split episodes:3,7 --cutoff 20 --trim 0.1 --every 5 --out results
      forcegp validate log.h5 --split blocks:5:3,5 --guard 0.25 --models given,identified+gp:joint --out few
    """

    data: Annotated[Positional[Path], DATASET, arg(metavar="DATA")]
    """The dataset (HDF5), raw or prepared."""
    out: Annotated[Path, arg(metavar="FOLDER")] = field()
    """The folder of results; an unfinished run resumes."""
    split: Annotated[str, arg(metavar="SPLIT")] = "auto"
    """What is held out. episodes:N,N...: these episodes. leave-one-out: every episode once. fraction:F[:SEED]: a
    fraction of the episodes. blocks:N:K,K...: of N blocks of time of every episode those of these numbers, from 1.
    auto: a quarter of the episodes, or with one episode blocks:5:3,5."""
    guard: Annotated[float, arg(metavar="S")] = 0.25
    """Seconds of training rows left out beside held-out blocks."""
    models: Annotated[tuple[str, ...], listed("NAME,...", "some of every kind", goes_on=FIELDS)] = ()
    """FORCES[@EVIDENCE], as for forcegp fit but joined by "+". given: the robot as given. identified: as
    --identification finds it. gp:independent: without physics. gp:joint-friction: unknown forces on the robot as given;
    identified+gp:joint-friction: on it as identified. viscous+coulomb@torques: laws alone, from all rows.
    identified@motions:1: refined on the motions of the training rows."""
    identification: Annotated[str | None, unless_given("FORCES@EVIDENCE", IDENTIFICATION, str)] = None
    """What `identified` is, whose mass matrix turns errors of accelerations into forces."""
    every: Annotated[int | None, unless_given("N", "what the filter leaves", int)] = None
    """Keep every N-th row, after the filter."""
    points: Annotated[int, arg(metavar="N")] = 100
    """Rows that models learn from: those that lie farthest apart among two thirds of the training rows. Friction of the
    joints and other functions of one or two inputs learn from all, as identifications do."""
    margin: Annotated[float, arg(metavar="RATIO")] = 0.02
    """Models whose errors differ by less count as equal."""
    seeds: Annotated[int, arg(metavar="N")] = 5
    """Number of random choices of the rows that models learn from."""
    horizon: Annotated[tuple[float, ...], listed("S,...", of=float)] = (0.1, 0.2, 0.5, 1.0)
    """Lengths of the motions that are predicted from held-out states, in s."""
    starts: Annotated[int, arg(metavar="N")] = 10
    """Motions from every held-out stretch of time."""
    integrator: Annotated[str, arg(metavar="NAME")] = "rk4"
    """How motions are predicted: rk4, symplectic-euler, implicit-midpoint or projected."""
    restarts: Annotated[int | None, unless_given("R", "4 up to 400 points, else 1")] = None
    """Starts of every search for hyper-parameters; the best is kept."""
    iterations: Annotated[int | None, unless_given("N", "200", int)] = None
    """Most iterations of each start."""
    jobs: Annotated[int, arg(metavar="J")] = 1
    """So many pieces of work at once, each on one core."""
    overwrite: bool = False
    """Compute everything anew where the folder holds results."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Compute what is missing, and write the page."""
        forcegp.parallel.checked_jobs(self.jobs)
        start = time.monotonic()

        comparison, digest = self._comparison(terminal), file_digest(self.data)
        text, robot = f"{self.data} (SHA-256 {digest[:16]}…)", [f"robot from {self.robot}"] * (self.robot is not None)
        for note in forces_of(comparison.model):
            terminal.note(note)
        with terminal.progress(f"validating: {len(comparison.splits)} split(s), {self.seeds} seed(s)") as report:
            validation = forcegp.validate(
                comparison,
                self.out,
                models=self.models or None,
                seeds=self.seeds,
                jobs=self.jobs,
                source={"title": str(self.data), "data": [text, *robot], "sha256": digest},
                margin=self.margin,
                overwrite=self.overwrite,
                progress=report,
            )
        best = forcegp.validation.recommended(validation.document)
        if best is not None:
            with terminal.progress(f"learning {best} from all rows"):
                posterior = forcegp.validation.fitted_on_all_rows(comparison, best)
                forcegp.save_posterior(posterior, self.out / "model", overwrite=True)
            terminal.note(f"{best}, learned from all rows: {self.out / 'model'}")
        terminal.note(f"{time.monotonic() - start:.0f} s; numbers: {self.out / 'results.json'}")
        terminal.show(*self._report(validation.document))
        return {"out": str(self.out), **{name: validation.document[name] for name in BRIEF}}

    def _comparison(self, terminal: Terminal) -> forcegp.Comparison:
        raw = forcegp.Dataset.load(self.data)
        model = self.chosen_model(raw, self.data)
        raw = replace(raw, model=model)
        preparation = self._preparation()
        if preparation.changes_nothing:
            rows = recording = raw
        else:
            preparation = preparation.resolved(raw)
            if self.every is None:
                preparation = replace(preparation, every=preparation.thinning(raw))
            rows = preparation.apply(raw).dataset
            recording = rows if preparation.every == 1 else replace(preparation, every=1).apply(raw).dataset
            self._warn_of_memory(terminal, preparation.cutoff, preparation.order)
        return forcegp.Comparison(
            rows,
            recording,
            model,
            forcegp.split_named(rows, self.split, self.guard),
            horizons=self.horizon,
            **{name: getattr(self, name) for name in SAME},
        )

    def _warn_of_memory(self, terminal: Terminal, cutoff: Any, order: int) -> None:
        """A filter mixes what lies on both sides of a border."""
        if cutoff is None or not (self.split.startswith("blocks") or self.split == "auto"):
            return
        memory = 1.0 / (2.0 * math.pi * cutoff * math.sin(0.5 * math.pi / order))
        if self.guard < 2.0 * memory:
            terminal.warn(
                f"--guard {self.guard:g} s is shorter than two time constants of the filter ({2.0 * memory:.2g} s), so "
                "rows on both sides of a border share measurements; give a longer one."
            )

    def _report(self, document: Mapping[str, Any]) -> list[Any]:
        def median(value: Mapping[str, Any] | None, show: Callable[[float | None], str] = number) -> str:
            return show(None if value is None else value["median"])

        rows = []
        for name, model in document["models"].items():
            if not model["runs"]:
                rows.append([name, *[NONE] * 5])
                continue
            motions = model["motions"]
            last = None if motions is None or not motions["rms"] else motions["rms"][-1]
            errors = [median(model[score]) for score in ("nrmse", "force_rms", "nlpd")]
            rows.append([name, *errors, median(model["coverage_95"], percent), median(last)])
        header = ["model", "nRMSE", "force error", "NLPD", "in 95 %", "motion"]
        title = f"{self.data}: medians over {len(document['seeds'])} seed(s) and {len(document['splits'])} split(s)"
        failed = [
            f"{name} failed in {len(model['failures'])} run(s): {model['failures'][0]['error']}"
            for name, model in document["models"].items()
            if model["failures"]
        ]
        answers = [
            f"By the {forcegp.validation.SCORES[score]} take {found['model']}: {found['why'].replace('**', '')}"
            for score, found in document["winners"].items()
        ]
        page = f"The page: {self.out / 'report.md'}"
        return [columns(title, header, rows, long_names=True), *failed, *answers, page]
