"""The sentences of a page of Markdown as a reader counts them: without code, formulas, headings and directives."""

import re

FENCE = re.compile(r"^( *)(`{3,}|:{3,}).*?^\1\2 *$", re.DOTALL | re.MULTILINE)
END = re.compile(r"(?<=[.!?])[)\"”*_]*\s+|(?<=[.!?][)\"”*_])\s+")
ABBREVIATED = re.compile(r"\b(e\.g|i\.e|vs|cf|Fig|eq|eqs|No|al|p|pp|ca)\.\s", re.IGNORECASE)


def blocks(page: str) -> list[str]:
    """Paragraphs, list items and table cells of a page, each as one line."""
    text = re.sub(r"\A---\n.*?\n---\n", "", page, flags=re.DOTALL)
    text = FENCE.sub("\n", text)
    found: list[str] = []
    last = ""
    for line in text.splitlines():
        if line.startswith("|"):
            found += [cell for cell in re.split(r"(?<!\\)\|", line) if cell.strip(" :-")]
            last = ""
        elif not line.strip() or line.startswith("#") or (line.startswith("    ") and last == ""):
            last = ""
        elif last and not re.match(r" *([*+-]|\d+\.) |>", line):
            found[-1] += " " + line.strip()
        else:
            found.append(line.strip())
            last = line
    return found


def sentences(page: str) -> list[str]:
    """All sentences of a page, with code spans and links as one word each."""
    found = []
    for block in blocks(page):
        plain = re.sub(r"^> ?|^([*+-]|\d+\.) +", "", block)
        plain = re.sub(r"!\[([^\]]*)\]\([^)]*\)", r"\1", plain)
        plain = re.sub(r"(`+).+?\1", "CODE", plain)
        plain = re.sub(r"\$[^$]+\$", "FORMULA", plain)
        plain = re.sub(r"\[[^\]]*\]\([^)]*\)", "LINK", plain)
        plain = ABBREVIATED.sub(r"\1 ", plain).replace("**", "")
        found += [sentence for sentence in END.split(plain) if sentence.strip()]
    return found


def words(sentence: str) -> list[str]:
    """What counts as a word: anything with a letter or a digit in it."""
    return [word for word in sentence.split() if re.search(r"\w", word)]
