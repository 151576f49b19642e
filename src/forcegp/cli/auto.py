"""`forcegp auto`: from logs and a URDF to a validated model, in one command."""

from __future__ import annotations

import math
import re
import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, cast

from tyro.conf import Positional, arg

import forcegp
import forcegp.checks
import forcegp.data
import forcegp.evidence
import forcegp.posterior
import forcegp.recordings
import forcegp.report
import forcegp.scores
from forcegp.atomic_files import atomic_file, atomic_folder, write_json
from forcegp.cli.answer import FIRST, answer_lines, short_name, verdict
from forcegp.cli.command import CONFIG, LOG, Command, options_of, unless_given
from forcegp.cli.fit import write_estimates
from forcegp.cli.logs import ColumnOptions, FilterOptions, prepared_rows
from forcegp.cli.payload import LAWS, payload_dict, payload_text, with_payload, without_explained
from forcegp.cli.robot_options import CandidateOptions, RobotOptions, forces_of
from forcegp.cli.terminal import Terminal, doubts_table, facts
from forcegp.doubts import Doubt, Doubts, wrong
from forcegp.errors import CompilerError, DatasetError, InvalidInput, MistakenUnit, NumericalError

MOST_CORRECTIONS = 8
SCORES = ("models", "joint_names", "units", "recommended", "winner", "failures")  # what the answer holds of the scores
EXPLAINED = 0.1
"""Share of a torque that is left, up to which learning from accelerations is not worth a third of the whole time: of
25 logs (benchmarks.confusion, 0.4 to 3 % left) it changed errors of motions by 4 % and of accelerations by 2 %."""


@dataclass(frozen=True, kw_only=True)
class Auto(Command):
    """From logs and a robot to a validated model: import, check, prepare, identify, learn, score, report.

    Mistakes in the log (units, signs, order of joints) are reported with the command that corrects them; --correct
    corrects them at once. The folder gets the model of the recommended kind, learned from all rows: model, for
    forcegp score and monitor, and c with its C code. Beside them are report.html, identified.urdf,
    payload.json, the comparison (validation/report.md) and the dataset. A run that was interrupted resumes.

    For example:
      forcegp auto run.csv --time t --q 'pos{1..6}' --u 'tau{1..6}' --robot arm.urdf --out answer
      forcegp auto walk.csv --mapping columns.yaml --robot dog.urdf --base floating --feet FL_foot,FR_foot --out answer
      forcegp auto flight.csv --mapping columns.yaml --identified drone.json --out answer
    """

    interrupted, replaces = "finished pieces are kept, and the same command resumes", False

    logs: Positional[Annotated[tuple[Path, ...], LOG, arg(metavar="LOG...", help_behavior_hint="")]]
    """Files, or folders of ROS 2 bags, of --robot. Thrusters, actuators and other contacts come with --identified."""
    out: Annotated[Path, arg(metavar="FOLDER")]
    """The folder of results; an unfinished one resumes."""
    correct: bool = False
    """Correct mistakes in units, signs and the order of joints, and continue."""
    accept: bool = False
    """Continue although the log contains mistakes."""
    link: Annotated[str | None, unless_given("LINK", "a base that moves, else the last link", str)] = None
    """Where a payload may be."""
    logs_from: Annotated[Path | None, unless_given("LIST", "one log", Path)] = None
    """In the place of LOG a text file with one in each line, and the options that differ for it, such as --robot.
    --out gets a folder for each and fleet.csv; --jobs logs are at work at once. What is finished is kept."""
    robot: RobotOptions = RobotOptions()
    columns: ColumnOptions = ColumnOptions()
    filter: FilterOptions = FilterOptions(cutoff="auto", delay="auto")
    models: CandidateOptions = CandidateOptions()

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Do all of it. Raises DatasetError for mistakes that nobody has corrected yet."""
        from forcegp.fit.force_sensors import with_touches  # PyTorch is not needed for a page of help
        from forcegp.fit.friction_choice import with_choice_of
        from forcegp.scores.models import candidates

        if not self.logs:
            raise InvalidInput("give at least one log.")
        begin = time.process_time()
        self.filter.preparation()  # refused now, not after minutes
        present = self.out.is_dir() and any(not each.name.startswith(".") for each in self.out.iterdir())
        if self.out.is_file() or (present and not self.wrote(self.out)):
            raise InvalidInput(f"{self.out} was not written by forcegp auto; choose another name.")
        if not self.out.parent.is_dir():
            raise InvalidInput(f"the folder {self.out.parent} does not exist; create it first.")
        model, mapping = self.columns.model(self.robot), self.columns.mapped(self.logs, terminal)
        model.with_forces(forcegp.Payload(self.link, None, None))  # a link and forces that are not there, likewise
        candidates(self.models.names() or ("given",), model, identification(model))
        for note in forces_of(model):
            terminal.note(note)
        dataset, done, mapping, mistakes, robot = self._imported(terminal, model, mapping)
        model, corrected = self.columns.model(robot), self._command(mapping, robot)
        if mistakes and not self.correct:
            terminal.show(doubts_table(Doubts(mistakes), terminal.worded), "Run:")
            terminal.command(corrected)
            raise DatasetError(f"{Doubts(mistakes).subjects}: wrong. Run the command above, or add --correct.")
        terminal.names_stages = True  # of minutes, most of which have nothing to count
        with terminal.progress("checking"):
            report = forcegp.check(dataset)
            dataset, felt = with_touches(dataset, report.doubts)
            if felt:
                report = forcegp.check(dataset)
                report = replace(report, doubts=Doubts([*felt, *report.doubts]))
        late, found = self.filter.delay, (x.numbers.get("delay", math.nan) for x in report.doubts.of("delay"))
        mended = late == "auto" or all(abs(x - float(late)) <= 0.5 * abs(x) for x in found)  # u is shifted below
        bad = Doubts(doubt for doubt in report.doubts.at("wrong") if doubt.about != "delay" or not mended)
        still = [x for doubt in report.doubts for x in doubt.numbers.get("still", ())]
        if bad and not self.accept:
            terminal.show(doubts_table(bad, terminal.worded))
            raise DatasetError(f"something is wrong with the log ({bad.subjects}); correct it, or add --accept.")
        early = {"unknown cause"} | ({"contact flag"} if done["open_switches"] else set())  # flags of its own
        for doubt in report.doubts.at("look"):  # what is known already, while the rest takes minutes
            if doubt.about not in early:  # a model may explain what has no cause
                terminal.note(f"{doubt.about}: {doubt.what}")
        dataset = forcegp.checks.without_pushes(dataset, report.doubts)
        self.out.mkdir(parents=True, exist_ok=True)
        self._require_same("log.h5", dataset, "is of another log")
        if not present:  # by which an unfinished folder is known
            write_json(self.out / CONFIG, {"kind": self.kind, "command": corrected})
        with atomic_file(self.out / "log.h5", overwrite=True) as temporary:
            dataset.save(temporary)
        with terminal.progress("preparing"):
            rows, recording = self._prepared_rows(terminal, dataset, bool(done["open_switches"]), report)
        settings = dict(rows.metadata["preparation"])
        with terminal.progress("identifying"):
            expression, found = forcegp.scores.identify(recording, identification(model, more_laws(report.doubts)))
        identified: Any = found
        laws = forcegp.scores.summands(expression.partition("@")[0])[1:]
        payload: dict[str, Any] = {}
        with terminal.progress("looking for a payload"):
            try:
                given = forcegp.scores.named_model(recording.model, laws)
                given = with_choice_of(given, identified)  # these parts, whatever it carries
                loaded = with_payload(given, recording, self.link)
                payload, held = payload_dict(loaded, False), payload_text(loaded)
                report = replace(report, doubts=without_explained(report.doubts, loaded, recording))
            except DatasetError as error:
                held = f"not estimated: {error}"
        terminal.note(f"payload: {held}")
        scores, posterior = self._scored(terminal, rows, recording, expression, identified, still)
        content: dict[str, Any] = {
            "out": str(self.out),
            "seconds": (len(dataset) - len(dataset.episodes))
            * (done["resampled_to_step"] or done["recordings"][0]["median_step"]),
            "import": done,
            "mistakes": [doubt.to_dict() for doubt in mistakes],
            "check": report.to_dict(),
            "preparation": settings,
            "payload": payload or None,
            "identified": identified.estimates.to_dict(),
            **{name: value for name, value in scores.to_dict().items() if name in SCORES},
            "code": self._code(terminal, posterior),
        }
        answer = answer_lines(content, dataset, recording, identified, held, scores, still)
        first = next((f"Settle the {about} first. Until then: " for about, _ in answer if about in FIRST), "")
        best = first + verdict(scores, dataset, still)
        content |= {"answer": [": ".join(line) for line in answer], "best": best}
        self._write_report(terminal, posterior, recording, content, answer, scores)
        content |= {"cpu_seconds": time.process_time() - begin}
        write_json(self.out / "payload.json", payload)
        write_estimates(self.out, identified)
        write_json(self.out / CONFIG, {"kind": self.kind, "command": corrected, **content})
        terminal.show(facts("", dict(answer)), best)
        return content

    def _imported(
        self, terminal: Terminal, model: forcegp.Model, mapping: forcegp.recordings.ColumnMapping
    ) -> tuple[forcegp.Dataset, dict[str, Any], forcegp.recordings.ColumnMapping, list[Doubt], RobotOptions]:
        mistakes, robot = list[Doubt](), self.robot
        for _ in range(MOST_CORRECTIONS):
            try:
                with terminal.progress("importing"):
                    options, undecided = self.columns.options(), None
                    dataset = forcegp.import_recordings(self.logs, mapping, model=model, options=options)
            except MistakenUnit as error:
                meant = error.unit if error.sure else error.unit.replace("deg", "rad")  # which torques decide
                unit, what = {error.quantity: tuple(meant.split(","))}, str(error).partition(" Is ")[0]
                if error.sure:
                    mistakes.append(wrong(about=f"unit of {error.quantity}", what=what, correction={"unit": unit}))
                mapping = replace(mapping, unit={**mapping.unit, **unit})
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
                dataset, stops = forcegp.checks.without_stops(dataset)
                return dataset, {**done, "stops": [each.to_dict() for each in stops]}, mapping, mistakes, robot
            mistakes += [doubt for doubt in found if doubt.correction == found[0].correction]
            robot = replace(robot, gravity=found[0].correction.get("gravity", {}).get("base", robot.gravity))
            model = self.columns.model(robot)
            mapping = mapping.corrected_by(found[0].correction, dataset.joint_names, done["columns"])
        raise DatasetError("the log is not right after eight corrections; look at it with forcegp check.")

    def _command(self, mapping: forcegp.recordings.ColumnMapping, robot: RobotOptions) -> str:
        """The same command with the columns, units and signs of the mapping, and this robot."""
        stated = {item.name for item in fields(mapping)} | {"mapping", "logs", "out"}
        others = [name for name in options_of(Auto) if name not in stated]
        words = ["forcegp", "auto", *map(str, self.logs), *mapping.flags(), *replace(self, robot=robot).words(*others)]
        return shlex.join([*words, "--out", str(self.out)])

    def _require_same(self, file: str, dataset: forcegp.Dataset, seen: str) -> None:
        """Raise InvalidInput where the folder holds other rows, which are not to be written over."""
        from forcegp.scores.experiment import fingerprint  # PyTorch is not needed for a page of help

        old = self.out / file
        if old.is_file() and not self.overwrite and fingerprint(forcegp.Dataset.load(old)) != fingerprint(dataset):
            raise InvalidInput(f"{self.out} {seen}; choose another name, or add --overwrite.")

    def _prepared_rows(
        self, terminal: Terminal, raw: forcegp.Dataset, open_switches: bool, report: forcegp.checks.CheckReport
    ) -> tuple[forcegp.Dataset, forcegp.Dataset]:  # to learn from, and the same at the full rate
        wanted, elastic = self.filter.preparation(), report.doubts.of("elastic joint")
        if wanted.cutoff == "auto" and wanted.differentiate == "q" and report.inputs.prepared is not None:
            found = forcegp.data.preparation_report(report.inputs.prepared.metadata)  # not to be sought again
            wanted = replace(wanted, cutoff=found["cutoff"], why={"cutoff": found["why"]["cutoff"]})
        if self.filter.cutoff == "auto" and elastic:
            slow = min(elastic[0].numbers["cutoff"], report.inputs.cutoff or math.inf)
            wanted = replace(wanted, cutoff=slow, why={"cutoff": "below the resonance of an elastic joint"})
        if wanted.delay == "auto" and (late := report.doubts.of("delay")) and "lag" not in late[0].numbers:
            wanted = replace(wanted, delay=late[0].numbers["delay"], why={**wanted.why, "delay": late[0].what})
        numbers = replace(wanted, every=1, stance="log").resolved(raw)
        period = 0.0 if numbers.cutoff is None else 1.0 / float(numbers.cutoff)  # in which a filter spoils the ends
        stance, every = "auto" if open_switches else "log", wanted.every
        numbers = replace(numbers, trim=max(self.filter.trim, period), stance=stance, every=every)
        rows, recording = prepared_rows(terminal, numbers, raw, thin=self.filter.every is None)
        self._require_same("prepared.h5", rows, "was filtered otherwise")
        with atomic_file(self.out / "prepared.h5", overwrite=True) as temporary:
            rows.save(temporary)
        return rows, recording

    def _scored(
        self,
        terminal: Terminal,
        rows: forcegp.Dataset,
        recording: forcegp.Dataset,
        expression: str,
        identified: forcegp.Posterior,
        still: Sequence[str],
    ) -> tuple[forcegp.scores.Scores, forcegp.posterior.Posterior]:
        """The scores of the models, and the recommended one, learned from all rows and stored."""
        model = recording.model
        how: dict[str, Any] = {"model": model, "recording": recording, "identification": expression}
        how |= {"points": min(100, len(rows) // 4), "restarts": 1}
        models = self.models.names() or default_models(model, identified, rows, still)
        with terminal.progress("scoring"):
            folder = self.out / "validation"
            scores = forcegp.score(models, rows, split="folds", seeds=1, folder=folder, overwrite=self.overwrite, **how)
        for failure in scores.failures:
            terminal.warn(failure)
        with terminal.progress("learning from all rows"):
            posterior = scores.fitted_on_all_rows({expression: identified})
        with terminal.progress("intervals of motions"):
            posterior, why_not = forcegp.scores.with_intervals_of_motions(posterior, recording)
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
        scores: forcegp.scores.Scores,
    ) -> None:
        posterior, recording = forcegp.posterior.observing(posterior, recording)
        command = dict(answer)["record next"].partition(" (")[0]
        following = [("Record the most informative motion:", command)] if command.startswith("forcegp") else []
        details = {name: content[name] for name in ("import", "mistakes", "preparation", "recommended", "payload")}
        with terminal.progress("writing the report"):
            page = forcegp.report.model_page(
                posterior, recording,
                title=f"forcegp auto {' '.join(path.name for path in self.logs)}, {posterior.model.robot.name}",
                best=content["best"], findings=answer,
                tables=[forcegp.report.scores_table(scores, {name: short_name(name) for name in scores.models})],
                next_steps=following, details=details, shapes=self.robot.robot,
            )  # fmt: skip
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


def more_laws(doubts: Doubts) -> str:
    """Beside the usual ones, what the check saw: a spring in a joint, a cable at a link."""
    pulls = [x.numbers for x in doubts.of("pull") if re.fullmatch(r"[\w.-]+", x.numbers["link"])]
    places = (f"+pull:{x['link']}:point={'/'.join(f'{value:.4f}' for value in x['point'])}" for x in pulls[:1])
    return "".join(["+spring" * bool(doubts.of("spring")), *places])


def identification(model: forcegp.Model, more: str = "") -> str:
    """What is found of the robot by itself, as `forcegp score --identification` takes it, and `more` laws of joints."""
    laws = f"+{'+'.join(LAWS)}{more}" if model.robot.single_joint_names else ""
    return f"bodies{laws}@{'torques' if model.robot.space.is_vector_space else 'torques:both'}"


def default_models(
    model: forcegp.Model, identified: forcegp.Posterior, rows: forcegp.Dataset, still: Sequence[str] = ()
) -> tuple[str, ...]:
    """What is compared: what thrusters fly through shows in no regression, so it is learned on the robot as given.

    Accelerations are learned from as well where torques predict them by half, unlike of light or still joints, and
    leave more than `EXPLAINED` of the torque of a joint; beside torques where they predict most joints alone. What is
    left by positions is learned of that of each joint, or of all.
    """
    from forcegp.checks.residuals import pushed_where_they_are  # PyTorch is not needed for a page of help

    friction = bool(model.robot.single_joint_names)
    if forcegp.data.thruster_columns(model):
        return "given", "identified", "gp:joint-friction+gp:aerodynamic" if friction else "gp:aerodynamic"
    models = ["given", "identified", *(["identified+gp:joint-friction"] if friction else [])]
    if not model.robot.space.is_vector_space or model.contacts:
        return tuple(models)
    rows = replace(rows, measured={})  # identified without them
    own, pulled = ({*pushed_where_they_are(rows, identified.model, by_all=by_all)} for by_all in (False, True))
    models += ["identified+gp:joint:inputs=q"] if pulled - own else ["identified+gp:joint-position"] * bool(own)
    if not still:
        left, missed = (x.std(axis=0) for x in forcegp.evidence.motion_residuals(rows, identified.model))
        share, much = (
            (missed < forcegp.scores.USABLE * rows.a.std(axis=0)).mean(),
            left > EXPLAINED * rows.u.std(axis=0),
        )
        some = not own | pulled >= {name for name, one in zip(rows.joint_names, much, strict=True) if one}
        models += [f"identified@{'accelerations' if share == 1.0 else 'torques:both'}"] if share > 0.5 and some else []
    return tuple(models)
