"""Links of pages to files outside docs/ (source, examples, SECURITY.md) lead to the repository.

On GitHub the relative link works as it stands; the built site has no such file.
"""

import re
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

REPOSITORY = "https://github.com/forcegp/forcegp/blob/main"
LINK = re.compile(r"(\]\()((?:\.\./)+[^)\s#]+)((?:#[^)\s]*)?\))")


def to_repository(app: Sphinx, name: str, content: list[str]) -> None:
    """Replace relative links that leave docs/; a link to a file that does not exist stops the build."""
    docs = Path(app.srcdir).resolve()
    page = docs / name

    def replaced(link: re.Match[str]) -> str:
        target = (page.parent / link[2]).resolve()
        if target.is_relative_to(docs):
            return link[0]
        if not target.exists():
            raise ExtensionError(f"{name}: the link {link[2]} leads nowhere; correct it.")
        return f"{link[1]}{REPOSITORY}/{target.relative_to(docs.parent)}{link[3]}"

    content[0] = LINK.sub(replaced, content[0])


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.connect("source-read", to_repository)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
