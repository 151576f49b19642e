//// head
#include "@NAME@.h"
#include <string.h>
#ifdef __FAST_MATH__
#error "compile @NAME@.c without -ffast-math: it has to notice numbers that are not finite"
#endif
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize ("no-tree-slp-vectorize") /* takes most of the time of the compiler and gains nothing here */
#endif

//// calls
static int stored(const double *from, double *to, int count) {
  int good = 1;
  for (int k = 0; k < count; k++) { to[k] = from[k]; good &= from[k] - from[k] == 0.0; }
  return good ? @NAME@_OK : @NAME@_RESULT_NOT_FINITE;
}
/* x = [q, v, u]; what is not finite is refused here, and the `count` results become NaN */
static int refused(const double *q, const double *v, const double *u, double *x, double *result, int count) {
  int found = stored(q, x, @NQ@) | stored(v, x + @NQ@, @NV@) | stored(u, x + @X@, @NU@);
  for (int k = 0; found && k < count; k++) result[k] = NAN;
  return found ? @NAME@_INPUT_NOT_FINITE : @NAME@_OK;
}

//// integrate
/* q after the body velocity step[] has acted for one second: velocity times seconds */
int @NAME@_integrate(const double q[@NQ@], const double step[@NV@], double q_next[@NQ@]) {
  double x[@NQ@ + @NV@], y[@NQ@];
  const int found = stored(q, x, @NQ@) | stored(step, x + @NQ@, @NV@);
  moved(tables, 1, x, y);
  return stored(y, q_next, @NQ@) | (found ? @NAME@_INPUT_NOT_FINITE : @NAME@_OK);
}

//// remember
/* what friction remembers, columns of u, after the joints went from q to q_next in dt seconds */
int @NAME@_remember(const double z[@MEMORY@], const double q[@NQ@], const double q_next[@NQ@], double dt,
                    double z_next[@MEMORY@]) {
  double x[@MEMORY@ + 2 * @NQ@ + 1], y[@MEMORY@];
  const int found = stored(z, x, @MEMORY@) | stored(q, x + @MEMORY@, @NQ@) | stored(q_next, x + @MEMORY@ + @NQ@, @NQ@) |
                    stored(&dt, x + @MEMORY@ + 2 * @NQ@, 1);
  remember(tables, 1, x, y);
  return stored(y, z_next, @MEMORY@) | (found ? @NAME@_INPUT_NOT_FINITE : @NAME@_OK);
}

//// mean
/* mean of the acceleration at (q, v) under u */
int @NAME@_mean(const double q[@NQ@], const double v[@NV@], const double u[@NU@], double a[@NV@]) {
  double x[@ALL@], y[@NV@];
  if (refused(q, v, u, x, a, @NV@)) return @NAME@_INPUT_NOT_FINITE;
  mean(tables, 1, x, y);
  return stored(y, a, @NV@);
}

//// covariance
/* the same and its covariance, without measurement noise */
int @NAME@_mean_covariance(const double q[@NQ@], const double v[@NV@], const double u[@NU@], double a[@NV@],
                         double covariance[@NV@ * @NV@]) {
  double x[@ALL@], y[@GIVEN@], c[@NV@ * @NV@];
  if (refused(q, v, u, x, a, @NV@) | refused(q, v, u, x, covariance, @NV@ * @NV@)) return @NAME@_INPUT_NOT_FINITE;
  mean_and_terms(tables, 1, x, y);
  covariance_of(tables, y + @NV@, c);
  return stored(y, a, @NV@) | stored(c, covariance, @NV@ * @NV@);
}

//// inverse_dynamics
/* u of the actuators that makes the acceleration a, which has to obey the contacts; normal_force: with how much each
   contact presses on the robot, and memory: what friction remembers, both one number each or NULL for zeros */
int @NAME@_inverse_dynamics(const double q[@NQ@], const double v[@NV@], const double a[@NV@],
                          const double *normal_force, const double *memory, double u[@NV@]) {
  enum {N = @NV@, NU = @NU@, K = @MEMORY@, AT = @COLUMN@, M = @CONTACTS@, ROUNDS = 60};
  double x[@ALL@], y[N + N * NU + N * N + M * N + 2 * M], wanted[N], J[N][N + 1], most = 0.0, before = HUGE_VAL, w = 1.0;
  const double *Q = y, *slope = y + N, *mass = slope + N * NU, *A = mass + N * N;
  int found = stored(q, x, @NQ@) | stored(v, x + @NQ@, N) | stored(a, wanted, N);
  (void)A; (void)normal_force; (void)memory;
  for (int k = 0; k < NU; k++) x[@X@ + k] = 0.0;
  for (int k = 0; k < K && memory; k++) found |= stored(memory + k, x + @X@ + AT + k, 1);
  for (int k = 0; k < M && normal_force; k++) found |= stored(normal_force + k, J[0], 1);
  for (int i = 0; i < N; i++) u[i] = found ? NAN : 0.0;
  if (found) return @NAME@_INPUT_NOT_FINITE;
  for (int round = 0; round < ROUNDS; round++) { /* Newton's method; one round where friction does not depend on u */
    for (int i = 0; i < N; i++) x[@X@ + i + (i < AT ? 0 : K)] = u[i];
    forces_at(tables, 1, x, y);
    for (int i = 0; i < N && !round; i++) {
      wanted[i] = 0.0;
      for (int j = 0; j < N; j++) wanted[i] += mass[N * i + j] * a[j];
      for (int k = 0; k < M && normal_force; k++) wanted[i] -= A[N * k + i] * normal_force[k];
      if (fabs(wanted[i]) > most) most = fabs(wanted[i]);
    }
    double left = 0.0;
    for (int i = 0; i < N; i++) {
      for (int j = 0; j < N; j++) J[i][j] = slope[NU * i + j + (j < AT ? 0 : K)];
      J[i][N] = wanted[i] - Q[i];
      left += J[i][N] * J[i][N];
    }
    left = sqrt(left);
    if (!(left - left == 0.0)) break;
    if (left <= 1e-12 * (1.0 + most)) return @NAME@_OK;
    w = left < before ? 1.0 : 0.5 * w; /* friction that turns over is passed with shorter steps */
    before = left;
    for (int p = 0; p < N; p++) {
      int best = p;
      for (int i = p + 1; i < N; i++) if (fabs(J[i][p]) > fabs(J[best][p])) best = i;
      for (int j = p; j <= N; j++) { const double z = J[p][j]; J[p][j] = J[best][j]; J[best][j] = z; }
      for (int i = 0; i < N; i++) if (i != p) {
        const double s = J[i][p] / J[p][p];
        for (int j = p; j <= N; j++) J[i][j] -= s * J[p][j];
      }
    }
    for (int i = 0; i < N; i++) u[i] += w * J[i][N] / J[i][i];
    if (@AFFINE@) return stored(u, wanted, N);
  }
  for (int i = 0; i < N; i++) u[i] = NAN;
  return @NAME@_STEP_NOT_FOUND;
}

//// monitor
const char *const @NAME@_links[@LINKS@] = {@LINK_NAMES@};

/* the lower triangle of the covariance of filtered torques in free motion: `errors` are those of friction near rest,
   `inertial` is M a, beyond whose largest value errors grow in proportion, both filtered */
static void spread_of(const double *mass, const double *errors, const double *inertial, double S[][@NV@]) {
  enum {N = @NV@};
  static const double accelerations[] = {@ACCELERATIONS@}, forces[] = {@FORCES@};
  static const double largest[] = {@LARGEST@}; /* |M a| of free motion */
  for (int i = 0; i < N; i++) for (int j = 0; j <= i; j++) {
    S[i][j] = i == j ? forces[i] * forces[i] + errors[i] * errors[i] : 0.0;
    for (int k = 0; k < N; k++) S[i][j] += mass[N * i + k] * accelerations[k] * accelerations[k] * mass[N * k + j];
    S[i][j] *= fmax(1.0, fabs(inertial[i]) / largest[i]) * fmax(1.0, fabs(inertial[j]) / largest[j]);
  }
}

/* S = L L^T in the place of S */
static void factored(double S[][@NV@]) {
  for (int j = 0; j < @NV@; j++) for (int i = j; i < @NV@; i++) {
    for (int k = 0; k < j; k++) S[i][j] -= S[i][k] * S[j][k];
    S[i][j] = i == j ? sqrt(S[i][j]) : S[i][j] / S[j][j];
  }
}

/* L^-1 y in the place of y; what is returned is its squared length */
static double whitened(double S[][@NV@], double *y) {
  double square = 0.0;
  for (int i = 0; i < @NV@; i++) {
    for (int k = 0; k < i; k++) y[i] -= S[i][k] * y[k];
    y[i] /= S[i][i];
    square += y[i] * y[i];
  }
  return square;
}

/* what touches the robot since the last sample: the external joint torque, low-pass filtered, the squared Mahalanobis
   distance from free motion, and whether that is over the threshold of @THRESHOLD@. To be called every @PERIOD@ s with
   u of the actuators, which acts from now on; the first call only looks. The state belongs to the caller, zeros at
   first; what is not finite breaks it off, and the next sample begins anew */
int @NAME@_monitor_step(@NAME@_monitor_state *state, const double q[@NQ@], const double v[@NV@], const double u[@NV@],
                      double torque[@NV@], double *distance, int *alarm) {
  enum {N = @NV@, NU = @NU@, K = @MEMORY@, AT = @COLUMN@, M = @CONTACTS@};
  static const double at_rest[] = {@AT_REST@}, fades[] = {@FADES@}; /* errors near rest, and velocities they fade over */
  double x[@ALL@], y[N + N * NU + N * N + M * N + 2 * M], S[N][N], C[N * N], MC[N * N], d = 0.0;
  const double *mass = y + N + N * NU;
  int found = stored(q, x, N) | stored(v, x + N, N) | stored(u, x + 2 * N, N), begun = state->begun;
  (void)MC;
  state->begun = 0;
  *distance = NAN; *alarm = 0;
  for (int i = 0; i < N; i++) torque[i] = NAN;
  if (found) return @NAME@_INPUT_NOT_FINITE;
  for (int i = 0; i < N; i++) { /* in the middle of the step, under the u of its beginning */
    x[i] = 0.5 * (state->q[i] + q[i]); x[N + i] = 0.5 * (state->v[i] + v[i]);
    x[2 * N + i + (i < AT ? 0 : K)] = state->u[i];
    C[i] = (v[i] - state->v[i]) / @PERIOD@;
    state->q[i] = q[i]; state->v[i] = v[i]; state->u[i] = u[i];
  }
  state->begun = 1;
  if (begun) {
    @REMEMBER@
    forces_at(tables, 1, x, y);
    for (int i = 0; i < N; i++) {
      double inertial = 0.0;
      for (int j = 0; j < N; j++) inertial += mass[N * i + j] * C[j];
      state->torque[i] += @SHARE@ * (inertial - y[i] - state->torque[i]);
      state->inertial[i] += @SHARE@ * (inertial - state->inertial[i]);
      double error = at_rest[i] * exp(-fabs(x[N + i]) / fades[i]);
      @UNKNOWN@
      state->errors[i] += @SHARE@ * (error - state->errors[i]);
    }
    spread_of(mass, state->errors, state->inertial, S);
    @OPEN@
    factored(S);
    stored(state->torque, C, N);
    d = whitened(S, C);
  }
  *alarm = d > @THRESHOLD@;
  return stored(state->torque, torque, N) | stored(&d, distance, 1);
}

/* the force (3) without a moment at a point, whose effect J (3, N) on torques y stands between J0 and J1, that leaves
   least of y, its variance, and what it leaves; from the singular values of J over `cut` (one-sided Jacobi rotations,
   Hestenes 1958) */
static double explained(const double *J0, const double *J1, double along, double cut, const double *y, double *force,
                        double *variance) {
  enum {N = @NV@, SWEEPS = 30};
  double J[3][N], V[3][3], left[N], square = 0.0;
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < N; j++) J[i][j] = J0[N * i + j] + along * (J1[N * i + j] - J0[N * i + j]);
    for (int j = 0; j < 3; j++) V[i][j] = i == j;
    force[i] = variance[i] = 0.0;
  }
  for (int sweep = 0, turned = 1; turned && sweep < SWEEPS; sweep++) {
    turned = 0;
    for (int p = 0; p < 2; p++) for (int q = p + 1; q < 3; q++) {
      double a = 0.0, b = 0.0, c = 0.0;
      for (int j = 0; j < N; j++) { a += J[p][j] * J[p][j]; b += J[q][j] * J[q][j]; c += J[p][j] * J[q][j]; }
      if (c * c <= 1e-28 * a * b || a + b <= cut) continue;
      const double z = (b - a) / (2.0 * c), t = (z < 0.0 ? -1.0 : 1.0) / (fabs(z) + sqrt(1.0 + z * z));
      const double cosine = 1.0 / sqrt(1.0 + t * t), sine = cosine * t;
      turned = 1;
      for (int j = 0; j < N; j++) {
        const double w = J[p][j];
        J[p][j] = cosine * w - sine * J[q][j]; J[q][j] = sine * w + cosine * J[q][j];
      }
      for (int j = 0; j < 3; j++) {
        const double w = V[p][j];
        V[p][j] = cosine * w - sine * V[q][j]; V[q][j] = sine * w + cosine * V[q][j];
      }
    }
  }
  for (int j = 0; j < N; j++) left[j] = y[j];
  for (int p = 0; p < 3; p++) {
    double a = 0.0, c = 0.0;
    for (int j = 0; j < N; j++) { a += J[p][j] * J[p][j]; c += J[p][j] * y[j]; }
    if (a <= cut) continue;
    for (int j = 0; j < N; j++) left[j] -= c / a * J[p][j];
    for (int j = 0; j < 3; j++) { force[j] += c / a * V[p][j]; variance[j] += V[p][j] * V[p][j] / a; }
  }
  for (int j = 0; j < N; j++) square += left[j] * left[j];
  return square;
}

/* where on which link a force without a moment explains an external torque at q: least squares in the metric of the
   noise, at points along every link; of those alike the least force, and of forces as large the link nearest to the
   base. Not called by @NAME@_monitor_step: one torque after an alarm is enough */
int @NAME@_monitor_place(const double q[@NQ@], const double torque[@NV@], @NAME@_contact_place *place) {
  enum {N = @NV@, L = @LINKS@, P = @PLACES@};
  static const double usual[] = {@USUAL@}, still[@NV@] = {0.0}, ends[] = {@ENDS@};
  double x[N], y[N], at[N * N + 6 * N * L], S[N][N], force[L * P][3], variance[L * P][3], misfit[L * P], newton[L * P];
  double *J = at + N * N, cut = 0.0, least = HUGE_VAL, smallest = HUGE_VAL;
  const int refuses = stored(q, x, N) | stored(torque, y, N);
  memset(place, 0, sizeof *place);
  place->link = -1;
  for (int i = 0; i < 3; i++) place->point[i] = place->force[i] = place->deviation[i] = NAN;
  if (refuses) return @NAME@_INPUT_NOT_FINITE;
  levers(tables, 1, x, at);
  spread_of(at, usual, still, S);
  factored(S);
  whitened(S, y);
  for (int k = 0; k < 2 * L; k++) {
    double square = 0.0;
    for (int i = 0; i < 3; i++) square += whitened(S, J + N * (3 * k + i));
    cut = fmax(cut, @UNSEEN@ * @UNSEEN@ * square);
  }
  for (int k = 0; k < L * P; k++) {
    const double *J0 = J + 6 * N * (k / P);
    misfit[k] = explained(J0, J0 + 3 * N, (k % P) / (P - 1.0), cut, y, force[k], variance[k]);
    newton[k] = sqrt(force[k][0] * force[k][0] + force[k][1] * force[k][1] + force[k][2] * force[k][2]);
    least = fmin(least, misfit[k] + @EXPLAINED@);
    if (variance[k][0] + variance[k][1] + variance[k][2] == 0.0) misfit[k] = HUGE_VAL; /* it moves no joint */
  }
  for (int k = 0; k < L * P; k++) if (misfit[k] <= least) {
    smallest = fmin(smallest, (1.0 + @SAME@) * newton[k]);
    place->also[k / P] = 1;
  }
  for (int k = L * P - 1; k >= 0; k--) if (misfit[k] <= least && newton[k] <= smallest) {
    place->link = k / P;
    for (int i = 0; i < 3; i++) {
      place->point[i] = ends[3 * (k / P) + i] * (k % P) / (P - 1.0);
      place->force[i] = force[k][i];
      place->deviation[i] = sqrt(variance[k][i]);
    }
  }
  if (place->link < 0) return @NAME@_RESULT_NOT_FINITE;
  place->also[place->link] = 0;
  return @NAME@_OK;
}

//// monitor_memory
if (state->moved) {
      double z[2 * N + K + 1], next[K], other[K];
      for (int k = 0; k < K; k++) z[k] = state->memory[k];
      for (int i = 0; i < N; i++) { z[K + i] = state->middle[i]; z[K + N + i] = x[i]; }
      z[K + 2 * N] = 0.0;
      remember(tables, 1, z, next);
      for (int k = 0; k < K; k++) { z[k] += 1.0 - state->known[k]; state->memory[k] = next[k]; }
      remember(tables, 1, z, other);
      for (int k = 0; k < K; k++) state->known[k] = 1.0 - (other[k] - next[k]);
    }
    for (int i = 0; i < N; i++) state->middle[i] = x[i];
    state->moved = 1;
    for (int k = 0; k < K; k++) x[2 * N + AT + k] = state->memory[k];

//// monitor_unknown
for (int k = 0; k < K; k++) { /* of what friction remembers */
        static const double level[] = {@LEVEL@};
        error += level[K * i + k] * (1.0 - state->known[k]);
      }

//// monitor_open
{ /* what the posterior leaves open: M Cov(a) M */
      double a[@GIVEN@];
      mean_and_terms(tables, 1, x, a);
      covariance_of(tables, a + N, C);
      for (int i = 0; i < N; i++) for (int j = 0; j < N; j++) {
        MC[N * i + j] = 0.0;
        for (int k = 0; k < N; k++) MC[N * i + j] += mass[N * i + k] * C[N * k + j];
      }
      for (int i = 0; i < N; i++) for (int j = 0; j <= i; j++)
        for (int k = 0; k < N; k++) S[i][j] += MC[N * i + k] * mass[N * k + j];
    }

//// components
/* joint forces, a row for each of: @NAMED@ */
int @NAME@_forces(const double q[@NQ@], const double v[@NV@], const double u[@NU@], double force[@PARTS@ * @NV@]) {
  double x[@ALL@], y[@PARTS@ * @NV@];
  if (refused(q, v, u, x, force, @PARTS@ * @NV@)) return @NAME@_INPUT_NOT_FINITE;
  components(tables, 1, x, y);
  return stored(y, force, @PARTS@ * @NV@);
}

//// deviations
/* the same and their standard deviations, zero for laws */
int @NAME@_forces_deviation(const double q[@NQ@], const double v[@NV@], const double u[@NU@],
                          double force[@PARTS@ * @NV@], double deviation[@PARTS@ * @NV@]) {
  enum {P = @PARTS@ * @NV@, T = @TERMS@ * @NV@};
  double x[@ALL@], y[P + @GIVEN_PARTS@], c[T * T];
  if (refused(q, v, u, x, force, P) | refused(q, v, u, x, deviation, P)) return @NAME@_INPUT_NOT_FINITE;
  deviations(tables, 1, x, y);
  covariance_of_parts(tables, y + P, c);
  for (int i = 0; i < P; i++) deviation[i] = 0.0;
  for (int i = 0; i < T; i++) deviation[P - T + i] = c[T * i + i] > 0.0 ? sqrt(c[T * i + i]) : 0.0;
  return stored(y, force, P) | stored(deviation, x, 1);
}

//// linearize
/* the same and its derivatives: jacobian[@COLUMNS@ i + k] = d a_i / d [@STATE@]_k */
int @NAME@_linearize(const double q[@NQ@], const double v[@NV@], const double u[@NU@], double a[@NV@],
                   double jacobian[@NV@ * @COLUMNS@]) {
  double x[@ALL@], y[@NV@ + @NV@ * @COLUMNS@];
  if (refused(q, v, u, x, a, @NV@) | refused(q, v, u, x, jacobian, @NV@ * @COLUMNS@)) return @NAME@_INPUT_NOT_FINITE;
  slopes(tables, 1, x, y);
  return stored(y, a, @NV@) | stored(y + @NV@, jacobian, @NV@ * @COLUMNS@);
}

//// step
/* the state one step later */
int @NAME@_step(const double q[@NQ@], const double v[@NV@], const double u[@NU@], double q_next[@NQ@],
              double v_next[@NV@]) {
  enum {N = @NV@, NQ = @NQ@, NU = @NU@, ROUNDS = 60};
  const double *const *t = tables;
  const double dt = @DT@;
  const long live = 1;
  double x[NQ + N + NU], y[N + N * @COLUMNS@], q1[NQ], v1[N], a[N], q0[NQ], v0[N], m[N], d[N];
  (void)ROUNDS; (void)a; (void)q0; (void)v0; (void)m; (void)d;
  if (refused(q, v, u, x, q_next, NQ) | refused(q, v, u, x, v_next, N)) return @NAME@_INPUT_NOT_FINITE;
  { @STEP@ }
  if (!(stored(q1, q_next, NQ) | stored(v1, v_next, N))) return @NAME@_OK;
  return @IMPLICIT@ && !stored(y, a, N) ? @NAME@_STEP_NOT_FOUND : @NAME@_RESULT_NOT_FINITE;
}

//// step_jacobian
/* K = da along the directions S of (q, v), of which those of u follow; y = [a, da / d(q, v, u)] */
static void along(const double *y, double S[2 * @NV@][3 * @NV@], double K[@NV@][3 * @NV@]) {
  for (int i = 0; i < @NV@; i++) for (int c = 0; c < 3 * @NV@; c++) {
    const double *row = y + @NV@ + 3 * @NV@ * i;
    K[i][c] = c < 2 * @NV@ ? 0.0 : row[c];
    for (int j = 0; j < 2 * @NV@; j++) K[i][c] += row[j] * S[j][c];
  }
}

/* the same and its derivatives in [q, v], A[2 NV i + k], and in u, B[NV i + k] */
int @NAME@_step_jacobian(const double q[@NQ@], const double v[@NV@], const double u[@NU@], double q_next[@NQ@],
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

//// symplectic-euler
    slopes(tables, 1, x, y);
    along(y, S, K);
    for (int i = 0; i < N; i++) for (int c = 0; c < 3 * N; c++) {
      S[N + i][c] += dt * K[i][c]; S[i][c] += dt * S[N + i][c];
    }

//// rk4
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

//// implicit-midpoint
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

//// monitor_state
typedef struct { /* of one robot, zeros at first */
  double q[@NQ@], v[@NV@], u[@NV@], torque[@NV@], errors[@NV@], inertial[@NV@], middle[@NQ@], memory[@MEMORY@ + 1];
  double known[@MEMORY@ + 1]; /* how much of the memory no longer depends on what was before the first sample */
  int begun, moved;
} @NAME@_monitor_state;

enum { @NAME@_LINKS = @LINKS@ };
typedef struct { /* a force in N, world axes, with its standard deviation, at a point of the link in m */
  double point[3], force[3], deviation[3];
  int link, also[@LINKS@]; /* its place in @NAME@_links, -1 for none; 1 for others that explain the torque as well */
} @NAME@_contact_place;
extern const char *const @NAME@_links[@LINKS@];

