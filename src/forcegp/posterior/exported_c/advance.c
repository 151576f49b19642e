//// added
    for (int j = 0; j < @NV@; j++) {
      v[j] += dt * a[j];
      q[j] += dt * v[j];
    }
//// turned
    double from[@NQ@], step[@NV@];
    for (int j = 0; j < @NQ@; j++) from[j] = q[j];
    for (int j = 0; j < @NV@; j++) {
      v[j] += dt * a[j];
      step[j] = dt * v[j];
    }
    @NAME@_integrate(from, step, q);
