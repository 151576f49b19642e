"""C text that lies in files of the package, where editors show it as C and compilers can check it."""

import re
from collections.abc import Mapping
from functools import cache
from importlib.resources import files


@cache
def c_text(module: str, file: str) -> str:
    """A file beside this module."""
    return (files(module.rpartition(".")[0]) / file).read_text(encoding="ascii")


def sections(module: str, file: str) -> dict[str, str]:
    """The parts of a file, by the names above them: `//// NAME`."""
    return dict(re.findall(r"^//// (\S+)\n(.*?)(?=^////|\Z)", c_text(module, file), re.MULTILINE | re.DOTALL))


def filled(text: str, words: Mapping[str, object]) -> str:
    """The text with what stands for every `@WORD@`."""
    return re.sub("@([A-Z_0-9]+)@", lambda found: str(words[found[1]]), text)
