"""What stands in the files of an exported model beside its program: C text with NAME, @NV@ and other words to fill in."""

from __future__ import annotations

import re
from collections.abc import Mapping

HEADER = """\
/*
@COMMENT@

   Arrays are in the order of the joints, matrices row by row. All functions are re-entrant and return
   @NAME@_OK or bits of what was wrong; results are NaN where they are not known.
*/
#ifndef @NAME@_H
#define @NAME@_H
#ifdef __cplusplus
extern "C" {
#endif

enum {
  @NAME@_NV = @NV@,
  @NAME@_OK = 0,
  @NAME@_INPUT_NOT_FINITE = 1,
  @NAME@_RESULT_NOT_FINITE = 4 /* singular there, outside the range of a table, or an implicit step not found */
};

@PROTOTYPES@

#ifdef __cplusplus
}
#endif
#endif
"""

HEAD = """\
#include "@NAME@.h"
#include <string.h>
#ifdef __FAST_MATH__
#error "compile @NAME@.c without -ffast-math: it has to notice numbers that are not finite"
#endif
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize ("no-tree-slp-vectorize") /* takes most of the time of the compiler and gains nothing here */
#endif
"""

CALLS = """
static int stored(const double *from, double *to, int count) {
  int good = 1;
  for (int k = 0; k < count; k++) { to[k] = from[k]; good &= from[k] - from[k] == 0.0; }
  return good ? @NAME@_OK : @NAME@_RESULT_NOT_FINITE;
}
/* x = [q, v, u]; what is not finite is refused here, and the `count` results become NaN */
static int refused(const double *q, const double *v, const double *u, double *x, double *result, int count) {
  int found = stored(q, x, @NV@) | stored(v, x + @NV@, @NV@) | stored(u, x + 2 * @NV@, @NV@);
  for (int k = 0; found && k < count; k++) result[k] = NAN;
  return found ? @NAME@_INPUT_NOT_FINITE : @NAME@_OK;
}
"""

FUNCTIONS = {
    "mean": """
/* mean of the acceleration at (q, v) under u */
int @NAME@_mean(const double q[@NV@], const double v[@NV@], const double u[@NV@], double a[@NV@]) {
  double x[3 * @NV@], y[@NV@];
  if (refused(q, v, u, x, a, @NV@)) return @NAME@_INPUT_NOT_FINITE;
  mean(tables, 1, x, y);
  return stored(y, a, @NV@);
}
""",
    "covariance": """
/* the same and its covariance, without measurement noise */
int @NAME@_mean_covariance(const double q[@NV@], const double v[@NV@], const double u[@NV@], double a[@NV@],
                         double covariance[@NV@ * @NV@]) {
  double x[3 * @NV@], y[@GIVEN@], c[@NV@ * @NV@];
  if (refused(q, v, u, x, a, @NV@) | refused(q, v, u, x, covariance, @NV@ * @NV@)) return @NAME@_INPUT_NOT_FINITE;
  mean_and_terms(tables, 1, x, y);
  covariance_of(tables, y + @NV@, c);
  return stored(y, a, @NV@) | stored(c, covariance, @NV@ * @NV@);
}
""",
    "linearize": """
/* the same and its derivatives: jacobian[3 NV i + k] = d a_i / d [q, v, u]_k */
int @NAME@_linearize(const double q[@NV@], const double v[@NV@], const double u[@NV@], double a[@NV@],
                   double jacobian[3 * @NV@ * @NV@]) {
  double x[3 * @NV@], y[@NV@ + 3 * @NV@ * @NV@];
  if (refused(q, v, u, x, a, @NV@) | refused(q, v, u, x, jacobian, 3 * @NV@ * @NV@)) return @NAME@_INPUT_NOT_FINITE;
  slopes(tables, 1, x, y);
  return stored(y, a, @NV@) | stored(y + @NV@, jacobian, 3 * @NV@ * @NV@);
}
""",
    "step": """
/* the state one step later */
int @NAME@_step(const double q[@NV@], const double v[@NV@], const double u[@NV@], double q_next[@NV@], double v_next[@NV@]) {
  enum {N = @NV@, ROUNDS = 60};
  const double *const *t = tables;
  const double dt = @DT@;
  const long live = 1;
  double x[3 * N], y[N + 3 * N * N], q1[N], v1[N], a[N], q0[N], v0[N], m[N], d[N];
  (void)ROUNDS; (void)a; (void)q0; (void)v0; (void)m; (void)d;
  if (refused(q, v, u, x, q_next, N) | refused(q, v, u, x, v_next, N)) return @NAME@_INPUT_NOT_FINITE;
  { @STEP@ }
  return stored(q1, q_next, N) | stored(v1, v_next, N);
}
""",
    "step_jacobian": """
/* K = da along the directions S of (q, v), of which those of u follow; y = [a, da / d(q, v, u)] */
static void along(const double *y, double S[2 * @NV@][3 * @NV@], double K[@NV@][3 * @NV@]) {
  for (int i = 0; i < @NV@; i++) for (int c = 0; c < 3 * @NV@; c++) {
    const double *row = y + @NV@ + 3 * @NV@ * i;
    K[i][c] = c < 2 * @NV@ ? 0.0 : row[c];
    for (int j = 0; j < 2 * @NV@; j++) K[i][c] += row[j] * S[j][c];
  }
}

/* the same and its derivatives in [q, v], A[2 NV i + k], and in u, B[NV i + k] */
int @NAME@_step_jacobian(const double q[@NV@], const double v[@NV@], const double u[@NV@], double q_next[@NV@],
                       double v_next[@NV@], double A[4 * @NV@ * @NV@], double B[2 * @NV@ * @NV@]) {
  enum {N = @NV@};
  const double dt = @DT@;
  double x[3 * N], y[N + 3 * N * N], S[2 * N][3 * N], K[N][3 * N];
  int found = @NAME@_step(q, v, u, q_next, v_next);
  if (refused(q, v, u, x, A, 4 * N * N) | refused(q, v, u, x, B, 2 * N * N)) return @NAME@_INPUT_NOT_FINITE;
  for (int i = 0; i < 2 * N; i++) for (int c = 0; c < 3 * N; c++) S[i][c] = i == c;
  { @SLOPES@ }
  for (int i = 0; i < 2 * N; i++) found |= stored(S[i], A + 2 * N * i, 2 * N) | stored(S[i] + 2 * N, B + N * i, N);
  return found;
}
""",
}
"""By the program or step that each is made of."""

STEP_SLOPES = {
    "symplectic-euler": """
    slopes(tables, 1, x, y);
    along(y, S, K);
    for (int i = 0; i < N; i++) for (int c = 0; c < 3 * N; c++) {
      S[N + i][c] += dt * K[i][c]; S[i][c] += dt * S[N + i][c];
    }
""",
    "rk4": """
    const double b[4] = {dt / 6.0, dt / 3.0, dt / 3.0, dt / 6.0}, h[4] = {0.0, 0.5 * dt, 0.5 * dt, dt};
    double X[2 * N][3 * N];
    memset(X, 0, sizeof X); memset(K, 0, sizeof K); memset(y, 0, sizeof y);
    for (int s = 0; s < 4; s++) {
      for (int i = 0; i < N; i++) {
        x[i] = q[i] + h[s] * x[N + i]; x[N + i] = v[i] + h[s] * y[i];
        for (int c = 0; c < 3 * N; c++) {
          X[i][c] = (i == c) + h[s] * X[N + i][c]; X[N + i][c] = (N + i == c) + h[s] * K[i][c];
        }
      }
      slopes(tables, 1, x, y);
      along(y, X, K);
      for (int i = 0; i < N; i++) for (int c = 0; c < 3 * N; c++) {
        S[i][c] += b[s] * X[N + i][c]; S[N + i][c] += b[s] * K[i][c];
      }
    }
""",
    "implicit-midpoint": """
    const double h = 0.5 * dt; /* m = v + h a(q + h m, m, u), solved for dm */
    double J[N][N], X[2 * N][3 * N];
    memset(X, 0, sizeof X);
    for (int i = 0; i < N; i++) {
      x[N + i] = 0.5 * (v[i] + v_next[i]); x[i] = q[i] + h * x[N + i];
      X[i][i] = 1.0;
    }
    slopes(tables, 1, x, y);
    along(y, X, K);
    for (int i = 0; i < N; i++) {
      for (int c = 0; c < 3 * N; c++) K[i][c] = h * K[i][c] + (c == N + i);
      for (int j = 0; j < N; j++)
        J[i][j] = (i == j) - h * (y[N + 3 * N * i + N + j] + h * y[N + 3 * N * i + j]);
    }
    for (int p = 0; p < N; p++) {
      int best = p;
      for (int i = p + 1; i < N; i++) if (fabs(J[i][p]) > fabs(J[best][p])) best = i;
      for (int j = 0; j < N; j++) { const double z = J[p][j]; J[p][j] = J[best][j]; J[best][j] = z; }
      for (int c = 0; c < 3 * N; c++) { const double z = K[p][c]; K[p][c] = K[best][c]; K[best][c] = z; }
      for (int i = 0; i < N; i++) if (i != p) {
        const double w = J[i][p] / J[p][p];
        for (int j = p; j < N; j++) J[i][j] -= w * J[p][j];
        for (int c = 0; c < 3 * N; c++) K[i][c] -= w * K[p][c];
      }
    }
    for (int i = 0; i < N; i++) for (int c = 0; c < 3 * N; c++) {
      const double dm = K[i][c] / J[i][i];
      S[i][c] += dt * dm; S[N + i][c] = 2.0 * dm - S[N + i][c];
    }
""",
}
"""S, the derivatives of (q, v) after a step in those before it and in u."""

EXTERNAL = """\
/* External functions for CasADi; with casadi.external("@NAME@_acceleration", "./lib@NAME@_external.so") it finds
   @NAME@_acceleration(q, v, u) -> a, and @NAME@_next(x, u) -> x_next if there is a time step, x = [q, v]. */
#include "@NAME@.h"
typedef long long int number;
#define IN(k) (arg[k] ? arg[k] : zeros) /* what CasADi leaves out is zero */
#define PUT(k, rows, columns, value) \\
  if (res[k]) for (int j = 0; j < (columns); j++) for (int i = 0; i < (rows); i++) res[k][j * (rows) + i] = (value)
static const double zeros[2 * @NV@] = {0.0};
"""
EXTERNAL_FUNCTION = """
number @FUNCTION@_n_in(void) { return sizeof (number[][4]){@INPUTS@} / sizeof (number[4]); }
number @FUNCTION@_n_out(void) { return sizeof (number[][3]){@OUTPUTS@} / sizeof (number[3]); }
const number *@FUNCTION@_sparsity_in(number k) {
  static const number shapes[][4] = {@INPUTS@}; /* rows, columns, and 1 for dense or 0, 0 for not needed */
  return shapes[k];
}
const number *@FUNCTION@_sparsity_out(number k) {
  static const number shapes[][3] = {@OUTPUTS@};
  return shapes[k];
}
int @FUNCTION@_work(number *arguments, number *results, number *integers, number *doubles) {
  *arguments = @FUNCTION@_n_in(); *results = @FUNCTION@_n_out(); *integers = 0; *doubles = 0;
  return 0;
}
int @FUNCTION@(const double **arg, double **res, number *integers, double *doubles, int memory) {
  (void)integers; (void)doubles; (void)memory;
  @BODY@
  return 0;
}
"""
_N, _X = "{@NV@, 1, 1, 0}", "{2 * @NV@, 1, 1, 0}"
_ALL, _STATE = "IN(0), IN(1), IN(2)", "IN(0), IN(0) + @NV@, IN(1)"
_NEXT = "PUT(0, 2 * @NV@, 1, x[i]);"
EXTERNALS = {
    "mean": (
        *("@NAME@_acceleration", f"{_N}, {_N}, {_N}", "{@NV@, 1, 1}"),
        f"double a[@NV@];\n  if (@NAME@_mean({_ALL}, a)) return 1;\n  PUT(0, @NV@, 1, a[i]);",
    ),
    "linearize": (
        *(
            "jac_@NAME@_acceleration",
            f"{_N}, {_N}, {_N}, {{@NV@, 1, 0, 0}}",
            "{@NV@, @NV@, 1}, {@NV@, @NV@, 1}, {@NV@, @NV@, 1}",
        ),
        f"double a[@NV@], J[3 * @NV@ * @NV@];\n  if (@NAME@_linearize({_ALL}, a, J)) return 1;\n"
        "  for (int k = 0; k < 3; k++) PUT(k, @NV@, @NV@, J[3 * @NV@ * i + @NV@ * k + j]);",
    ),
    "step": (
        *("@NAME@_next", f"{_X}, {_N}", "{2 * @NV@, 1, 1}"),
        f"double x[2 * @NV@];\n  if (@NAME@_step({_STATE}, x, x + @NV@)) return 1;\n  PUT(0, 2 * @NV@, 1, x[i]);",
    ),
    "step_jacobian": (
        *("jac_@NAME@_next", f"{_X}, {_N}, {{2 * @NV@, 1, 0, 0}}", "{2 * @NV@, 2 * @NV@, 1}, {2 * @NV@, @NV@, 1}"),
        "double x[2 * @NV@], A[4 * @NV@ * @NV@], B[2 * @NV@ * @NV@];\n"
        f"  if (@NAME@_step_jacobian({_STATE}, x, x + @NV@, A, B)) return 1;\n"
        "  PUT(0, 2 * @NV@, 2 * @NV@, A[2 * @NV@ * i + j]);\n  PUT(1, 2 * @NV@, @NV@, B[@NV@ * i + j]);",
    ),
}
"""By the function that each calls: name, shapes of inputs and of outputs, C text."""

ACADOS = """\
/* Discrete dynamics in acados' generic form: model.dyn_ext_fun_type = 'generic', model.dyn_generic_source =
   '@NAME@_acados.c', model.dyn_disc_fun = '@NAME@_disc_dyn_fun', model.dyn_disc_fun_jac = '@NAME@_disc_dyn_fun_jac',
   x = [q, v], dt = @DT@. Put @NAME@.c and @NAME@.h beside the copy that acados makes of this file. */
#include "acados/utils/external_function_generic.h"
#include "blasfeo_d_aux.h"
#include "@NAME@.c"

static void taken(void **in, double *x) {
  struct blasfeo_dvec_args *state = in[0], *input = in[1];
  for (int k = 0; k < 2 * @NV@; k++) x[k] = blasfeo_dvecex1(state->x, state->xi + k);
  for (int k = 0; k < @NV@; k++) x[2 * @NV@ + k] = blasfeo_dvecex1(input->x, input->xi + k);
}
static void given(void **out, const double *x) {
  struct blasfeo_dvec_args *next = out[0];
  for (int k = 0; k < 2 * @NV@; k++) blasfeo_dvecin1(x[k], next->x, next->xi + k);
}
int @NAME@_disc_dyn_fun(void **in, void **out, void *params) {
  double x[3 * @NV@], next[2 * @NV@];
  (void)params;
  taken(in, x);
  const int found = @NAME@_step(x, x + @NV@, x + 2 * @NV@, next, next + @NV@);
  given(out, next);
  return found;
}
"""
ACADOS_JACOBIAN = """\
int @NAME@_disc_dyn_fun_jac(void **in, void **out, void *params) { /* [d x+ / d u, d x+ / d x] transposed */
  double x[3 * @NV@], next[2 * @NV@], A[4 * @NV@ * @NV@], B[2 * @NV@ * @NV@];
  struct blasfeo_dmat_args *J = out[1];
  (void)params;
  taken(in, x);
  const int found = @NAME@_step_jacobian(x, x + @NV@, x + 2 * @NV@, next, next + @NV@, A, B);
  given(out, next);
  for (int i = 0; i < 2 * @NV@; i++) {
    for (int j = 0; j < @NV@; j++) blasfeo_dgein1(B[@NV@ * i + j], J->A, J->ai + j, J->aj + i);
    for (int j = 0; j < 2 * @NV@; j++) blasfeo_dgein1(A[2 * @NV@ * i + j], J->A, J->ai + @NV@ + j, J->aj + i);
  }
  return found;
}
"""

CMAKE = """\
cmake_minimum_required(VERSION 3.10)
project(exported_model C)
if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()
if(NOT MSVC)
  set(CMAKE_C_FLAGS_RELEASE "-O2")
  set(math m)
endif()
set(CMAKE_C_STANDARD 99)
set(CMAKE_C_EXTENSIONS OFF)
set(CMAKE_POSITION_INDEPENDENT_CODE ON)
set(CMAKE_WINDOWS_EXPORT_ALL_SYMBOLS ON)

add_library(model STATIC @NAME@.c)
target_include_directories(model PUBLIC ${CMAKE_CURRENT_SOURCE_DIR})
target_link_libraries(model PUBLIC ${math})
add_library(external SHARED $<TARGET_OBJECTS:model> @NAME@_external.c) # for CasADi
target_link_libraries(external PRIVATE ${math})
set_target_properties(model PROPERTIES OUTPUT_NAME @NAME@)
set_target_properties(external PROPERTIES OUTPUT_NAME @NAME@_external)

foreach(program example self_test)
  add_executable(${program} ${program}.c)
  target_link_libraries(${program} PRIVATE model)
endforeach()
enable_testing()
add_test(NAME self_test COMMAND self_test)
"""

EXAMPLE = """\
/* The robot moves from a state of the training data for a second under constant forces: Euler's method, 1 ms. */
#include "@NAME@.h"
#include <stdio.h>

int main(void) {
  double q[@NV@] = {@START_Q@};
  double v[@NV@] = {@START_V@};
  const double u[@NV@] = {@START_U@};
  const double dt = 0.001;
  double a[@NV@];

  for (int step = 0; step <= 1000; step++) {
    const int found = @NAME@_mean(q, v, u, a);
    if (found) {
      fprintf(stderr, "after %d steps @NAME@_mean reports %d, see @NAME@.h\\n", step, found);
      return 1;
    }
    if (step % 100 == 0) {
      printf("%.1f s  q =", step * dt);
      for (int j = 0; j < @NV@; j++) printf(" %8.4f", q[j]);
      printf("\\n");
    }
    for (int j = 0; j < @NV@; j++) {
      v[j] += dt * a[j];
      q[j] += dt * v[j];
    }
  }
  return 0;
}
"""

SELF_TEST = """\
/* Stored states and what forcegp computed for them; exit code 1 where this program computes something else. */
#include "@NAME@.h"
#include <math.h>
#include <stdio.h>

static int failures = 0;
static void compare(const char *what, const double *found, const double *wanted, int count, double bound) {
  double most = 0.0;
  for (int k = 0; k < count; k++) {
    const double apart = fabs(found[k] - wanted[k]);
    if (!(apart <= most)) most = apart; /* also NaN */
  }
  if (!(most <= bound)) {
    failures++;
    printf("%s differs by %g, more than %g\\n", what, most, bound);
  }
}
@STORED@
int main(void) {
@CALLS@
  printf(failures ? "%d failures\\n" : "%d failures: all as stored\\n", failures);
  return failures != 0;
}
"""

README = """\
@NAME@: @TITLE@, as C99. @NAME@.h says what it is and how to call it.

cc -std=c99 -O2 example.c @NAME@.c -o example -lm && ./example      # a motion of one second
cc -std=c99 -O2 self_test.c @NAME@.c -o self_test -lm && ./self_test  # exit code 1 if this machine computes otherwise
cmake -S . -B build && cmake --build build && ctest --test-dir build  # the same, and the libraries for C and CasADi
cc -std=c99 -O2 -shared -fPIC @NAME@.c @NAME@_external.c -o lib@NAME@_external.so -lm  # that for CasADi alone

On a microcontroller add @NAME@.c and @NAME@.h to the project: no allocation, no state. Do not compile with -ffast-math.
@CHECKED@
"""


def filled(text: str, words: Mapping[str, object]) -> str:
    """The text with what stands for every `@WORD@`."""
    return re.sub("@([A-Z_]+)@", lambda found: str(words[found[1]]), text)
