"""Command lines: any command with any option, numbers and texts of any kind, files of another kind, bytes as names."""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from hypothesis import strategies as st
from tests.fuzz.made import INPUTS
from tests.fuzz.oracle import DefectError, Target, require_ended_well
from tests.fuzz.values import WORDS, hostile_pickle, words

from forcegp.cli.arguments import COMMANDS, command_class
from forcegp.cli.command import options_of
from forcegp.cli.main import parse_arguments
from forcegp.errors import ForceGPError

FILES = words("moving.h5 drone.xml train.h5 test.h5 bare.h5 arm.urdf pair.urdf log.csv log.npz log.mcap")
NAMES = words("carried independent nowhere train.h5/x . .. hostile.pkl loop out.h5 out carried/model.json - -x ~")
AIR = words(
    "gp:aerodynamic gp:aerodynamic:frame=body gp:aerodynamic:observe=0 gp:aerodynamic:observe=-1 gp: "
    "gp:aerodynamic:observe=nan gp:aerodynamic:frame=x gp:aerodynamic:observe gp:joint,gp:joint viscous "
    "gp:aerodynamic:height=1 gp:aerodynamic:inputs=x aerodynamic,gp:base floating planar spherical "
    "viscous:damping=x coulomb:,rotor payload:nowhere payload:hand:mass=-1 bodies:hand torques:mean=x"
)
ODD = ("", "a" * 300, "nowhere/x.h5", "\udcff.h5", "x\udcff", "x\x00y", "\u202ex")
PATHS = st.sampled_from((*FILES, *NAMES, *ODD))
"""None is absolute, and commands run some folders deep: nothing outside of the folder of a case is ever named."""
SMALL = "--points 6 --iterations 2 --restarts 1"
COLUMNS = "--time time --q q_{joints} --v v_{joints} --u u_{joints} --robot pair.urdf"
VALID = {
    "import": f"import log.csv {COLUMNS} --out out.h5", "auto": "auto log.csv --robot arm.urdf --step 0 --out out",
    "payload": "payload test.h5 --forces none-such", "robot": "robot arm.urdf", "check": "check test.h5",
    "fit": f"fit train.h5 {SMALL} --out out", "score": "score carried train.h5 --starts 1 --horizon 0.02",
    "monitor": "monitor carried train.h5 --free 0.1 --out out",
    "export": "export carried --to c --unchecked --out out", "view": "view train.h5 --out nowhere/scene.html",
    "excite": "excite carried --tries 2 --seconds 1 --out out.csv", "simulate": "simulate none-such --out out.h5",
    "reproduce": "reproduce --preset none-such", "demo": "demo --seconds 0",
}  # fmt: skip
"""Command lines that are done at once, or refused at once."""
MOVING = {
    "robot": "robot drone.xml", "robot ": "robot arm.urdf --base floating", "check": "check moving.h5",
    "import": "import moving.h5 --cutoff 20 --out out.h5",
    "import ": "import moving.h5 --cutoff 20 --lag 0.05 --out out.h5",
    "fit": f"fit moving.h5 --forces gp:aerodynamic:frame=body {SMALL} --no-checks --out out",
    "fit ": f"fit moving.h5 --forces gp:aerodynamic {SMALL} --no-checks --out out",
    "fit  ": "fit test.h5 --forces viscous --rows 50 --no-checks --out out",
    "simulate": "simulate quadrotor --seconds 0.1 --wind 3 --out out.h5",
}  # fmt: skip
"""Other lines of the same commands, most of robots whose base moves."""
LARGE = ("10000000000000000000000000", "1e308", "inf", "1e400", "1e5000", "1_000")
"""Nobody may ask for so many seconds of simulation, say, in a test."""
OPTIONS = {
    name: sorted({"--" + each.replace("_", "-") for each in options_of(command_class(name))} - {"--debug"} | {"--help"})
    for name in COMMANDS
}


@dataclass(frozen=True)
class Line:
    """A valid command line with other words: at `where` % its length, `how` is done with `word`."""

    command: str
    moving: str
    edits: list[tuple[int, str, str, str]]


@st.composite
def lines(draw: st.DrawFn) -> Line:
    command = draw(st.sampled_from(tuple(COMMANDS)))
    options = st.sampled_from(OPTIONS[command]) | st.sampled_from(OPTIONS[command]) | WORDS
    how = st.sampled_from(("option", "option", "option", "replace", "replace", "path", "drop", "insert"))
    edit = st.tuples(st.integers(0, 40), how, options, WORDS | PATHS | st.sampled_from(AIR))
    own = [name for name in MOVING if name.strip() == command]
    return Line(command, draw(st.sampled_from(("", *own))), draw(st.lists(edit, min_size=1, max_size=4)))


def words_of(case: Line) -> list[str]:
    line = list(words(MOVING[case.moving] if case.moving else VALID[case.command]))
    for where, how, option, value in case.edits:
        place = where % len(line)
        match how:
            case "option":
                line += [option, value]
            case "replace" | "path":
                line[place] = value
            case "drop":
                del line[place]
            case _:
                line.insert(place, value)
        line = line or ["fit"]
    return line


def check_words(case: Line, folder: Path) -> None:
    """A command, or InvalidInput of one line."""
    line = [word for word in words_of(case) if word not in ("--help", "-h", "--version")]
    try:
        command, before = parse_arguments(line), Path.cwd()
        try:
            os.chdir(folder)
            command.check_paths()
        finally:
            os.chdir(before)
    except OSError:
        pass  # `main` reports it
    except ForceGPError as error:
        if not str(error).strip():
            raise DefectError("refused without a reason") from None


def check(case: Line, folder: Path) -> None:
    line = words_of(case)
    if line[0] in ("simulate", "demo") and line[0] == case.command:
        line = [word for word in line if word not in LARGE] + ["--none-such", "1"]  # a run takes seconds to hours
    for name in (*FILES, "carried", "independent"):
        source = INPUTS.folder / name
        (shutil.copytree if source.is_dir() else shutil.copyfile)(source, folder / name)
    (folder / "hostile.pkl").write_bytes(hostile_pickle())
    (folder / "loop").symlink_to("loop")
    require_ended_well(line, folder)


WORDS_TARGET = Target(lines(), check_words, fast=10, nightly=2000)
TARGET = Target(lines(), check, fast=10, nightly=3000)
