"""What all machine code shares: compilers, and tensors that carry no derivatives which the code would lose."""

import ctypes

import pytest
import torch
from torch.autograd import forward_ad

from forcegp.codegen.native_code import CPP, C, compile_library, require_plain
from forcegp.errors import CompilerError, InvalidInput

SOURCES = {C: "double twice(double x) { return x + x; }"}
SOURCES[CPP] = f'extern "C" {SOURCES[C]}'


@pytest.mark.parametrize("language", [C, CPP], ids=["C", "C++"])
def test_a_text_becomes_a_library(language, tmp_path):
    path = tmp_path / "code.so"
    options = ("-fPIC", "-shared")
    compile_library(language, SOURCES[language], options, path, purpose="a test", instead="give up")
    twice = ctypes.CDLL(str(path)).twice
    twice.restype, twice.argtypes = ctypes.c_double, [ctypes.c_double]
    assert twice(1.25) == 2.5
    with pytest.raises(CompilerError, match=rf"the {language.name.replace('+', '.')} compiler failed: .*or give up"):
        compile_library(language, "no program", options, path, purpose="a test", instead="give up")


@pytest.mark.parametrize("language", [C, CPP], ids=["C", "C++"])
def test_without_a_compiler_the_error_names_those_looked_for(language, tmp_path, monkeypatch):
    monkeypatch.delenv(language.variable, raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(CompilerError) as raised:
        compile_library(language, SOURCES[language], (), tmp_path / "x.so", purpose="a test", instead="give up")
    for text in (*language.commands, language.packages, language.variable, "a test needs", "or give up"):
        assert text in str(raised.value)
    assert list(tmp_path.iterdir()) == []


def test_only_tensors_with_hidden_derivatives_are_refused():
    x = torch.zeros(3, dtype=torch.float64)
    require_plain([x, x.clone().requires_grad_()], "code", "do without")
    with forward_ad.dual_level():
        require_plain([x], "code", "do without")
        with pytest.raises(InvalidInput, match="forward-mode"):
            require_plain([x, forward_ad.make_dual(x, x)], "code", "do without")

    def through_code(y):
        require_plain([y], "code", "do without")
        return y

    for transform in (torch.func.vmap, torch.func.jacrev, torch.func.jacfwd):
        with pytest.raises(InvalidInput, match=r"does not support transforms of torch\.func .*; do without"):
            transform(through_code)(x)
