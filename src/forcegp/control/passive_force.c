#include <mujoco/mujoco.h>
static const double *const *tables;
static int failed;
void passive(const mjModel *m, mjData *d) {
  enum {N = @JOINTS@};
  static const int position[N] = {@POSITIONS@}, velocity[N] = {@VELOCITIES@};
  double x[3 * N], y[N];
  (void)m;
  for (int j = 0; j < N; j++) {
    x[j] = d->qpos[position[j]]; x[N + j] = d->qvel[velocity[j]]; x[2 * N + j] = 0.0;
  }
  program(tables, 1, x, y);
  for (int j = 0; j < N; j++) {
    if (!(y[j] - y[j] == 0.0)) failed = 1;
    d->qfrc_passive[velocity[j]] += y[j];
  }
}
int evaluate(const double *const *t) { /* take these tables, and report whether a force was not finite until now */
  const int before = failed;
  tables = t; failed = 0;
  return before;
}
