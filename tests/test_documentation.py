"""The pages of docs/: each in a table of contents, links that lead somewhere, commands that parse, short sentences."""

import re
import shlex
from pathlib import Path

import pytest
from tests.prose import sentences, words

from forcegp.cli.main import parse_arguments

REPOSITORY = Path(__file__).resolve().parents[1]
DOCS = REPOSITORY / "docs"
PAGES = {str(page.relative_to(DOCS)): page for page in sorted(DOCS.rglob("*.md"))}
LONGEST = 30  # words of a sentence
GENERATED = ("report.md", "reproduction.md", "performance.md", "force-priors.md")
WRITTEN = [name for name in PAGES if not name.endswith(GENERATED)]
TRANSLATED = re.compile(
    r"\b(gone on with|goes on where|nobody|so many|so long|of these the|the former|the latter|surer|surest|teach\w*"
    r"|plainly|(model|table|data|URDF|test|page|simulation)s? (knows?|tells?|says?|speaks?))\b"
)
"""Words that no page needs: programs and tables report, return, raise or warn."""


def text(name: str) -> str:
    return PAGES[name].read_text(encoding="utf-8")


def test_every_page_is_in_a_table_of_contents():
    found = {"index.md"}
    for name in PAGES:
        for block in re.findall(r"^```\{toctree\}\n(.*?)^```", text(name), re.DOTALL | re.MULTILINE):
            entries = [line for line in block.splitlines() if line and not line.startswith(":")]
            for entry in entries:
                listed = sorted(PAGES[name].parent.glob(re.sub(r".*<(.*)>", r"\1", entry) + ".md"))
                assert listed, f"{name} lists {entry}, which does not exist"
                found |= {str(page.resolve().relative_to(DOCS)) for page in listed}
    assert found == set(PAGES)


@pytest.mark.parametrize("name", PAGES)
def test_links_and_pictures_lead_somewhere(name):
    prose = re.sub(r"^ *```.*?^ *```", "", text(name), flags=re.DOTALL | re.MULTILINE)
    for target in re.findall(r"\]\(([^)\s#]+)(?:#[^)]*)?\)", prose):
        assert target.startswith("https://") or (PAGES[name].parent / target).exists(), target


@pytest.mark.parametrize("name", [name for name in PAGES if "forcegp " in text(name)])
def test_commands_parse(name):
    for block in re.findall(r"^```(?:sh|bash|console)\n(.*?)^```", text(name), re.DOTALL | re.MULTILINE):
        lines = re.sub(r"\\\n", " ", block)
        for command in re.findall(r"^(?:\$| )*forcegp (.*)$", lines, re.MULTILINE):
            words = shlex.split(command.partition(">")[0].replace("$seed", "1"), comments=True)
            if words not in (["--help"], ["--version"]) and words[1:] != ["--help"]:  # which print and end
                parse_arguments(words)


@pytest.mark.parametrize("name", WRITTEN)
def test_sentences_are_short(name):
    found = [sentence for sentence in sentences(text(name)) if len(words(sentence)) > LONGEST]
    assert not found, "\n\n".join(found)


@pytest.mark.parametrize("name", WRITTEN)
def test_words_are_those_of_the_field(name):
    assert not TRANSLATED.findall(" ".join(sentences(text(name))))


def test_every_public_package_has_a_page_of_reference():
    packages = {stub.parent.name for stub in (REPOSITORY / "src/forcegp").glob("*/__init__.pyi")}
    assert len(packages) > 10
    assert {Path(name).stem for name in PAGES if name.startswith("api/")} == packages | {"index", "errors"}
    for package in packages:
        assert f"```{{public-names}} forcegp.{package}\n" in text(f"api/{package}.md")


def test_a_long_sentence_is_found():
    short, long = "It has `code of many words` and [a link of many words](x.md). ", "word " * (LONGEST + 1)
    page = f"# {long}\n\n```sh\n{long}\n```\n\n| {short} | cell |\n|---|---|\n\n* {short}\n* {long}\n\n    {long}\n"
    assert [sentence.strip() for sentence in sentences(page) if len(words(sentence)) > LONGEST] == [long.strip()]
