"""What both presets of `forcegp reproduce` are held to: their files, a second run, a part, and what is refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import pytest

Forcegp = Callable[..., CompletedProcess[str]]


@dataclass(frozen=True)
class Reproduced:
    """A folder with `out` and `docs` of `forcegp reproduce all --preset <preset>`; `page` is the name without .md."""

    forcegp: Forcegp
    folder: Path
    preset: str
    page: str

    @classmethod
    def everything(cls, forcegp: Forcegp, folder: Path, preset: str, page: str) -> Reproduced:
        """All of it in this folder."""
        pytest.importorskip("pybullet")
        words = ("reproduce", "all", "--preset", preset, "--out", "out", "--docs", "docs", "--jobs", 2)
        done = forcegp(*words, folder=folder)
        assert done.returncode == 0, done.stderr
        assert f"{page}.md reports the results" in done.stdout
        return cls(forcegp, folder, preset, page)

    @property
    def roots(self) -> tuple[Path, Path]:
        """Both places where the results were written."""
        return self.folder / "out", self.folder / "docs"

    def text(self, root: Path | None = None) -> str:
        """The page of all results."""
        return ((self.folder / "out" if root is None else root) / f"{self.page}.md").read_text()

    def document(self, name: str, root: Path | None = None) -> dict[str, Any]:
        """The JSON of one figure or experiment."""
        root = self.folder / "out" if root is None else root
        document = json.loads((root / self.page / f"{name}.json").read_text())
        assert document["preset"] == self.preset
        return document

    def check_pictures(self, root: Path, figures: Iterable[str]) -> None:
        """Every figure is on the page, as PNG beside it."""
        for figure in figures:
            assert f"({self.page}/{figure}.png)" in self.text(root)
            assert (root / self.page / f"{figure}.png").read_bytes().startswith(b"\x89PNG")

    def check_a_second_run_changes_nothing(self, names: Collection[str]) -> None:
        """Not one job is written again."""

        def jobs() -> dict[Path, int]:
            return {file: file.stat().st_mtime_ns for file in (self.folder / "out" / "jobs").glob("**/job.json")}

        before, kept = self.text(), jobs()
        assert len(kept) > 40
        words = ("reproduce", "all", "--preset", self.preset, "--out", "out", "--json")
        again = self.forcegp(*words, folder=self.folder)
        assert again.returncode == 0, again.stderr
        assert set(json.loads(again.stdout)["figures"]) == set(names)
        assert self.text() == before
        assert jobs() == kept

    def page_of_one(self, name: str, *arguments: object, folder: Path) -> str:
        """The page of one figure, made in a copy of the results in `folder`; the page of all is left alone."""
        shutil.copytree(self.folder / "out", folder / "out")
        done = self.forcegp("reproduce", name, *arguments, "--out", "out", "--jobs", 1, folder=folder)
        assert done.returncode == 0, done.stderr
        assert self.text(folder / "out") == self.text()
        return (folder / "out" / f"{name}.md").read_text()

    def check_refusal(self, arguments: Iterable[object], message: str) -> None:
        """One line, exit code 2, and not a file more or less."""
        before = sorted(self.folder.glob("**/*"))
        refused = self.forcegp("reproduce", *arguments, folder=self.folder)
        assert refused.returncode == 2
        assert refused.stderr.startswith("forcegp: ")
        assert len(refused.stderr.strip().splitlines()) == 1
        assert message in refused.stderr
        assert sorted(self.folder.glob("**/*")) == before
