"""`forcegp auto`: from logs and a URDF to a validated model, in one command."""

from __future__ import annotations

import shlex
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, cast

from typing_extensions import override
from tyro.conf import arg

import forcegp
import forcegp.checks
import forcegp.data
import forcegp.evidence
import forcegp.report
import forcegp.scores
from forcegp.atomic_files import atomic_file, atomic_folder, write_json
from forcegp.cli.auto_answer import (
    answer_lines,
    best_sentence,
    default_models,
    identification,
    payload_text,
    short_name,
)
from forcegp.cli.command import CONFIG, URDF, Resuming, unless_given
from forcegp.cli.fit import write_estimates
from forcegp.cli.import_log import LogOptions
from forcegp.cli.input_options import CandidateOptions, forces_of
from forcegp.cli.payload import payload_dict, with_payload
from forcegp.cli.terminal import Terminal, doubts_table, facts
from forcegp.doubts import Doubt, Doubts, wrong
from forcegp.errors import CompilerError, DatasetError, InvalidInput, MistakenUnit, NumericalError

MOST_CORRECTIONS = 8
SCORES = ("models", "joint_names", "units", "recommended", "winners", "rival", "against_rival", "failures")
"""What the answer holds of the scores."""


@dataclass(frozen=True, kw_only=True)
class Auto(CandidateOptions, Resuming, LogOptions):
    """From logs and a robot to a validated model: import, check, prepare, identify, learn, score, report.

    Mistakes in the log (units, signs, order of joints) are reported with the command that corrects them; --correct
    corrects them at once. The folder gets the model of the recommended kind, learned from all rows: model, for
    forcegp score and monitor, and c with its C code. Beside them are report.html, identified.urdf,
    payload.json, the comparison (validation/report.md) and the dataset. A run that was interrupted resumes.

    For example:
      forcegp auto run.csv --time t --q 'pos{1..6}' --u 'tau{1..6}' --robot arm.urdf --out answer
      forcegp auto run1.csv run2.csv --robot arm.urdf --mapping columns.yaml --correct --out answer
      forcegp auto walk.csv --mapping columns.yaml --robot dog.urdf --base floating --feet FL_foot,FR_foot --out answer
      forcegp auto flight.csv --mapping columns.yaml --identified drone.json --out answer
    """

    robot: Annotated[Path | None, URDF, unless_given("ARM.urdf", "that of --identified", Path)] = None
    """The robot that was recorded. Thrusters, actuators and contacts of another kind come with --identified."""
    out: Annotated[Path, arg(metavar="FOLDER")] = field()
    """The folder of results; an unfinished one resumes."""
    correct: bool = False
    """Correct mistakes in units, signs and the order of joints, and continue."""
    accept: bool = False
    """Continue although the log contains mistakes."""
    link: Annotated[str | None, unless_given("LINK", "the hand or the base that explains most", str)] = None
    """Where a payload may be."""
    cutoff: Annotated[str, arg(metavar="HZ|auto|none")] = "auto"
    """Low-pass filter. auto: the one that predicts held-out torques best."""
    delay: Annotated[str, arg(metavar="S|auto")] = "auto"
    """Delay of u in the log, in s. auto: estimated where u are the torques of all joints and nothing is touched, else
    0."""
    lag: Annotated[str, arg(metavar="S|auto")] = "auto"
    """Time constant in s with which actuators follow u. auto: estimated for thrusters, 0 for joints."""
    every: Annotated[int | None, unless_given("N", "what the filter leaves", int)] = None
    """Keep every N-th row, after the filter."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Do all of it. Raises DatasetError for mistakes that nobody has corrected yet."""
        if not self.logs:
            raise InvalidInput("give at least one log.")
        if self.robot is None and self.identified is None:
            raise InvalidInput("give --robot ARM.urdf, or --identified with a system that carries its robot.")
        begin, preparation = time.process_time(), self._preparation()
        present = {each.name for each in self.out.iterdir()} if self.out.is_dir() else set()
        if self.out.is_file() or (present and "log.h5" not in present):
            raise InvalidInput(f"{self.out} was not written by forcegp auto; choose another name.")
        if not self.out.parent.is_dir():
            raise InvalidInput(f"the folder {self.out.parent} does not exist; create it first.")
        model, mapping = self._model(), self._mapping(terminal)
        assert model is not None
        for note in forces_of(model):
            terminal.note(note)
        dataset, done, mapping, mistakes = self._imported(terminal, model, mapping)
        corrected = self._command(mapping)
        if mistakes and not self.correct:
            terminal.show(doubts_table(Doubts(mistakes), terminal.worded), "Run:")
            terminal.command(corrected)
            raise DatasetError(
                f"{len(mistakes)} mistakes in the log; run the command above, or add --correct to this one."
            )
        terminal.names_stages = True  # of minutes, most of which have nothing to count
        with terminal.progress("checking"):
            report = forcegp.check(dataset)
        bad = report.doubts.at("wrong")
        if bad and not self.accept:
            terminal.show(doubts_table(bad, terminal.worded))
            raise DatasetError(
                f"something is wrong with the log ({bad.subjects}); correct it, or add --accept to continue."
            )
        self.out.mkdir(parents=True, exist_ok=True)
        with atomic_file(self.out / "log.h5", overwrite=True) as temporary:
            dataset.save(temporary)
        with terminal.progress("preparing"):
            if self.lag != "auto" or not forcegp.data.thruster_columns(dataset.model):
                timed = self.with_delay_that_shows(terminal, preparation, dataset)
            else:
                timed = replace(preparation, lag="auto", delay=0.0 if self.delay == "auto" else preparation.delay)
            timed = replace(timed, stance="auto") if done["open_switches"] else timed
            rows, recording, settings = self._prepared_rows(terminal, dataset, timed)
        named = forcegp.scores.named_model
        assert recording.model is not None, "it has one"
        expression, _, evidence = identification(model).partition("@")
        laws = forcegp.scores.summands(expression)
        with terminal.progress("identifying") as progress:
            how: dict[str, Any] = {"evidence": forcegp.evidence.parse_evidence(evidence), "report": progress}
            identified: Any = forcegp.scores.learn(named(recording.model, laws), recording, **how)[0]
        with terminal.progress("looking for a payload") as progress:
            try:
                payload = with_payload(named(recording.model, laws[1:]), recording, self.link, report=progress)
                held = payload_text(payload)
            except DatasetError as error:
                payload, held = None, f"not estimated: {error}"
        scores, posterior = self._scored(terminal, rows, recording, model)
        content: dict[str, Any] = {
            "out": str(self.out),
            "seconds": sum(each["seconds"] for each in done["recordings"]),
            "import": done,
            "mistakes": [doubt.to_dict() for doubt in mistakes],
            "check": report.to_dict(),
            "preparation": settings,
            "payload": None if payload is None else payload_dict(payload, False),
            "identified": identified.estimates.to_dict(),
            **{name: value for name, value in scores.to_dict().items() if name in SCORES},
            "code": self._code(terminal, posterior),
        }
        answer = answer_lines(content, dataset, identified, held, scores)
        best = best_sentence(scores, dataset)
        content |= {"answer": [": ".join(line) for line in answer], "best": best}
        self._write_report(terminal, posterior, recording, content, answer, scores)
        content |= {"cpu_seconds": time.process_time() - begin}
        write_json(self.out / "payload.json", content["payload"] or {})
        write_estimates(self.out, identified)
        write_json(self.out / CONFIG, {"kind": self.kind, "command": corrected, **content})
        terminal.show(facts("", dict(answer)), best)
        return content

    def _imported(
        self, terminal: Terminal, model: forcegp.Model, mapping: forcegp.ColumnMapping
    ) -> tuple[forcegp.Dataset, dict[str, Any], forcegp.ColumnMapping, list[Doubt]]:
        """The dataset behind all corrections that its own evidence asks for, and the mistakes that these correct."""
        mistakes: list[Doubt] = []
        for _ in range(MOST_CORRECTIONS):
            try:
                with terminal.progress("importing") as progress:
                    how: dict[str, Any] = {"model": model, "options": self._options(), "report": progress}
                    dataset, undecided = forcegp.import_recordings(self.logs, mapping, **how), None
            except MistakenUnit as error:
                correction = {"unit": {error.quantity: (error.unit,)}}
                what = str(error).partition(" Is ")[0]
                mistakes.append(wrong(about=f"unit of {error.quantity}", what=what, correction=correction))
                mapping = replace(mapping, unit={**mapping.unit, error.quantity: (error.unit,)})
                continue
            done = dict(dataset.metadata["import"])
            if done["open_switches"]:
                try:
                    dataset = forcegp.data.estimate_stance(dataset).filled(dataset)
                except DatasetError as error:  # of a mistake, perhaps
                    undecided = error
            found = [doubt for doubt in forcegp.checks.quick_check(dataset) if doubt.correction]
            if not found and undecided is not None:
                raise undecided
            if not found:
                return dataset, done, mapping, mistakes
            mistakes.append(found[0])
            mapping = mapping.corrected_by(found[0].correction, dataset.joint_names, done["columns"])
        raise DatasetError("the log is not right after eight corrections; look at it with forcegp check.")

    def _command(self, mapping: forcegp.ColumnMapping) -> str:
        """The same command with the columns, units and signs of the mapping."""
        stated = {item.name for item in fields(mapping)} | {"mapping", "logs", "robot", "out"}
        others = [name for name in self.options if name not in stated]
        robot = [] if self.robot is None else ["--robot", str(self.robot)]
        words = ["forcegp", "auto", *map(str, self.logs), *mapping.flags(), *robot]
        return shlex.join([*words, *self.words(*(name for name in others if hasattr(type(self), name))),
                           "--out", str(self.out)])  # fmt: skip

    @override
    def _preparation(self) -> forcegp.Preparation:
        return super()._preparation() if self.lag != "auto" else replace(self, lag="0")._preparation()

    def _prepared_rows(
        self, terminal: Terminal, raw: forcegp.Dataset, wanted: forcegp.Preparation
    ) -> tuple[forcegp.Dataset, forcegp.Dataset, dict[str, Any]]:
        """Rows to learn from, the same at the full rate, and what was done."""
        first = replace(wanted, every=1, stance="log")
        try:
            numbers = first.resolved(raw)
        except DatasetError as error:
            if self.lag != "auto" or wanted.lag != "auto":
                raise
            terminal.note(f"rotors are taken to follow at once: {error}")
            numbers = replace(first, lag=0.0).resolved(raw)
        period = 0.0 if numbers.cutoff is None else 1.0 / float(numbers.cutoff)  # in which a filter spoils the ends
        numbers = replace(numbers, trim=max(self.trim, period), stance=wanted.stance)
        every = numbers.thinning(raw) if self.every is None else wanted.every
        rows = replace(numbers, every=every).apply(raw)
        with atomic_file(self.out / "prepared.h5", overwrite=True) as temporary:
            rows.save(temporary)
        return rows, numbers.apply(raw), dict(rows.metadata["preparation"])

    def _scored(
        self, terminal: Terminal, rows: forcegp.Dataset, recording: forcegp.Dataset, model: forcegp.Model
    ) -> tuple[forcegp.Scores, forcegp.posterior.Posterior]:
        """The scores of the models, and the recommended one, learned from all rows and stored."""
        how: dict[str, Any] = {"model": model, "recording": recording, "identification": identification(model)}
        how |= {"points": min(100, len(rows) // 4), "restarts": 1}
        models = self.candidates() or default_models(model)
        with terminal.progress("scoring") as report:
            scores = forcegp.score(
                models, rows, split="auto", seeds=1, folder=self.out / "validation", overwrite=self.overwrite,
                progress=report, **how,
            )  # fmt: skip
        for failure in scores.failures:
            terminal.warn(failure)
        with terminal.progress("learning from all rows"):
            posterior = scores.fitted_on_all_rows()
        with terminal.progress("intervals of motions") as report:
            posterior, why_not = forcegp.scores.with_intervals_of_motions(posterior, recording, report)
        if why_not is not None:
            terminal.note(why_not)
        forcegp.save_posterior(posterior, self.out / "model", overwrite=True)
        return scores, posterior

    def _write_report(
        self,
        terminal: Terminal,
        posterior: forcegp.posterior.Posterior,
        recording: forcegp.Dataset,
        content: Mapping[str, Any],
        answer: list[tuple[str, str]],
        scores: forcegp.Scores,
    ) -> None:
        """The page to send around."""
        posterior, recording = forcegp.posterior.observing(posterior, recording)
        command = dict(answer)["record next"].partition(" (")[0]
        names = {name: short_name(name) for name in scores.models}
        following = [forcegp.report.Finding("Record the most informative motion:", command)]
        with terminal.progress("writing the report") as progress:
            page = forcegp.report.model_page(
                posterior,
                recording,
                title=f"forcegp auto {' '.join(path.name for path in self.logs)}, {posterior.model.robot.name}",
                best=content["best"],
                findings=[forcegp.report.Finding(*line) for line in answer],
                pictures=forcegp.report.scores_pictures(scores),
                tables=[forcegp.report.scores_table(scores, names)],
                next_steps=following if command.startswith("forcegp") else [],
                details={
                    name: content[name] for name in ("import", "mistakes", "preparation", "recommended", "payload")
                },
                shapes=self.robot,
                progress=progress,
            )
            forcegp.report.write_page(self.out / "report.html", page)

    def _code(self, terminal: Terminal, posterior: forcegp.posterior.Posterior) -> str | None:
        """The folder of the model's C program; None where there is no compiler, or none of this model."""
        try:
            with terminal.progress("writing C"), atomic_folder(self.out / "c", overwrite=True) as folder:
                forcegp.export_c(cast(forcegp.posterior.Posterior, posterior), folder)
        except (CompilerError, InvalidInput, NumericalError) as error:
            terminal.note(f"no C program: {error}")
            return None
        return str(self.out / "c")
