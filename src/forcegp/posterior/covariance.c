
static APART void @COVARIANCE@(const double *const *t, const double *y, double *out) {
  enum {N = @ROWS@, C = @LATENTS@, K = @RANK@};
  const double *W = y, *d = y + N * C;
  double P[C * K], Q[N * K];
  memset(P, 0, sizeof P);
  @ROOTS@
  memset(Q, 0, sizeof Q);
  for (int a = 0; a < N; a++) for (int c = 0; c < C; c++) for (int r = 0; r < K; r += LANES)
    STORE(Q + a * K + r, LOAD(Q + a * K + r) + W[a * C + c] * LOAD(P + c * K + r));
  for (int a = 0; a < N; a++) for (int b = 0; b <= a; b++) {
    const double *x = Q + a * K, *z = Q + b * K;
    real s = R(0.0), s1 = s, s2 = s, s3 = s; /* no addition waits for the one before */
    double prior = 0.0;
    int r = 0;
    for (; r + 3 * LANES < K; r += 4 * LANES) {
      s += LOAD(x + r) * LOAD(z + r);
      s1 += LOAD(x + r + LANES) * LOAD(z + r + LANES);
      s2 += LOAD(x + r + 2 * LANES) * LOAD(z + r + 2 * LANES);
      s3 += LOAD(x + r + 3 * LANES) * LOAD(z + r + 3 * LANES);
    }
    for (; r < K; r += LANES) s += LOAD(x + r) * LOAD(z + r);
    s = (s + s1) + (s2 + s3);
    for (int c = 0; c < C; c++) prior += W[a * C + c] * d[c] * W[b * C + c];
    prior = @WIDENED@ * (prior - TOTAL(s));
    out[a * N + b] = prior; out[b * N + a] = prior; /* the same place with one joint */
  }
}
