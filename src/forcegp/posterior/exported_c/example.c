/* The robot moves from a state of the training data for a second under constant forces: Euler's method, 1 ms. */
#include "@NAME@.h"
#include <stdio.h>

int main(void) {
  double q[@NQ@] = {@START_Q@};
  double v[@NV@] = {@START_V@};
  const double u[@NU@] = {@START_U@};
  const double dt = 0.001;
  double a[@NV@];

  for (int step = 0; step <= 1000; step++) {
    const int found = @NAME@_mean(q, v, u, a);
    if (found) {
      fprintf(stderr, "after %d steps @NAME@_mean reports %d, see @NAME@.h\n", step, found);
      return 1;
    }
    if (step % 100 == 0) {
      printf("%.1f s  q =", step * dt);
      for (int j = 0; j < @NQ@; j++) printf(" %8.4f", q[j]);
      printf("\n");
    }
@ADVANCE@  }
  return 0;
}
