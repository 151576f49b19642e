"""The directive `commands`: a table of all commands with what each is for, from the command line itself."""

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from forcegp.cli.arguments import COMMANDS


class Commands(SphinxDirective):
    """One row per command."""

    def run(self) -> list[nodes.Node]:
        """The nodes of the table."""
        rows = [f"| `forcegp {name}` | {summary} |" for name, summary in COMMANDS.items()]
        return self.parse_text_to_nodes("\n".join(["| command | what it does |", "|---|---|", *rows]))


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.add_directive("commands", Commands)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
