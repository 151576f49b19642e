"""Run the code of a document as a reader would, but in this process, which has imported torch already."""

import contextlib
import io
import re
import warnings
from pathlib import Path

import torch

HOW_TO = Path(__file__).resolve().parents[1] / "docs" / "how-to"


def blocks(page: str, language: str = "python") -> list[str]:
    """The code of this language on a page of docs/how-to/."""
    return re.findall(rf"```{language}\n(.*?)```", (HOW_TO / f"{page}.md").read_text(encoding="utf-8"), re.DOTALL)


def run_example(code: str, folder: Path) -> str:
    """What the code prints in that folder; warnings are no errors, as in a process of its own."""
    printed, threads = io.StringIO(), torch.get_num_threads()
    with contextlib.chdir(folder), contextlib.redirect_stdout(printed), warnings.catch_warnings(action="ignore"):
        try:
            exec(compile(code, "<example>", "exec"), {"__name__": "__main__"})
        finally:
            torch.set_num_threads(threads)
    return printed.getvalue()
