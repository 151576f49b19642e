"""Runs tapes: one small C++ program, compiled once per process, that interprets them for any model.

The same instructions run on three kinds of numbers: one double for a single state, vectors of doubles for batches, and
dual numbers (a value and its derivatives in all inputs; Griewank & Walther, "Evaluating Derivatives", 2008, ch. 3.1)
for Jacobians.
"""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.codegen.cpp_library import cpp_library
from forcegp.codegen.tape import CODES, Program
from forcegp.errors import InvalidInput

# Value and derivative of every function of one number, with y for the value; "absolute" has no slope at 0, as in torch.
FUNCTIONS = {
    "negate": ("-x", "-1.0"),
    "absolute": ("std::fabs(x)", "double((x > 0.0) - (x < 0.0))"),
    "sqrt": ("std::sqrt(x)", "0.5 / y"),
    "sin": ("std::sin(x)", "std::cos(x)"),
    "cos": ("std::cos(x)", "-std::sin(x)"),
    "tan": ("std::tan(x)", "1.0 + y * y"),
    "asin": ("std::asin(x)", "1.0 / std::sqrt(1.0 - x * x)"),
    "acos": ("std::acos(x)", "-1.0 / std::sqrt(1.0 - x * x)"),
    "atan": ("std::atan(x)", "1.0 / (1.0 + x * x)"),
    "sinh": ("std::sinh(x)", "std::cosh(x)"),
    "cosh": ("std::cosh(x)", "std::sinh(x)"),
    "tanh": ("std::tanh(x)", "1.0 - y * y"),
    "asinh": ("std::asinh(x)", "1.0 / std::sqrt(1.0 + x * x)"),
    "exp": ("std::exp(x)", "y"),
    "log": ("std::log(x)", "1.0 / x"),
    "log1p": ("std::log1p(x)", "1.0 / (1.0 + x)"),
    "expm1": ("std::expm1(x)", "1.0 + y"),
    "erf": ("std::erf(x)", "1.1283791670955126 * std::exp(-x * x)"),
}

SOURCE = r"""
#include <cmath>
#include <cstdint>
#include <vector>
#ifdef __AVX512F__
constexpr int LANES = 8;                      // doubles in a vector
#else
constexpr int LANES = 4;
#endif
constexpr int TANGENTS = 24 / LANES;          // vectors of derivatives in a dual number
typedef double V __attribute__((vector_size(8 * LANES)));
struct Code { int32_t operation, result, a, b, c; };
constexpr int WIDTH = 32 / LANES;                     // vectors per batch of states
constexpr int STATES = WIDTH * LANES;

struct Batch { V v[WIDTH]; };
template <int K> struct Dual { double v; V d[K]; };

static inline double power(double x, double y) { return y == 2.0 ? x * x : std::pow(x, y); }
#define SLOPES for (int k = 0; k < K; ++k)
#define EACH for (int k = 0; k < WIDTH; ++k)
#define LANE for (int k = 0; k < STATES; ++k)

// f: value and slope of the functions of one number
FUNCTION_DEFINITIONS
#define UNARY(name) \
  static inline double name##_of(double x) { return name##_value(x); } \
  static inline Batch name##_of(const Batch &x) { \
    Batch r; const double *p = (const double *)&x; double *q = (double *)&r; \
    LANE q[k] = name##_value(p[k]); return r; } \
  template <int K> static inline Dual<K> name##_of(const Dual<K> &x) { \
    Dual<K> r; r.v = name##_value(x.v); const double s = name##_slope(x.v, r.v); SLOPES r.d[k] = s * x.d[k]; return r; }
UNARY_DEFINITIONS

static inline double multiply_add(double x, double y, double z) { return x * y + z; }
static inline Batch multiply_add(const Batch &x, const Batch &y, const Batch &z) {
  Batch r; EACH r.v[k] = x.v[k] * y.v[k] + z.v[k]; return r; }
template <int K> static inline Dual<K> multiply_add(const Dual<K> &x, const Dual<K> &y, const Dual<K> &z) {
  Dual<K> r; r.v = x.v * y.v + z.v; SLOPES r.d[k] = x.v * y.d[k] + y.v * x.d[k] + z.d[k]; return r; }
static inline double multiply_subtract(double x, double y, double z) { return x * y - z; }
static inline Batch multiply_subtract(const Batch &x, const Batch &y, const Batch &z) {
  Batch r; EACH r.v[k] = x.v[k] * y.v[k] - z.v[k]; return r; }
template <int K> static inline Dual<K> multiply_subtract(const Dual<K> &x, const Dual<K> &y, const Dual<K> &z) {
  Dual<K> r; r.v = x.v * y.v - z.v; SLOPES r.d[k] = x.v * y.d[k] + y.v * x.d[k] - z.d[k]; return r; }
static inline double subtract_multiplied(double x, double y, double z) { return z - x * y; }
static inline Batch subtract_multiplied(const Batch &x, const Batch &y, const Batch &z) {
  Batch r; EACH r.v[k] = z.v[k] - x.v[k] * y.v[k]; return r; }
template <int K> static inline Dual<K> subtract_multiplied(const Dual<K> &x, const Dual<K> &y, const Dual<K> &z) {
  Dual<K> r; r.v = z.v - x.v * y.v; SLOPES r.d[k] = z.d[k] - x.v * y.d[k] - y.v * x.d[k]; return r; }

static inline double add(double x, double y) { return x + y; }
static inline Batch add(const Batch &x, const Batch &y) { Batch r; EACH r.v[k] = x.v[k] + y.v[k]; return r; }
template <int K> static inline Dual<K> add(const Dual<K> &x, const Dual<K> &y) {
  Dual<K> r; r.v = x.v + y.v; SLOPES r.d[k] = x.d[k] + y.d[k]; return r; }
static inline double subtract(double x, double y) { return x - y; }
static inline Batch subtract(const Batch &x, const Batch &y) { Batch r; EACH r.v[k] = x.v[k] - y.v[k]; return r; }
template <int K> static inline Dual<K> subtract(const Dual<K> &x, const Dual<K> &y) {
  Dual<K> r; r.v = x.v - y.v; SLOPES r.d[k] = x.d[k] - y.d[k]; return r; }
static inline double multiply(double x, double y) { return x * y; }
static inline Batch multiply(const Batch &x, const Batch &y) { Batch r; EACH r.v[k] = x.v[k] * y.v[k]; return r; }
template <int K> static inline Dual<K> multiply(const Dual<K> &x, const Dual<K> &y) {
  Dual<K> r; r.v = x.v * y.v; SLOPES r.d[k] = x.v * y.d[k] + y.v * x.d[k]; return r; }
static inline double divide(double x, double y) { return x / y; }
static inline Batch divide(const Batch &x, const Batch &y) { Batch r; EACH r.v[k] = x.v[k] / y.v[k]; return r; }
template <int K> static inline Dual<K> divide(const Dual<K> &x, const Dual<K> &y) {
  Dual<K> r; const double i = 1.0 / y.v; r.v = x.v / y.v; SLOPES r.d[k] = (x.d[k] - r.v * y.d[k]) * i; return r; }

#define SCALAR_ONLY(name, value) /* no vector instruction for it */ \
  static inline double name(double x, double y) { return value; } \
  static inline Batch name(const Batch &a, const Batch &b) { \
    Batch r; const double *p = (const double *)&a, *s = (const double *)&b; double *q = (double *)&r; \
    LANE q[k] = name(p[k], s[k]); return r; }
#define FLAT(name, value) SCALAR_ONLY(name, value) \
  template <int K> static inline Dual<K> name(const Dual<K> &x, const Dual<K> &y) { \
    Dual<K> r{}; r.v = name(x.v, y.v); return r; }
FLAT(less, double(x < y))
FLAT(at_most, double(x <= y))
FLAT(equal, double(x == y))
SCALAR_ONLY(power_of, power(x, y))
template <int K> static inline Dual<K> power_of(const Dual<K> &x, const Dual<K> &y) {
  Dual<K> r; r.v = power(x.v, y.v);
  const double s = y.v == 0.0 ? 0.0 : y.v * power(x.v, y.v - 1.0), t = x.v == 0.0 ? 0.0 : r.v * std::log(x.v);
  SLOPES { r.d[k] = s * x.d[k]; for (int l = 0; l < LANES; ++l) if (y.d[k][l] != 0.0) r.d[k][l] += t * y.d[k][l]; }
  return r; }
SCALAR_ONLY(atan2_of, std::atan2(x, y))
template <int K> static inline Dual<K> atan2_of(const Dual<K> &x, const Dual<K> &y) {
  Dual<K> r; r.v = std::atan2(x.v, y.v); const double i = 1.0 / (x.v * x.v + y.v * y.v);
  SLOPES r.d[k] = (y.v * x.d[k] - x.v * y.d[k]) * i; return r; }
static inline double choose(double m, double x, double y) { return m != 0.0 ? x : y; }
static inline Batch choose(const Batch &m, const Batch &x, const Batch &y) {
  Batch r; EACH r.v[k] = m.v[k] != 0.0 ? x.v[k] : y.v[k]; return r; }
template <int K> static inline Dual<K> choose(const Dual<K> &m, const Dual<K> &x, const Dual<K> &y) {
  return m.v != 0.0 ? x : y; }

template <class T> static void run(const Code *code, const Code *end, T *s) {
  for (; code != end; ++code) {
    T &r = s[code->result]; const T &a = s[code->a], &b = s[code->b], &c = s[code->c];
    switch (code->operation) {
CASES
    }
  }
}

template <class T> static T *memory(long slots) {
  static thread_local std::vector<char> held;
  const size_t need = (slots + 1) * sizeof(T) + 64;
  if (held.size() < need) held.resize(need);
  return (T *)(((uintptr_t)held.data() + 63) & ~(uintptr_t)63);
}

extern "C" void values(const Code *code, long count, long inputs, long slots, const double *constants, long known,
                       const int32_t *outputs, long wanted, long states, const double *in, double *out) {
  long i = 0;
  if (states >= 8) {
    Batch *s = memory<Batch>(slots);
    for (long j = 0; j < known; ++j) EACH s[inputs + j].v[k] = V{} + constants[j];
    for (; i < states; i += STATES) {       // lanes past the last state repeat it
      const long left = states - i < STATES ? states - i : STATES;
      for (long j = 0; j < inputs; ++j) {
        double *p = (double *)&s[j]; LANE p[k] = in[(i + (k < left ? k : left - 1)) * inputs + j]; }
      run(code, code + count, s);
      for (long j = 0; j < wanted; ++j) {
        const double *p = (const double *)&s[outputs[j]];
        for (long k = 0; k < left; ++k) out[(i + k) * wanted + j] = p[k];
      }
    }
    return;
  }
  double *s = memory<double>(slots);
  for (long j = 0; j < known; ++j) s[inputs + j] = constants[j];
  for (; i < states; ++i) {
    for (long j = 0; j < inputs; ++j) s[j] = in[i * inputs + j];
    run(code, code + count, s);
    for (long j = 0; j < wanted; ++j) out[i * wanted + j] = s[outputs[j]];
  }
}

extern "C" void jacobian(const Code *code, long count, long inputs, long slots, const double *constants, long known,
                         const int32_t *outputs, long wanted, long states, const double *in, double *out,
                         double *slope) {
  constexpr int K = TANGENTS;               // K * LANES derivatives at a time
  Dual<K> *s = memory<Dual<K>>(slots);
  for (long j = 0; j < known; ++j) { s[inputs + j] = Dual<K>{}; s[inputs + j].v = constants[j]; }
  for (long i = 0; i < states; ++i)
    for (long first = 0; first < inputs; first += K * LANES) {
      for (long j = 0; j < inputs; ++j) {
        s[j] = Dual<K>{}; s[j].v = in[i * inputs + j];
        if (j >= first && j < first + K * LANES) ((double *)s[j].d)[j - first] = 1.0;
      }
      run(code, code + count, s);
      for (long j = 0; j < wanted; ++j) {
        const double *d = (const double *)s[outputs[j]].d;
        out[i * wanted + j] = s[outputs[j]].v;
        double *to = slope + (i * wanted + j) * inputs;
        for (long l = first; l < inputs && l < first + K * LANES; ++l) to[l] = d[l - first];
      }
    }
}
"""


class TapeMachine:
    """A program with the compiled code that runs it on rows of float64 tensors on the CPU.

    Raises CompilerError where there is no C++ compiler, or where it fails.
    """

    def __init__(self, program: Program) -> None:
        self.program = program
        library = _library()
        self._values, self._jacobian = library.values, library.jacobian
        arrays = (program.instructions, program.constants, program.outputs)
        code, constants, outputs = (array.ctypes.data for array in arrays)
        counts = len(program.instructions), program.inputs, program.slots
        self._head = (code, *counts, constants, len(program.constants), outputs, len(program.outputs))

    def __reduce__(self) -> tuple[type[TapeMachine], tuple[Program]]:
        return TapeMachine, (self.program,)

    def __call__(self, x: Float[Tensor, "n inputs"]) -> Float[Tensor, "n outputs"]:
        """All outputs at every row of x; differentiable once in x."""
        if torch.is_grad_enabled() and x.requires_grad:
            return _Differentiable.apply(x, self)  # type: ignore[return-value]  # torch does not type `apply`
        return self.values(x)

    def values(self, x: Float[Tensor, "n inputs"]) -> Float[Tensor, "n outputs"]:
        """The outputs, without a graph."""
        x, count = x.detach().contiguous(), x.shape[0]
        out = torch.empty(count, len(self.program.outputs), dtype=torch.float64)
        self._values(*self._head, count, x.data_ptr(), out.data_ptr())
        return out

    def with_jacobian(
        self, x: Float[Tensor, "n inputs"]
    ) -> tuple[Float[Tensor, "n outputs"], Float[Tensor, "n outputs inputs"]]:
        """The outputs and d outputs / d x of every row, without a graph."""
        x, count = x.detach().contiguous(), x.shape[0]
        out = torch.empty(count, len(self.program.outputs), dtype=torch.float64)
        slopes = torch.empty(*out.shape, self.program.inputs, dtype=torch.float64)
        self._jacobian(*self._head, count, x.data_ptr(), out.data_ptr(), slopes.data_ptr())
        return out, slopes


class _Differentiable(torch.autograd.Function):
    @staticmethod
    @override
    def forward(ctx: Any, x: Tensor, machine: TapeMachine) -> Tensor:
        ctx.machine = machine
        ctx.save_for_backward(x)
        return machine.values(x)

    @staticmethod
    @override
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        if torch.is_grad_enabled():  # create_graph=True: the gradients would pass for constants
            raise InvalidInput(
                "a compiled predictor has first derivatives only; for second ones make it with compile=False."
            )
        (x,) = ctx.saved_tensors
        return (grad_outputs[0][:, None] @ ctx.machine.with_jacobian(x)[1])[:, 0], None


def cpp_source() -> str:
    """The whole C++ program."""
    functions = "\n".join(
        f"static inline double {name}_value(double x) {{ return {value}; }}\n"
        f"static inline double {name}_slope(double x, double y) {{ (void)x; (void)y; return {slope}; }}"
        for name, (value, slope) in FUNCTIONS.items()
    )
    three = ("choose", "multiply_add", "multiply_subtract", "subtract_multiplied")
    calls = {name: f"{name}_of(a)" for name in FUNCTIONS}
    calls |= {name: f"{name}(a, b, c)" for name in three}
    calls |= {"power": "power_of(a, b)", "atan2": "atan2_of(a, b)"}
    cases = "\n".join(
        f"      case {code}: r = {calls.get(name, f'{name}(a, b)')}; break;" for name, code in CODES.items()
    )
    unary = "\n".join(f"UNARY({name})" for name in FUNCTIONS)
    text = SOURCE.replace("FUNCTION_DEFINITIONS", functions).replace("UNARY_DEFINITIONS", unary)
    return text.replace("CASES", cases)


def _library() -> ctypes.CDLL:
    library = cpp_library(cpp_source(), "values")
    pointer, number = ctypes.c_void_p, ctypes.c_long
    for function, arrays in ((library.values, 2), (library.jacobian, 3)):
        function.restype = None
        function.argtypes = [pointer, *[number] * 3, pointer, number, pointer, number, number, *[pointer] * arrays]
    return library
