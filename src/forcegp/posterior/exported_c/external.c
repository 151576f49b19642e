//// head
/* External functions for CasADi; with casadi.external("@NAME@_acceleration", "./lib@NAME@_external.so") it finds
   @NAME@_acceleration(q, v, u) -> a, and @NAME@_next(x, u) -> x_next if there is a time step, x = [q, v]. */
#include "@NAME@.h"
typedef long long int number;
#define IN(k) (arg[k] ? arg[k] : zeros) /* what CasADi leaves out is zero */
#define PUT(k, rows, columns, value) \
  if (res[k]) for (int j = 0; j < (columns); j++) for (int i = 0; i < (rows); i++) res[k][j * (rows) + i] = (value)
/* shapes are rows, columns, and 1 for dense or 0, 0 for what is not needed */
#define EXTERNAL(function, in, out) \
  number function##_n_in(void) { return sizeof in / sizeof in[0]; } \
  number function##_n_out(void) { return sizeof out / sizeof out[0]; } \
  const number *function##_sparsity_in(number k) { return in[k]; } \
  const number *function##_sparsity_out(number k) { return out[k]; } \
  int function##_work(number *arguments, number *results, number *integers, number *doubles) { \
    *arguments = sizeof in / sizeof in[0]; *results = sizeof out / sizeof out[0]; *integers = *doubles = 0; \
    return 0; \
  } \
  int function(const double **arg, double **res, number *integers, double *doubles, int memory)
#define IGNORED (void)integers; (void)doubles; (void)memory
enum {N = @NV@, NQ = @NQ@, NU = @NU@};
static const double zeros[NQ + N + NU] = {0.0};

//// mean
static const number of_state[][4] = {{NQ, 1, 1, 0}, {N, 1, 1, 0}, {NU, 1, 1, 0}}, one[][4] = {{N, 1, 1, 0}};
EXTERNAL(@NAME@_acceleration, of_state, one) {
  double a[N];
  IGNORED;
  if (@NAME@_mean(IN(0), IN(1), IN(2), a)) return 1;
  PUT(0, N, 1, a[i]);
  return 0;
}

//// linearize
static const number of_state_a[][4] = {{NQ, 1, 1, 0}, {N, 1, 1, 0}, {NU, 1, 1, 0}, {N, 1, 0, 0}};
static const number three[][4] = {{N, N, 1, 0}, {N, N, 1, 0}, {N, N, 1, 0}};
EXTERNAL(jac_@NAME@_acceleration, of_state_a, three) {
  double a[N], J[3 * N * N];
  IGNORED;
  if (@NAME@_linearize(IN(0), IN(1), IN(2), a, J)) return 1;
  for (int k = 0; k < 3; k++) PUT(k, N, N, J[3 * N * i + N * k + j]);
  return 0;
}

//// step
static const number of_x_u[][4] = {{NQ + N, 1, 1, 0}, {NU, 1, 1, 0}}, next[][4] = {{NQ + N, 1, 1, 0}};
EXTERNAL(@NAME@_next, of_x_u, next) {
  double x[NQ + N];
  IGNORED;
  if (@NAME@_step(IN(0), IN(0) + NQ, IN(1), x, x + NQ)) return 1;
  PUT(0, NQ + N, 1, x[i]);
  return 0;
}

//// step_jacobian
static const number of_x_u_next[][4] = {{2 * N, 1, 1, 0}, {N, 1, 1, 0}, {2 * N, 1, 0, 0}};
static const number both[][4] = {{2 * N, 2 * N, 1, 0}, {2 * N, N, 1, 0}};
EXTERNAL(jac_@NAME@_next, of_x_u_next, both) {
  double x[2 * N], A[4 * N * N], B[2 * N * N];
  IGNORED;
  if (@NAME@_step_jacobian(IN(0), IN(0) + N, IN(1), x, x + N, A, B)) return 1;
  PUT(0, 2 * N, 2 * N, A[2 * N * i + j]);
  PUT(1, 2 * N, N, B[N * i + j]);
  return 0;
}
