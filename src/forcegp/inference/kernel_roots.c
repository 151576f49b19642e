
static APART void @NAME@_roots(const double *t, const double *F, const double *z, double *restrict P) {
  const long n = (long)t[0]; double k[@LATENTS@ * @BLOCK@];
  for (long first = 0; first < n; first += @BLOCK@) {
    const long count = n - first < @BLOCK@ ? n - first : @BLOCK@;
    @NAME@_kernels(t, z, first, count, k);
    for (long g = 0; g < @LATENTS@; g++) for (long j = 0; j < count; j += 4) {
      const double *f = F + (g * n + first + j) * @RANK@, *w = k + g * @BLOCK@ + j; double *p = P + g * @RANK@;
      for (long r = 0; r < @RANK@; r += LANES)
        STORE(p + r, LOAD(p + r) + ((w[0] * LOAD(f + r) + w[1] * LOAD(f + @RANK@ + r))
                                    + (w[2] * LOAD(f + 2 * @RANK@ + r) + w[3] * LOAD(f + 3 * @RANK@ + r))));
    }
  }
}
