"""Files and folders appear whole or not at all, whatever fails on the way."""

import errno
import json
import os
import stat
import subprocess
import sys

import pytest

from forcegp import atomic_files
from forcegp.atomic_files import atomic_file, atomic_folder, remove_leftovers, require_writable, write_text
from forcegp.errors import FileFormatError, InvalidInput

FAILURES = [OSError(errno.ENOSPC, "no space"), KeyboardInterrupt()]


def contents(folder) -> dict[str, str]:
    return {str(file.relative_to(folder)): file.read_text() for file in folder.rglob("*") if file.is_file()}


def names(folder) -> list[str]:
    return [entry.name for entry in folder.iterdir()]


def fail_after(error, step, *arguments, **more) -> None:
    step(*arguments, **more)
    raise error


def mode(path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.fixture
def umask():
    before = os.umask(0o022)
    yield os.umask
    os.umask(before)


def make_folder(path, **files: str) -> None:
    path.mkdir()
    for name, text in files.items():
        (path / name).write_text(text)


def break_renames_to(monkeypatch, target, error) -> None:
    left = [error]
    for name in ("rename", "replace"):
        own = getattr(os, name)

        def rename(source, to, own=own):
            if str(to) == str(target) and left:
                raise left.pop()
            own(source, to)

        monkeypatch.setattr(os, name, rename)


class TestFiles:
    @pytest.mark.parametrize("error", FAILURES, ids=lambda error: type(error).__name__)
    @pytest.mark.parametrize("where", ["before anything is written", "while it is written"])
    def test_a_failure_leaves_the_old_file_and_nothing_else(self, tmp_path, error, where):
        write_text(tmp_path / "note.txt", "old")
        with pytest.raises(type(error)), atomic_file(tmp_path / "note.txt") as temporary:
            fail_after(error, temporary.write_text if where.startswith("while") else str, "ne")
        assert contents(tmp_path) == {"note.txt": "old"}

    @pytest.mark.parametrize("mask", [0o022, 0o077, 0o002])
    def test_permissions_are_those_that_the_umask_allows(self, tmp_path, umask, mask):
        umask(mask)
        write_text(tmp_path / "note.txt", "new")
        assert mode(tmp_path / "note.txt") == 0o666 & ~mask

    def test_the_contents_are_on_the_disk_before_the_rename(self, tmp_path, monkeypatch):
        steps = []
        fsync, replace = os.fsync, os.replace
        monkeypatch.setattr(os, "fsync", lambda file: (steps.append(os.fstat(file).st_size), fsync(file)))
        monkeypatch.setattr(os, "replace", lambda one, other: (steps.append("rename"), replace(one, other)))
        write_text(tmp_path / "note.txt", "12345")
        assert steps == [5, "rename"]

    def test_a_link_stays_and_the_file_behind_it_is_replaced(self, tmp_path):
        (tmp_path / "elsewhere").mkdir()
        (tmp_path / "elsewhere" / "real.txt").write_text("old")
        (tmp_path / "link.txt").symlink_to(tmp_path / "elsewhere" / "real.txt")
        write_text(tmp_path / "link.txt", "new")
        assert (tmp_path / "link.txt").is_symlink()
        assert contents(tmp_path / "elsewhere") == {"real.txt": "new"}


class TestJson:
    def test_what_json_cannot_hold_changes_nothing(self, tmp_path):
        atomic_files.write_json(tmp_path / "a.json", {"one": 1})
        with pytest.raises(ValueError, match="not JSON compliant"):
            atomic_files.write_json(tmp_path / "a.json", {"one": float("nan")})
        assert json.loads((tmp_path / "a.json").read_text()) == {"one": 1}
        assert len(list(tmp_path.iterdir())) == 1

    @pytest.mark.parametrize("text", ["", '{"one": ', "[1]", "\udcff"])
    def test_damage_is_named_with_the_remedy(self, tmp_path, text):
        (tmp_path / "a.json").write_bytes(text.encode("utf-8", "surrogateescape"))
        with pytest.raises(FileFormatError, match=r"a\.json is .*damaged.*; write it again\.$"):
            atomic_files.read_json(tmp_path / "a.json", "write it again")

    @pytest.mark.parametrize("links", [True, False])
    def test_without_overwrite_a_file_that_appears_meanwhile_stays(self, tmp_path, monkeypatch, links):
        if not links:
            monkeypatch.setattr(os, "link", lambda *_: (_ for _ in ()).throw(OSError(errno.EPERM, "no hard links")))
        with atomic_file(tmp_path / "one.txt", overwrite=False) as temporary:
            temporary.write_text("mine")
        assert contents(tmp_path) == {"one.txt": "mine"}

        def two_processes() -> None:
            with atomic_file(tmp_path / "note.txt", overwrite=False) as temporary:
                temporary.write_text("mine")
                (tmp_path / "note.txt").write_text("of another process")

        if links:
            with pytest.raises(InvalidInput, match=r"note\.txt exists already; choose another name"):
                two_processes()
            assert contents(tmp_path) == {"one.txt": "mine", "note.txt": "of another process"}
        assert not list(tmp_path.glob(".*"))

    def test_what_is_no_regular_file_is_never_replaced(self, tmp_path):
        os.mkfifo(tmp_path / "pipe")
        (tmp_path / "link").symlink_to("pipe")
        (tmp_path / "loop").symlink_to("loop")
        for name in ("pipe", "link", "loop"):
            with pytest.raises(InvalidInput, match=r"it is (not a regular file|a link that leads back to itself)"):
                write_text(tmp_path / name, "new")
            with (
                pytest.raises(InvalidInput, match=r"cannot write .*; choose another name"),
                atomic_folder(tmp_path / name),
            ):
                pass
        assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)
        assert sorted(names(tmp_path)) == ["link", "loop", "pipe"]


class TestTrial:
    def test_leaves_nothing(self, tmp_path):
        require_writable(tmp_path / "not" / "there" / "yet")
        require_writable(tmp_path / "file")
        assert not names(tmp_path)

    def test_a_full_disk_is_noticed(self, tmp_path, limited_file_size):
        with limited_file_size(1000), pytest.raises(OSError, match="File too large"):
            require_writable(tmp_path / "run")
        assert not names(tmp_path)


class TestFolders:
    @pytest.mark.parametrize("error", FAILURES, ids=lambda error: type(error).__name__)
    @pytest.mark.parametrize("where", ["before", "while"])
    def test_a_failure_leaves_the_old_folder_and_nothing_else(self, tmp_path, error, where):
        make_folder(tmp_path / "model", one="old")
        with pytest.raises(type(error)), atomic_folder(tmp_path / "model") as temporary:
            fail_after(error, make_folder if where == "while" else dict, *[temporary] * (where == "while"), one="ne")
        assert contents(tmp_path) == {"model/one": "old"}
        assert names(tmp_path) == ["model"]

    def test_the_old_folder_is_exchanged_in_one_step_where_the_system_can(self, tmp_path, monkeypatch):
        make_folder(tmp_path / "model", one="old")
        for name in ("rename", "replace"):
            monkeypatch.setattr(os, name, lambda *_: pytest.fail("there is a moment without a folder"))
        with atomic_folder(tmp_path / "model") as temporary:
            make_folder(temporary, one="new")
        assert contents(tmp_path) == {"model/one": "new"}
        assert names(tmp_path) == ["model"]

    @pytest.mark.parametrize("error", FAILURES, ids=lambda error: type(error).__name__)
    def test_the_old_folder_is_put_back_if_the_second_rename_fails(self, tmp_path, monkeypatch, error):
        make_folder(tmp_path / "model", one="old")
        monkeypatch.setattr(atomic_files, "_swapped", lambda *_: False)
        break_renames_to(monkeypatch, tmp_path / "model", error)
        with pytest.raises(type(error)), atomic_folder(tmp_path / "model") as temporary:
            make_folder(temporary, one="new")
        assert contents(tmp_path) == {"model/one": "old"}
        assert names(tmp_path) == ["model"]

    def test_the_old_folder_is_kept_aside_if_it_cannot_be_put_back_until_the_next_time(self, tmp_path, monkeypatch):
        make_folder(tmp_path / "model", one="old")
        monkeypatch.setattr(atomic_files, "_swapped", lambda *_: False)
        rename = os.rename

        def broken(source, to):
            if str(to) == str(tmp_path / "model"):
                raise OSError(errno.EIO, "the disk is gone")
            rename(source, to)

        with monkeypatch.context() as now:
            now.setattr(os, "rename", broken)
            with pytest.raises(OSError, match="the disk is gone"), atomic_folder(tmp_path / "model") as temporary:
                make_folder(temporary, one="new")
        (kept,) = tmp_path.iterdir()
        assert contents(kept / ".old") == {"model/one": "old"}
        require_writable(tmp_path / "model")
        assert contents(tmp_path) == {"model/one": "old"}
        assert names(tmp_path) == ["model"]

    def test_without_overwrite_a_folder_that_appears_meanwhile_stays(self, tmp_path):
        def two_processes() -> None:
            with atomic_folder(tmp_path / "model", overwrite=False) as temporary:
                make_folder(temporary, one="mine")
                make_folder(tmp_path / "model", one="of another process")

        with pytest.raises(OSError, match=r"model"):
            two_processes()
        assert contents(tmp_path) == {"model/one": "of another process"}
        assert names(tmp_path) == ["model"]

    def test_all_contents_are_on_the_disk_before_the_rename(self, tmp_path, monkeypatch):
        steps, rename, flush = [], os.rename, atomic_files._flush
        monkeypatch.setattr(atomic_files, "_flush", lambda path: (steps.append(path.name), flush(path)))
        monkeypatch.setattr(os, "rename", lambda one, other: (steps.append("rename"), rename(one, other)))
        with atomic_folder(tmp_path / "model") as temporary:
            make_folder(temporary, one="1")
            make_folder(temporary / "inner", two="2")
        assert sorted(steps[:-1]) == sorted(["one", "inner", "two", temporary.name])
        assert steps[-1] == "rename"


KILLED = (
    "import os, signal, sys\n"
    "from pathlib import Path\n"
    "from forcegp.atomic_files import atomic_file, atomic_folder\n"
    "folder = Path(sys.argv[1])\n"
    "with atomic_folder(folder / 'model') as model, atomic_file(folder / 'note.txt') as note:\n"
    "    model.mkdir(); (model / 'one').write_text('ne'); note.write_text('ne')\n"
    "    with atomic_file(note) as inner:\n"
    "        inner.write_text('n')\n"
    "        print('there', flush=True)\n"
    "        sys.stdin.readline()\n"
    "        os.kill(os.getpid(), signal.SIGKILL)\n"
)


@pytest.mark.parametrize("how", ["by the next writer", "by remove_leftovers"])
def test_what_a_killed_process_left_is_deleted_but_not_what_a_living_one_writes(tmp_path, how):
    def clean() -> None:
        for name in ("model", "note.txt"):
            remove_leftovers(tmp_path) if how == "by remove_leftovers" else require_writable(tmp_path / name)

    make_folder(tmp_path / "model", one="old")
    command = [sys.executable, "-c", KILLED, tmp_path]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline()
        clean()
        assert len(names(tmp_path)) == 3, "the living one's were deleted"
        writer.stdin.write(b"\n")
    assert writer.returncode < 0
    assert len(names(tmp_path)) == 3
    clean()
    assert contents(tmp_path) == {"model/one": "old"}
    assert names(tmp_path) == ["model"]


@pytest.mark.parametrize("name", [".demo.0123456789ab.tmp/demo/train.h5", ".log.h5.0123456789ab.tmp/log.h5"])
def test_git_ignores_what_is_being_written(repository, name):
    if not (repository / ".git").exists():
        pytest.skip("no checkout")
    subprocess.run(["git", "check-ignore", "--quiet", name], cwd=repository, check=True)


def test_folders_that_others_made_or_wrote_into_are_not_replaced(tmp_path):
    folder = tmp_path / "run"

    def asked(overwrite: bool = True, ours: bool = True) -> None:
        atomic_files.require_replaceable(folder, "forcegp", lambda _: ours, overwrite=overwrite, own=["own.txt"])

    asked(overwrite=False)
    folder.mkdir()
    asked(overwrite=False, ours=False)
    (folder / "model.txt").write_text("one")
    atomic_files.write_digests(folder)
    (folder / "own.txt").write_text("two")
    asked()
    for more, words in (({"ours": False}, "was not written by forcegp"), ({"overwrite": False}, "exists already")):
        with pytest.raises(FileFormatError, match=words):
            asked(**more)
    (folder / "notes").mkdir()
    (folder / "notes" / "monday.txt").write_text("mine")
    (folder / "elsewhere").symlink_to("/nowhere")
    with pytest.raises(FileFormatError, match=r"did not write \(elsewhere, notes/monday\.txt\)"):
        asked()
    os.truncate(folder / "model.txt", 1 << 30)
    with pytest.raises(FileFormatError, match="claims 1024 MiB"):
        atomic_files.require_unchanged(folder, "fit again")
    (folder / "model.txt").write_text("other")
    with pytest.raises(FileFormatError, match=r"damaged: model\.txt is not as it was written; fit again"):
        atomic_files.require_unchanged(folder, "fit again")
