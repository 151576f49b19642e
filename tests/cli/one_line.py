"""What every wrong command must do."""

from pathlib import Path

from forcegp.cli.main import main


def assert_refused(words: str, message: str, folder: Path, capfd) -> None:
    """One line on stderr with the message, exit code 2, and a folder as it was."""
    before = sorted(folder.rglob("*"))
    assert main(words.split()) == 2
    told = capfd.readouterr()
    assert told.out == ""
    assert told.err.startswith("forcegp: ")
    assert told.err.count("\n") == 1, told.err
    assert message in told.err
    assert sorted(folder.rglob("*")) == before
