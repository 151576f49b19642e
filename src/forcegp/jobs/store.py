"""`JobStore`: a folder of finished jobs; whatever happens, a job is there whole or not at all."""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from forcegp import __version__
from forcegp.atomic_files import atomic_folder, read_json, remove_leftovers, write_json
from forcegp.errors import FileFormatError, InvalidInput, OutdatedWarning

FORMAT_VERSION = 2
DESCRIPTION, JOBS, LOCK = "jobs.json", "jobs", ".lock"
RESULT_FILE = "job.json"
BEFORE = ("reproduction.json", "configuration.json")
"""Descriptions of format 1, whose digests did not cover the code: its results, in `cells`, are not used."""


@dataclass(frozen=True)
class JobStore:
    """Results by name in `folder/jobs/<name>/job.json`, each beside the files that its task wrote.

    kind: the command that owns the folder, for messages.
    """

    folder: Path
    kind: str = "forcegp"

    @classmethod
    def open(
        cls, folder: Path, kind: str, configuration: Mapping[str, Any], *, overwrite: bool | None = None
    ) -> JobStore:
        """The folder, made if it does not exist, for jobs of this kind under one configuration of JSON values.

        With `overwrite` everything is computed anew; None for commands that do not offer it. Warns where the folder
        holds results that are not used because they do not record their code. Raises InvalidInput for a folder of
        something else or of another configuration, naming what differs.
        """
        store = cls(folder, kind)
        description = store._description()
        if description is None:
            if folder.exists() and (not folder.is_dir() or not all(map(_is_own_start, folder.iterdir()))):
                raise InvalidInput(f"{folder} exists and was not written by `{kind}`; choose another `folder`.")
        elif not overwrite:
            store._require_same(description["configuration"], configuration, can_overwrite=overwrite is not None)
            if description["format_version"] == FORMAT_VERSION:
                return store
            warnings.warn(
                f"{folder} holds results of an earlier forcegp, which do not record the code that computed them; "
                f"everything is computed anew, and the old results stay in {folder / 'cells'}.",
                OutdatedWarning,
                stacklevel=2,
            )
        folder.mkdir(parents=True, exist_ok=True)
        with store.locked():
            shutil.rmtree(folder / JOBS, ignore_errors=True)
            (folder / JOBS).mkdir()
            content = {"kind": kind, "format_version": FORMAT_VERSION, "forcegp_version": __version__}
            write_json(folder / DESCRIPTION, {**content, "configuration": dict(configuration)})
        return store

    def _description(self) -> dict[str, Any] | None:
        """What the folder holds, also that of format 1; None without a description."""
        file = next((self.folder / name for name in (DESCRIPTION, *BEFORE) if (self.folder / name).exists()), None)
        if file is None:
            return None
        stored = read_json(file, f"choose another `folder`, or delete {self.folder}")
        if file.name == BEFORE[0]:
            stored["configuration"] = {"preset": stored.get("preset")}
        if stored.get("kind") != self.kind or not isinstance(stored.get("configuration"), dict):
            raise InvalidInput(f"{self.folder} was not written by `{self.kind}`; choose another `folder`.")
        if file.name != DESCRIPTION:
            stored["format_version"] = 1
            stored["configuration"].pop("forcegp", None)
        elif stored.get("format_version") != FORMAT_VERSION:
            raise FileFormatError(
                f"{self.folder} holds results of forcegp {stored.get('forcegp_version')} (format "
                f"{stored.get('format_version')}); this is {__version__} (format {FORMAT_VERSION}). Choose another "
                "`folder`."
            )
        return stored

    def _require_same(self, before: Mapping[str, Any], wanted: Mapping[str, Any], *, can_overwrite: bool) -> None:
        wanted = json.loads(json.dumps(wanted))  # as JSON stores it
        differing = sorted(name for name in {*before, *wanted} if before.get(name) != wanted.get(name))
        if differing:
            given = [f"{name} ({before.get(name)!r}, not {wanted.get(name)!r})" for name in differing]
            named = ", ".join(text if len(text) < 80 else name for name, text in zip(differing, given, strict=True))
            more = ", or add `overwrite=True` to compute everything anew" if can_overwrite else ""
            raise InvalidInput(f"{self.folder} holds results with another {named}; choose another `folder`{more}.")

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Only one process works on the folder; the lock ends with its process. Raises InvalidInput if another does."""
        lock = FileLock(self.folder / LOCK)
        try:
            lock.acquire(blocking=False)
        except Timeout:
            raise InvalidInput(
                f"another `{self.kind}` is at work in {self.folder}; wait for it, or choose another `folder`."
            ) from None
        try:
            yield
        finally:
            lock.release()

    def place(self, name: str) -> Path:
        """The folder where the job of this name lies, or will lie."""
        return self.folder / JOBS / name

    def has(self, name: str, digest: str) -> bool:
        """Whether the job is finished, with this digest. Raises as `load`."""
        return self.place(name).exists() and self.load(name)["digest"] == digest

    def load(self, name: str) -> dict[str, Any]:
        """All that is stored of a finished job. Raises FileFormatError if it is damaged."""
        file = self.place(name) / RESULT_FILE
        remedy = f"delete the folder {file.parent} and run the same command again: only this job is computed anew"
        stored = read_json(file, remedy)
        if not {"digest", "code", "spec", "result"} <= set(stored):
            raise FileFormatError(f"{file} is half written; {remedy}.")
        return stored

    def result(self, name: str) -> dict[str, Any]:
        """The `result` of a finished job."""
        return self.load(name)["result"]

    @contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """A temporary folder that becomes the job's, in the place of an outdated one, and vanishes on failure."""
        with atomic_folder(self.place(name)) as folder:
            folder.mkdir()
            yield folder

    def files(self, name: str) -> dict[str, bytes]:
        """The files of a finished job by their place in its folder, to be sent to where the store cannot be seen."""
        folder = self.place(name)
        files = sorted(file for file in folder.rglob("*") if file.is_file())
        return {file.relative_to(folder).as_posix(): file.read_bytes() for file in files}

    def put(self, name: str, files: Mapping[str, bytes]) -> None:
        """Store a job from its files."""
        with self.writing(name) as folder:
            for place, content in files.items():
                (folder / place).parent.mkdir(parents=True, exist_ok=True)
                (folder / place).write_bytes(content)

    def remove_leftovers(self) -> None:
        """Delete what killed runs left half written; call it under the lock."""
        remove_leftovers(self.folder)


def _is_own_start(entry: Path) -> bool:
    """What a run leaves that is killed before it has written its description."""
    return entry.name in (LOCK, JOBS) or (entry.name.startswith(f".{DESCRIPTION}.") and entry.name.endswith(".tmp"))
