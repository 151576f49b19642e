
/* q, v, u and dt of every motion to its q, v, a, and the row at which it stopped */
int evaluate(long first, long last, const double *const *t, const double *start_q, long s0, const double *start_v, long s1,
             const double *u, long s2, const double *seconds, long s3, double *Q, long r0, double *V, long r1, double *A,
             long r2, double *ended, long r3) {
  enum {N = @JOINTS@, NQ = @POSITIONS@, NU = @GIVEN@, M = @MEMORY@, FIRST = NQ + N + @COLUMN@, ROUNDS = 60};
  const double dt = seconds[0];
  const long steps = r2 / N;
  (void)s0; (void)s1; (void)s2; (void)s3; (void)r0; (void)r1; (void)r3;
  real x[NQ + N + NU], y[@OUTPUTS@], q1[NQ], v1[N], a[N], q0[NQ], v0[N], m[N], d[N], z[M + 1], w[M + 2 * NQ + 1];
  (void)q0; (void)v0; (void)m; (void)d; (void)z; (void)w;
  for (long i = first; i < last; i += LANES) {
    const long live = last - i < LANES ? last - i : LANES;
    int going = 0;
    for (int k = 0; k < LANES; k++) {
      const long row = k < live ? i + k : last - 1;
      for (int j = 0; j < NQ; j++) {
        AT(x[j], k) = start_q[row * NQ + j];
        if (k < live) Q[row * (steps + 1) * NQ + j] = AT(x[j], k);
      }
      for (int j = 0; j < N; j++) {
        AT(x[NQ + j], k) = start_v[row * N + j];
        if (k < live) V[row * (steps + 1) * N + j] = AT(x[NQ + j], k);
      }
      if (k < live) { ended[row] = -1; going |= 1 << k; }
    }
    long stopped = 0;
    for (long s = 0; s < steps && going; s++) {
      stopped = s + 1;
      rows_read(u + (i * steps + s) * NU, steps * NU, NU, live, x + NQ + N);
      for (int j = 0; j < M && s; j++) x[FIRST + j] = z[j];
      real qs[NQ], vs[N];
      for (int j = 0; j < NQ; j++) qs[j] = x[j];
      for (int j = 0; j < N; j++) vs[j] = x[NQ + j];
      { @STEP@ }
      for (int j = 0; j < M; j++) w[j] = x[FIRST + j];
      for (int j = 0; j < NQ && M; j++) { w[M + j] = qs[j]; w[M + NQ + j] = q1[j]; }
      w[M + 2 * NQ * (M > 0)] = R(dt);
      @REMEMBER@
      real fast = R(0.0), none = R(0.0);
      for (int j = 0; j < N; j++) fast += v1[j] * v1[j];
      for (int j = 0; j < NQ; j++) none += q1[j] - q1[j];
      int usual = going == (1 << live) - 1;
      for (int k = 0; k < live; k++) usual &= AT(fast, k) <= @LIMIT@ * @LIMIT@ && AT(none, k) == 0.0;
      if (usual) {
        for (int j = 0; j < NQ; j++) x[j] = q1[j];
        for (int j = 0; j < N; j++) x[NQ + j] = v1[j];
        rows_write(q1, NQ, live, Q + (i * (steps + 1) + s + 1) * NQ, (steps + 1) * NQ);
        rows_write(v1, N, live, V + (i * (steps + 1) + s + 1) * N, (steps + 1) * N);
        rows_write(a, N, live, A + (i * steps + s) * N, steps * N);
        continue;
      }
      for (int k = 0; k < live; k++) {
        double *to_q = Q + ((i + k) * (steps + 1) + s + 1) * NQ, *to_v = V + ((i + k) * (steps + 1) + s + 1) * N;
        int finite = 1, slow = 1;
        const int before = going >> k & 1;
        for (int j = 0; j < NQ; j++) finite &= AT(q1[j], k) - AT(q1[j], k) == 0.0;
        for (int j = 0; j < N; j++) {
          finite &= AT(v1[j], k) - AT(v1[j], k) == 0.0;
          slow &= fabs(AT(v1[j], k)) <= @LIMIT@;
          A[((i + k) * steps + s) * N + j] = before ? AT(a[j], k) : NAN;
        }
        if (before && !(finite && slow)) { going &= ~(1 << k); ended[i + k] = finite ? s + 1 : -2 - (s + 1); }
        const int on = going >> k & 1;
        for (int j = 0; j < NQ; j++) {
          AT(x[j], k) = on ? AT(q1[j], k) : AT(qs[j], k); /* where it stopped the program can be asked */
          to_q[j] = on ? AT(q1[j], k) : NAN;
        }
        for (int j = 0; j < N; j++) {
          AT(x[NQ + j], k) = on ? AT(v1[j], k) : AT(vs[j], k);
          to_v[j] = on ? AT(v1[j], k) : NAN;
        }
      }
    }
    for (int k = 0; k < live; k++) for (long s = stopped; s < steps; s++) {
      for (int j = 0; j < NQ; j++) Q[((i + k) * (steps + 1) + s + 1) * NQ + j] = NAN;
      for (int j = 0; j < N; j++) {
        V[((i + k) * (steps + 1) + s + 1) * N + j] = A[((i + k) * steps + s) * N + j] = NAN;
      }
    }
  }
  return 0;
}
