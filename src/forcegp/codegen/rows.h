#if LANES >= 4
typedef double quad __attribute__((vector_size(32), aligned(8), may_alias));
typedef long long quad_bits __attribute__((vector_size(32)));
#if defined(__clang__)
#define MIX(x, y, ...) __builtin_shufflevector(x, y, __VA_ARGS__)
#else
#define MIX(x, y, ...) __builtin_shuffle(x, y, (quad_bits){__VA_ARGS__})
#endif
/* transposes; the last four columns may overlap those before */
#define EACH_TILE for (int k = 0; k < LANES; k += 4) \
  for (int j = 0, c = 0; j < size; j += 4, c = j + 4 < size ? j : size - 4)
INLINE quad_bits turn(const double *from, long above, double *to, long below) { /* true where finite */
#define ROW(l) (*(const quad *)(from + l * above))
  const quad a = MIX(ROW(0), ROW(1), 0, 4, 2, 6), b = MIX(ROW(0), ROW(1), 1, 5, 3, 7);
  const quad c = MIX(ROW(2), ROW(3), 0, 4, 2, 6), d = MIX(ROW(2), ROW(3), 1, 5, 3, 7);
  *(quad *)to = MIX(a, c, 0, 1, 4, 5);
  *(quad *)(to + below) = MIX(b, d, 0, 1, 4, 5);
  *(quad *)(to + 2 * below) = MIX(a, c, 2, 3, 6, 7);
  *(quad *)(to + 3 * below) = MIX(b, d, 2, 3, 6, 7);
  return (a - a == 0.0) & (b - b == 0.0) & (c - c == 0.0) & (d - d == 0.0);
}
#define WHOLE(stride) (live == LANES && size >= 4 && (stride))
#endif
/* rows of `stride` numbers to lanes; those that no state lives in repeat the last. Returns what is not finite */
static APART int rows_read(const double *p, long stride, int size, long live, real *x) {
  int found = 0;
#if LANES >= 4
  if (WHOLE(stride)) {
    quad_bits finite = ~(quad_bits){0};
    EACH_TILE finite &= turn(p + k * stride + c, stride, (double *)(x + c) + k, LANES);
    return !(finite[0] & finite[1] & finite[2] & finite[3]);
  }
#endif
  for (int k = 0; k < LANES; k++) for (int j = 0; j < size; j++) {
    const double value = p[(k < live ? k : live - 1) * stride + j];
    AT(x[j], k) = value; found |= !(value - value == 0.0);
  }
  return found;
}
static APART int rows_write(const real *y, int size, long live, double *p, long stride) {
  int found = 0;
#if LANES >= 4
  if (WHOLE(stride)) {
    quad_bits finite = ~(quad_bits){0};
    EACH_TILE finite &= turn((const double *)(y + c) + k, LANES, p + k * stride + c, stride);
    return !(finite[0] & finite[1] & finite[2] & finite[3]);
  }
#endif
  for (int k = 0; k < live; k++) for (int j = 0; j < size; j++) {
    const double value = AT(y[j], k);
    p[k * stride + j] = value; found |= !(value - value == 0.0);
  }
  return found;
}
