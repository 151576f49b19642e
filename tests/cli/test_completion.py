"""`forcegp --print-completion`: scripts that shells take, and what bash completes with one."""

import re
import shutil
import subprocess

import pytest

from forcegp.cli.main import COMMANDS, SHELLS, main

BASH = shutil.which("bash")

ASK = """
source "$0"
complete -p forcegp | grep -q ' forcegp$' || exit 3
COMP_WORDS=(forcegp "$@"); COMP_CWORD=$#; COMP_LINE="forcegp $*"; COMP_POINT=${#COMP_LINE}
_tyro_forcegp
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def script(forcegp, tmp_path_factory):
    path = tmp_path_factory.mktemp("completion") / "forcegp.bash"
    path.write_text(forcegp("--print-completion", "bash").stdout, encoding="utf-8")
    return path


def completed(script, *words):
    done = subprocess.run([BASH, "-c", ASK, script, *words], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout.split("\n")[:-1]


@pytest.mark.parametrize("shell", SHELLS)
def test_there_is_a_script_for_each_shell(forcegp, shell):
    done = forcegp("--print-completion", shell)
    assert (done.returncode, done.stderr) == (0, "")
    begin = {"bash": "complete -F", "zsh": "#compdef forcegp", "fish": "complete --no-files --command 'forcegp'"}
    assert begin[shell] in done.stdout
    (table,) = re.findall(r"COMPLETION_SPEC = .*", done.stdout)
    assert "\\n" not in table  # a newline within a description would end it
    assert all(f"'{name}': {{'description': '{summary}'" in table for name, summary in COMMANDS.items())


@pytest.mark.skipif(BASH is None, reason="no bash")
class TestBash:
    def test_it_is_a_script(self, script):
        done = subprocess.run([BASH, "-n", script], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, "")

    def test_it_completes_commands(self, script):
        assert completed(script, "re") == ["reproduce"]
        assert set(completed(script, "")) >= COMMANDS.keys()

    @pytest.mark.parametrize("command", COMMANDS)
    def test_it_completes_options_and_nothing_else(self, script, command):
        assert completed(script, command, "--js") == ["--json"]
        assert all(word.startswith("-") for word in completed(script, command, "-"))

    def test_it_completes_choices(self, script):
        assert completed(script, "simulate", "kuka-surface", "--surface", "t") == ["tilted"]


@pytest.mark.parametrize("words", [["--print-completion"], ["--print-completion", "tcsh"]])
def test_other_shells_are_refused(words, capsys):
    assert main(words) == 2
    assert "takes the name of a shell: bash, zsh, fish" in capsys.readouterr().err
