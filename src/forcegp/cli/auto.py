"""`forcegp auto`: from logs and a URDF to a validated model, in one command."""

from __future__ import annotations

import math
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
from forcegp.cli.command import CONFIG, LOG, Command, options_of, unless_given
from forcegp.cli.fit import write_estimates
from forcegp.cli.logs import ColumnOptions, FilterOptions, prepared_rows, resolved, stance_text
from forcegp.cli.payload import LAWS, drives_of, other_causes, payload_dict, payload_text, with_payload
from forcegp.cli.robot_options import CandidateOptions, RobotOptions, forces_of
from forcegp.cli.terminal import Terminal, doubts_table, facts, shown
from forcegp.doubts import Doubt, Doubts, wrong
from forcegp.errors import CompilerError, DatasetError, InvalidInput, MistakenUnit, NumericalError
from forcegp.scores.accuracy import ACCELERATION, TORQUE
from forcegp.scores.page import number
from forcegp.scores.scores import USABLE

MOST_CORRECTIONS = 8
SCORES = ("models", "joint_names", "units", "recommended", "winner", "failures")
"""What the answer holds of the scores."""


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

    interrupted = "finished pieces are kept, and the same command resumes"
    replaces = False

    logs: Positional[Annotated[tuple[Path, ...], LOG, arg(metavar="LOG...", help_behavior_hint="")]]
    """Files, or folders of ROS 2 bags, of the robot of --robot. Thrusters, actuators and contacts of another kind come
    with --identified."""
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
        if not self.logs:
            raise InvalidInput("give at least one log.")
        begin = time.process_time()
        self.filter.preparation()  # refused now, not after minutes
        present = {each.name for each in self.out.iterdir()} if self.out.is_dir() else set()
        if self.out.is_file() or (present and "log.h5" not in present):
            raise InvalidInput(f"{self.out} was not written by forcegp auto; choose another name.")
        if not self.out.parent.is_dir():
            raise InvalidInput(f"the folder {self.out.parent} does not exist; create it first.")
        model, mapping = self.columns.model(self.robot), self.columns.mapped(self.logs, terminal)
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
        bad, still = report.doubts.at("wrong"), [x for doubt in report.doubts for x in doubt.numbers.get("still", ())]
        if bad and not self.accept:
            terminal.show(doubts_table(bad, terminal.worded))
            raise DatasetError(f"something is wrong with the log ({bad.subjects}); correct it, or add --accept.")
        self.out.mkdir(parents=True, exist_ok=True)
        with atomic_file(self.out / "log.h5", overwrite=True) as temporary:
            dataset.save(temporary)
        with terminal.progress("preparing"):
            rows, recording = self._prepared_rows(terminal, dataset, bool(done["open_switches"]))
        settings = dict(rows.metadata["preparation"])
        with terminal.progress("identifying"):
            expression, found = forcegp.scores.identify(recording, identification(model))
        identified: Any = found
        laws = forcegp.scores.summands(expression.partition("@")[0])[1:]
        payload: dict[str, Any] = {}
        with terminal.progress("looking for a payload"):
            try:
                loaded = with_payload(forcegp.scores.named_model(recording.model, laws), recording, self.link)
                payload, held = payload_dict(loaded, False), payload_text(loaded)
            except DatasetError as error:
                held = f"not estimated: {error}"
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
        best = verdict(scores, dataset, still)
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
        """The dataset behind all corrections that its own evidence asks for, and the mistakes that these correct."""
        mistakes, robot = list[Doubt](), self.robot
        for _ in range(MOST_CORRECTIONS):
            try:
                with terminal.progress("importing"):
                    options, undecided = self.columns.options(), None
                    dataset = forcegp.import_recordings(self.logs, mapping, model=model, options=options)
            except MistakenUnit as error:
                unit = {error.quantity: tuple(error.unit.split(","))}
                what = str(error).partition(" Is ")[0]
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
            mistakes.append(found[0])
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

    def _prepared_rows(
        self, terminal: Terminal, raw: forcegp.Dataset, open_switches: bool
    ) -> tuple[forcegp.Dataset, forcegp.Dataset]:
        """Rows to learn from, and the same at the full rate."""
        wanted = self.filter.preparation()
        numbers = resolved(terminal, replace(wanted, every=1, stance="log"), raw)
        period = 0.0 if numbers.cutoff is None else 1.0 / float(numbers.cutoff)  # in which a filter spoils the ends
        stance, every = "auto" if open_switches else "log", wanted.every
        numbers = replace(numbers, trim=max(self.filter.trim, period), stance=stance, every=every)
        rows, recording = prepared_rows(terminal, numbers, raw, thin=self.filter.every is None)
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
            posterior = scores.fitted_on_all_rows()
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
        """The page to send around."""
        posterior, recording = forcegp.posterior.observing(posterior, recording)
        command = dict(answer)["record next"].partition(" (")[0]
        following = [("Record the most informative motion:", command)] if command.startswith("forcegp") else []
        details = {name: content[name] for name in ("import", "mistakes", "preparation", "recommended", "payload")}
        with terminal.progress("writing the report"):
            page = forcegp.report.model_page(
                posterior,
                recording,
                title=f"forcegp auto {' '.join(path.name for path in self.logs)}, {posterior.model.robot.name}",
                best=content["best"],
                findings=answer,
                tables=[forcegp.report.scores_table(scores, {name: short_name(name) for name in scores.models})],
                next_steps=following,
                details=details,
                shapes=self.robot.robot,
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


def short_name(name: str) -> str:
    """What a model is called in the answer."""
    laws, air = "gp:joint-friction" in name, "gp:aerodynamic" in name
    learned = " and ".join(what for what, has in (("friction", laws), ("air forces", air)) if has)
    plain = {"given": "the URDF", "identified@accelerations": "identified by accelerations"}
    plain |= {"identified@torques:both": "identified by torques and accelerations"}
    return f"{learned} learned" if learned else plain.get(name, name)


def identification(model: forcegp.Model) -> str:
    """What is found of the robot by itself, as `forcegp score --identification` takes it."""
    laws = f"+{'+'.join(LAWS)}" if model.robot.single_joint_names else ""
    return f"bodies{laws}@{'torques' if model.robot.space.is_vector_space else 'torques:both'}"


def default_models(
    model: forcegp.Model, identified: forcegp.Posterior, rows: forcegp.Dataset, still: Sequence[str] = ()
) -> tuple[str, ...]:
    """What is compared: what thrusters fly through shows in no regression, so it is learned on the robot as given.

    Accelerations are learned from as well where torques predict them by half, unlike of light or still joints; beside
    torques where they do so in most joints alone.
    """
    friction = bool(model.robot.single_joint_names)
    if forcegp.data.thruster_columns(model):
        return "given", "identified", "gp:joint-friction+gp:aerodynamic" if friction else "gp:aerodynamic"
    models = ["given", "identified", *(["identified+gp:joint-friction"] if friction else [])]
    if model.robot.space.is_vector_space and not model.contacts and not still:
        missed = forcegp.evidence.motion_residuals(rows, identified.model)[1].std(axis=0)
        share = (missed < USABLE * rows.a.std(axis=0)).mean()
        models += [f"identified@{'accelerations' if share == 1.0 else 'torques:both'}"] if share > 0.5 else []
    return tuple(models)


def answer_lines(
    content: Mapping[str, Any],
    dataset: forcegp.Dataset,
    recording: forcegp.Dataset,
    identified: Any,
    held: str,
    scores: forcegp.scores.Scores,
    still: Sequence[str],
) -> list[tuple[str, str]]:
    """What was found, in ten lines."""
    from forcegp.fit.friction_choice import friction_in_words  # PyTorch is not needed for a page of help

    values, robot, best = identified.estimates, identified.model.robot, scores.recommended
    assert best is not None, "a model was scored"
    done, prepared, seconds, out = content["import"], content["preparation"], content["seconds"], content["out"]
    deviation = max(each["largest_deviation_of_a_step"] for each in done["recordings"])
    jitter = f", steps up to {deviation:.0%} off (evened out)" if done["resampled_to_step"] is not None else ""
    told, doubts = {"stop", "spring", "drift", "unknown cause"}, (*done["stops"], *content["check"]["doubts"])
    seen = [(x["about"], f"{x['what']} {x['do']}") for x in doubts if x["about"] in told]
    flags = ((each["command"].removeprefix("forcegp import "), each["about"]) for each in content["mistakes"])
    mistakes = ", ".join(text.replace("--unit ", "").replace("--", "") or wrong for text, wrong in flags) or "nothing"
    late, lag, rate = prepared["delay"], prepared["lag"], (len(dataset) - len(dataset.episodes)) / seconds
    early = "early: a controller that holds u is half a time step" if -late * rate < 1.0 else "early, or q and v late"
    why = prepared["why"].get("delay", "u is taken to be on time").partition(";")[0].rstrip(".")
    on_time = why if why.startswith("u is") else f"delay of u: {why}"
    shifted = f"u was logged {1e3 * abs(late):.1f} ms {'late' if late > 0.0 else early} (shifted)" if late else on_time
    shifted += f", rotors follow within {1e3 * lag:.0f} ms" if lag else ""
    filtered = "no filter" if prepared["cutoff"] is None else f"filter at {prepared['cutoff']:g} Hz"
    joints, moving = robot.single_joint_names, robot.base != "fixed"
    filtered += f", every {prepared['every']}. row" if prepared["every"] > 1 else ", all rows"
    freedoms = f"a base that moves and {len(joints)} joints" if moving else f"{len(dataset.joint_names)} joints"
    q, force, inertia = (
        " or ".join(dict.fromkeys(two[robot.joint(name).type == "prismatic"] for name in joints))
        for two in (("rad", "m"), ("Nm", "N"), ("kg m²", "kg"))
    )

    still = scores.not_known("identified", still)

    def but_for(names: Sequence[str]) -> str:
        return f"; of {', '.join(names)} not known from this log" if names else ""

    def each(field: str, unit: str) -> str:
        own = {name: values[f"{field}.{name}"] for name in joints}
        lost = [name for name, value in own.items() if name in still or value.interval[0] <= 0.0]
        told = ", ".join("–" if x in lost else f"{own[x].value:.3g}" for x in own) + f" {unit}{but_for(lost)}"
        return told if len(lost) < len(own) else "not known from this log"

    of_joints = [
        ("dry friction", friction_in_words(identified.model, recording, force, still) + but_for(still)),
        ("viscous", each("viscous", f"{force} per {q}/s")),
        ("rotors", each("rotor", inertia)),
    ] if joints else []  # fmt: skip
    (mass, error), causes = values.total_mass, other_causes(content["payload"] or {})
    if "gains" in causes:  # what it changes of a payload, it changes of all
        error = math.hypot(error, content["payload"]["parameters"]["payload.mass"]["std"])
    weight = f"{mass:.4g} ± {1.96 * error:.1g} kg, if {drives_of(identified.model)} are right"
    errors = "; ".join(
        f"{short_name(name)} {number(_motion(scores, name))} / {number(_known(scores, 'nrmse', ACCELERATION, name))}"
        for name in scores.models
    )
    ahead = (f" after {scores.horizons[-1]:g} s" if scores.horizons else "") + f" [{'rad or m' if moving else q}]"
    covered = scores.value("coverage_95", model=best)
    intervals = "" if covered is None else f"; its 95 % intervals hold {100.0 * covered:.0f} % of unseen rows"
    weak = ", ".join(list(values.by_body or {})[:3])
    command = f"forcegp excite {out}/model --seconds 10 --out next.csv"
    command = "faster and larger motions, also of what hardly moved" if moving else command
    return [
        ("log", f"{len(dataset)} rows, {seconds:.3g} s at {rate:.4g} Hz, {freedoms}{jitter}"),
        *(("by name", each) for each in ["; ".join(done["guessed"])] if each),
        ("corrected", mistakes),
        *seen,
        ("timing", f"{shifted}; {filtered}"),
        *([("stance", stance_text(prepared))] if "stance" in prepared else []),
        *of_joints,
        *([("whole mass", weight)] if moving else []),
        ("payload", held),
        *causes.items(),
        ("models", f"error of q{ahead} / nRMSE of the acceleration, on unseen time: {errors}"),
        *left_of_torques(scores, best),
        ("best", f"{short_name(best)}{intervals}"),
        ("record next", command + (f" (least is known of {weak})" if weak else "")),
        ("wrote", f"{out}/report.html, {out}/model, {out}/identified.urdf, {out}/validation/report.md"),
    ]  # fmt: skip


def left_of_torques(scores: forcegp.scores.Scores, best: str) -> list[tuple[str, str]]:
    """The line on what each model leaves of the recorded torques of the joints; none where u has other columns."""
    shares = {}
    for name in dict.fromkeys(("given", "identified", best)):
        quantity, left = scores.left(name) if name in scores.models else (ACCELERATION, {})
        if quantity == TORQUE:
            numbers = (shown(x, "{:.2g}" if x and x < 0.1 else "{:.0f}", 100.0) for x in left.values())
            shares[short_name(name)] = " ".join(numbers)
    told = "; ".join(f"{name} {numbers}" for name, numbers in shares.items())
    return [("torque left", f"on unseen time, % of the recorded one of each joint: {told}")] if told else []


LEAST_COVERAGE = 0.8  # of 95 % intervals that is no reason to doubt them


def verdict(scores: forcegp.scores.Scores, dataset: forcegp.Dataset, still: Sequence[str] = ()) -> str:
    """Use it, use it for these joints, or do not use it; what it was measured by, and against the URDF alone."""
    best = scores.recommended
    assert best is not None, "a model was scored"
    quantity, shares = scores.left(best)
    left = {name: math.inf if x is None else x for name, x in shares.items()}
    good = [name for name, x in left.items() if x <= USABLE]
    lost = [f"{name} {100.0 * x:.0f} %" if math.isfinite(x) else f"{name} not known from this log"
            for name, x in left.items() if x > USABLE]  # fmt: skip
    use = f"“{short_name(best)}”"
    if not good:
        return (
            f"Do not use any of these models: on unseen time the best one, {use}, leaves of the {quantity} of "
            f"{', '.join(lost)}. Forces, flags of stance, units or the robot's file are wrong, or it hardly moves."
        )
    ends = dict.fromkeys(f"{100.0 * x:.2g}" for x in (min(left.values()), max(left[name] for name in good)))
    told = f"on unseen time it leaves {' to '.join(ends)} % of each {quantity}"
    motion, urdf = _motion(scores, best), _motion(scores, "given")
    if motion is not None:
        unit = dataset.units["q"] if isinstance(dataset.units["q"], str) else "rad or m"
        against = "they diverge" if urdf is None else f"by {urdf:.2g}"
        against = f"; with the URDF alone {against}" if "given" in scores.models and best != "given" else ""
        ahead = f"positions {scores.horizons[-1]:g} s ahead are wrong by {motion:.2g} {unit}{against}"
        errors = zip(scores.joint_names, scores.columns("nrmse", ACCELERATION, best), strict=True)
        there = [x or 0.0 for name, x in errors if name not in still]
        lost_there = sum(there) >= max(len(there), 1)  # no better than a = 0, as of light wrists
        told += f", but it is for torques: do not predict motions, {ahead}" if lost_there else f", and {ahead}"
    elif scores.horizons:
        told += ", but its motions diverge: do not simulate with it"
    covered = scores.value("coverage_95", model=best)
    doubt = "" if covered is None or covered >= LEAST_COVERAGE else (
        f" Do not trust its intervals: those of 95 % hold {100.0 * covered:.0f} %."
    )  # fmt: skip
    if not lost:
        return f"Use {use}: {told}.{doubt}"
    others = f"Not for the others, of whose {quantity} is left: {', '.join(lost)}."
    return f"Use {use} for {', '.join(good)}: {told}. {others}{doubt}"


def _motion(scores: forcegp.scores.Scores, model: str) -> float | None:
    """Error of q at the longest horizon; None where all motions diverge, or none was scored."""
    quantity = f"position after {scores.horizons[-1]:g} s" if scores.horizons else ""
    return _known(scores, "rmse", quantity, model)


def _known(scores: forcegp.scores.Scores, score: str, quantity: str, model: str) -> float | None:
    there = model in scores.models and quantity in scores.quantities(model)
    return scores.value(score, quantity, model) if there else None
