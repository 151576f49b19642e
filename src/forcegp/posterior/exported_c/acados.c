//// step
/* Discrete dynamics in acados' generic form: model.dyn_ext_fun_type = 'generic', model.dyn_generic_source =
   '@NAME@_acados.c', model.dyn_disc_fun = '@NAME@_disc_dyn_fun', model.dyn_disc_fun_jac = '@NAME@_disc_dyn_fun_jac',
   x = [q, v], dt = @DT@. Put @NAME@.c and @NAME@.h beside the copy that acados makes of this file. */
#include "acados/utils/external_function_generic.h"
#include "blasfeo_d_aux.h"
#include "@NAME@.c"

static void taken(void **in, double *x) {
  struct blasfeo_dvec_args *state = in[0], *input = in[1];
  for (int k = 0; k < @X@; k++) x[k] = blasfeo_dvecex1(state->x, state->xi + k);
  for (int k = 0; k < @NU@; k++) x[@X@ + k] = blasfeo_dvecex1(input->x, input->xi + k);
}
static void given(void **out, const double *x) {
  struct blasfeo_dvec_args *next = out[0];
  for (int k = 0; k < @X@; k++) blasfeo_dvecin1(x[k], next->x, next->xi + k);
}
int @NAME@_disc_dyn_fun(void **in, void **out, void *params) {
  double x[@ALL@], next[@X@];
  (void)params;
  taken(in, x);
  const int found = @NAME@_step(x, x + @NQ@, x + @X@, next, next + @NQ@);
  given(out, next);
  return found;
}

//// step_jacobian
int @NAME@_disc_dyn_fun_jac(void **in, void **out, void *params) { /* [d x+ / d u, d x+ / d x] transposed */
  double x[@ALL@], next[2 * @NV@], A[4 * @NV@ * @NV@], B[2 * @NV@ * @NV@];
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

