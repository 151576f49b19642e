
static void @NAME@(const double *table, real s, real *f, real *slope) {
  const double *p = table + 8, *bucket = p + (int)table[5], *row[LANES];
  const int knots = (int)table[0], buckets = 2 * knots;
  const double *knot = bucket + buckets + 1;
  for (int k = 0; k < LANES; ++k) {
    const double place = (AT(s, k) - table[6]) * table[7];
    const int b = place >= buckets ? buckets - 1 : place > 0.0 ? (int)place : 0;
    int low = (int)bucket[b], high = (int)bucket[b + 1]; /* as many knots are <= s as rows stand before its own */
    while (low < high) { const int m = (low + high) / 2; if (AT(s, k) < knot[m]) high = m; else low = m + 1; }
    row[k] = knot + knots + (int)table[4] * low; (void)row;
  }
  @CURVES@
  @DISTANCES@
  for (int k = 0; k < LANES; ++k) { @AWAY@ }
  @DECAYS@
  for (int r = 0; r < (int)table[1]; ++r) {
    const double *c = p + @RATES@ + @ENVELOPES@ * r;
    real @NUMBERS@;
    for (int k = 0; k < LANES; ++k) { @COEFFICIENTS@ }
    @SIDES@
    f[r] = @VALUE@;
    if (slope) slope[r] = @SLOPE@;
  }
}
