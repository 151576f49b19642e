"""What all machine code shares: compilers, and tensors that carry no derivatives which the code would lose."""

import ctypes
import os
import stat
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch.autograd import forward_ad

from forcegp.codegen import library
from forcegp.errors import CompilerError, InvalidInput

SOURCE = "double twice(double x) { return x + x; }"


def test_a_text_becomes_a_library(tmp_path):
    path = tmp_path / "code.so"
    options = ("-fPIC", "-shared")
    twice = library.compile_library(SOURCE, options, path, "twice").twice
    twice.restype, twice.argtypes = ctypes.c_double, [ctypes.c_double]
    assert twice(1.25) == 2.5
    with pytest.raises(CompilerError, match=r"the C compiler failed: .*or do without"):
        library.compile_library("no program", options, path, "twice")


def test_without_a_compiler_the_error_names_those_looked_for(tmp_path, monkeypatch):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(CompilerError) as raised:
        library.compile_library(SOURCE, (), tmp_path / "x.so", "twice")
    for text in (*library.COMMANDS, library.PACKAGES, "CC", "compiled code needs", "or do without"):
        assert text in str(raised.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ('gcc "', r"CC is 'gcc \"', which is no command \(No closing quotation\); correct it"),
        ("{}/text", "compiler failed"),
    ],
)
def test_a_command_that_is_none_is_an_error_with_a_remedy(tmp_path, monkeypatch, command, message):
    (tmp_path / "text").write_bytes(b"\x00 no program")
    (tmp_path / "text").chmod(0o700)
    monkeypatch.setenv("CC", command.format(tmp_path))
    with pytest.raises(CompilerError, match=message):
        library.compile_library(SOURCE, (), tmp_path / "x.so", "twice")


def test_a_compiler_that_hangs_is_given_up(tmp_path, monkeypatch):
    slow = tmp_path / "slow"
    slow.write_text("#!/bin/sh\nexec sleep 60\n")
    slow.chmod(0o700)
    monkeypatch.setenv("CC", str(slow))
    monkeypatch.setattr("forcegp.codegen.library.LONGEST", 0.2)
    with pytest.raises(CompilerError, match=r"compiler failed: .*slow: it did not end within 0\.2 s; name another"):
        library.compile_library(SOURCE, (), tmp_path / "x.so", "twice")


def test_only_tensors_with_hidden_derivatives_are_refused():
    x = torch.zeros(3, dtype=torch.float64)
    library.require_plain([x, x.clone().requires_grad_()], "code", "do without")
    with forward_ad.dual_level():
        library.require_plain([x], "code", "do without")
        with pytest.raises(InvalidInput, match="forward-mode"):
            library.require_plain([x, forward_ad.make_dual(x, x)], "code", "do without")

    def through_code(y):
        library.require_plain([y], "code", "do without")
        return y

    for transform in (torch.func.vmap, torch.func.jacrev, torch.func.jacfwd):
        with pytest.raises(InvalidInput, match=r"does not support transforms of torch\.func .*; do without"):
            transform(through_code)(x)


@pytest.mark.parametrize("kind", [".py", ".c"])
def test_kept_programs_are_made_again_where_a_text_has_changed(kind, monkeypatch):
    before, read = library.code_digest.__wrapped__(), Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: read(path) + (b"/**/" if path.suffix == kind else b""))
    assert library.code_digest.__wrapped__() != before


def test_a_kept_program_is_loaded_again_unless_others_may_change_it(tmp_path):
    written = []

    def write(lanes):
        written.append(lanes)
        return f"int evaluate(void) {{ return {len(written)}; }}"

    found = [library.load_library("x", key, write, folder=tmp_path / "kept").evaluate() for key in ("a", "a", "b")]
    assert (found, len(written)) == ([1, 1, 2], 2)
    for path in (tmp_path / "kept").iterdir():
        assert stat.S_IMODE(path.stat().st_mode) == 0o700
        path.chmod(0o770)
    with pytest.raises(CompilerError, match=r"can be written to by others than you, .*chmod go-w"):
        library.load_library("x", "a", write, folder=tmp_path / "kept")
    broken = tmp_path / "broken.so"
    broken.write_text("no library")
    with pytest.raises(CompilerError, match=r"cannot be loaded .*delete it, and it is compiled anew"):
        library.opened_library(broken)


@pytest.mark.parametrize(
    ("parent", "own", "refused"),
    [
        (0o700, 0o700, False),
        (0o1777, 0o700, False),  # only owners exchange what is there
        (0o777, 0o700, True),
        (0o770, 0o700, True),
        (0o700, 0o770, True),
        (0o700, 0o702, True),
        (0o700, 0o1777, True),
    ],
)
def test_folders_that_others_may_write_to_are_refused(tmp_path, parent, own, refused):
    folder = tmp_path / "parent" / "own"
    folder.mkdir(parents=True)
    folder.chmod(own)
    folder.parent.chmod(parent)
    link = tmp_path / "link"
    link.symlink_to(folder)
    for path in (folder, link):
        if refused:
            with pytest.raises(CompilerError, match="can be written to by others"):
                library.own_folder(path)
        else:
            assert library.own_folder(path) == folder.resolve()


def test_folders_are_made_for_the_user_alone_where_they_can_be(tmp_path):
    folder = library.own_folder(tmp_path / "new" / "kept")
    assert [stat.S_IMODE(path.stat().st_mode) for path in (folder, folder.parent)] == [0o700, 0o700]
    (tmp_path / "file").touch()
    with pytest.raises(CompilerError, match=r"cannot be made \(File exists\); choose another folder"):
        library.own_folder(tmp_path / "file")


@pytest.mark.parametrize(("owner", "refused"), [(os.getuid(), False), (0, False), (os.getuid() + 1, True)])
def test_what_belongs_to_another_user_is_refused(tmp_path, monkeypatch, owner, refused):
    monkeypatch.setattr(Path, "stat", lambda _: SimpleNamespace(st_uid=owner, st_mode=0o100700))
    if refused:
        with pytest.raises(CompilerError, match="belongs to another user"):
            library.own_file(tmp_path)
    else:
        library.own_file(tmp_path)


def test_default_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert library.default_folder() == tmp_path / "forcegp" / "compiled"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert library.default_folder() == Path.home() / ".cache" / "forcegp" / "compiled"
