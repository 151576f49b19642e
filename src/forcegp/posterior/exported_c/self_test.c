/* Stored states and what forcegp computed for them; exit code 1 where this program computes something else. */
#include "@NAME@.h"
#include <math.h>
#include <stdio.h>

static int failures = 0;
static void compare(const char *what, const double *found, const double *wanted, int count, double bound) {
  double most = 0.0;
  for (int k = 0; k < count; k++) {
    const double apart = fabs(found[k] - wanted[k]);
    if (!(apart <= most)) most = apart; /* also NaN */
  }
  if (!(most <= bound)) {
    failures++;
    printf("%s differs by %g, more than %g\n", what, most, bound);
  }
}
@STORED@
int main(void) {
@CALLS@
  printf(failures ? "%d failures\n" : "%d failures: all as stored\n", failures);
  return failures != 0;
}
