#include <math.h>
#include <string.h>
#define LANES @LANES@
typedef double real __attribute__((vector_size(8 * LANES)));
typedef long long bits __attribute__((vector_size(8 * LANES)));
#define AT(x, k) ((x)[k])
#define R(c) ((c) + (real){0})
#define APART __attribute__((noinline, unused))
#define INLINE static inline __attribute__((always_inline, unused))
typedef real unaligned __attribute__((aligned(8), may_alias));
#define LOAD(p) (*(const unaligned *)(p))
#define STORE(p, x) (*(unaligned *)(p) = (x))
#define EACH for (int k = 0; k < LANES; k++)
#define WHERE(m, x, y) ((real)(((m) & (bits)(x)) | (~(m) & (bits)(y))))
INLINE int any(bits m) { int found = 0; EACH found |= m[k] != 0; return found; }
INLINE double TOTAL(real x) { double sum = 0.0; EACH sum += x[k]; return sum; }
INLINE real r_less(real x, real y) { return (real)((x < y) & (bits)R(1.0)); }
INLINE real r_at_most(real x, real y) { return (real)((x <= y) & (bits)R(1.0)); }
INLINE real r_equal(real x, real y) { return (real)((x == y) & (bits)R(1.0)); }
INLINE real r_choose(real m, real x, real y) { const bits b = m != 0.0; return WHERE(b, x, y); }
INLINE real r_absolute(real x) { return (real)((bits)x & 0x7fffffffffffffffLL); }
INLINE real r_abs(real x) { return r_absolute(x); }
INLINE real r_sqrt(real x) { real y; EACH y[k] = sqrt(x[k]); return y; }
static APART real by_lane(double (*f)(double), real x) { real y; EACH y[k] = f(x[k]); return y; }
INLINE real r_power(real x, real y) { real z; EACH z[k] = y[k] == 2.0 ? x[k] * x[k] : pow(x[k], y[k]); return z; }
INLINE real r_atan2(real x, real y) { real z; EACH z[k] = atan2(x[k], y[k]); return z; }
#define SHIFTER 6755399441055744.0 /* 1.5 * 2^52: adding it rounds to an integer */
/* 2^k and exp(r) - 1 of x = k log 2 + r */
INLINE real reduced_exp(real x, real *power) {
  const real biased = x * 1.4426950408889634 + SHIFTER, k = biased - SHIFTER;
  const real r = (x - k * 6.93147180369123816490e-01) - k * 1.90821492927058770002e-10;
  *power = (real)(((bits)biased << 52) + (bits)R(1.0));
  return r * @EXPM1@;
}
INLINE real r_exp(real x) {
  const real low = R(-708.0), high = R(709.0), bounded = WHERE(x > low, WHERE(x < high, x, high), low);
  real power; const real p = reduced_exp(bounded, &power);
  const real y = WHERE(x > low, p * power + power, R(0.0));
  return WHERE(x == x, WHERE(x > R(709.7), R(INFINITY), y), x);
}
INLINE real r_expm1(real x) {
  const real low = R(-708.0), high = R(709.0), bounded = WHERE(x > low, WHERE(x < high, x, high), low);
  real power; const real p = reduced_exp(bounded, &power), y = p * power + (power - 1.0);
  return WHERE(x == x, WHERE(x > R(709.7), R(INFINITY), y), x);
}
static APART real r_tanh(real x) {
  const real a = r_absolute(x), bounded = WHERE(a < 22.0, a, R(22.0)), e = r_expm1(2.0 * bounded), y = e / (e + 2.0);
  return WHERE(x == x, WHERE(x < 0.0, -y, y), x);
}
static APART real r_log(real x) {
  if (any(~((x > 1e-290) & (x < 1e290)))) return by_lane(log, x);
  const bits offset = (bits)x - 0x3fe6a09e667f3bcdLL, e = offset >> 52; /* m in [sqrt(1/2), sqrt(2)) */
  const real m = (real)((bits)x - (e << 52)), f = m - 1.0, s = f / (2.0 + f), z = s * s;
  const real n = (real)((e + 1023) + 0x4330000000000000LL) - 4503599627371519.0; /* 2^52 + 1023: e as a real */
  return n * 6.93147180369123816490e-01 + (2.0 * s + (s * z * @ATANH@ + n * 1.90821492927058770002e-10));
}
static APART real r_log1p(real x) {
  if (any(~(r_absolute(x) < 1e290))) return by_lane(log1p, x);
  const real u = 1.0 + x;
  return r_log(u) + (x - (u - 1.0)) / u;
}
static APART real r_asinh(real x) {
  const real a = r_absolute(x);
  if (any(~(a < 1e100))) return by_lane(asinh, x);
  const real y = r_log1p(a + a * a / (1.0 + r_sqrt(1.0 + a * a)));
  return WHERE(x < 0.0, -y, y);
}
INLINE real turned(real x, int quarter) {
  const real biased = x * 0.6366197723675814 + SHIFTER, k = biased - SHIFTER;
  const real r = ((x - k * 1.5707963267341256) - k * 6.077100506303966e-11) - k * 2.0222662487959506e-21;
  const real z = r * r, s = r * @SIN@, c = @COS@;
  const bits n = (bits)biased + quarter;
  const real y = WHERE((n & 1) == 0, s, c);
  return (real)((bits)y ^ ((n & 2) << 62));
}
/* inline, and the rare case last: so the compiler computes what sine and cosine of one argument share only once */
INLINE real r_sin(real x) { const real y = turned(x, 0); return any(~(r_absolute(x) < 1e5)) ? by_lane(sin, x) : y; }
INLINE real r_cos(real x) { const real y = turned(x, 1); return any(~(r_absolute(x) < 1e5)) ? by_lane(cos, x) : y; }
