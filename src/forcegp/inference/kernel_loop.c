//// summed
static APART void @NAME@(const double *t, long live, const real *z, real *f) {
  const long n = (long)t[0]; const double *rows = t + 8;
  (void)live;
  @OPERANDS@
  @STARTS@
  for (long j = 0; j < n; j += @STEP@) {
    @ROWS@
    @NODES@
    @WEIGHTS@
    @SUMS@
  }
  @ENDS@
}
//// kept
static APART void @NAME@(const double *t, const double *z, long first, long count, double *k) {
  const long n = (long)t[0]; const double *rows = t + 8;
  @OPERANDS@
  for (long j = first; j < first + count; j += @STEP@) {
    @ROWS@
    @NODES@
    @KEPT@
  }
}
