//// symplectic-euler

      @PROGRAM@(t, live, x, y);
      for (int j = 0; j < N; j++) { a[j] = y[j]; v1[j] = x[N + j] + dt * y[j]; q1[j] = x[j] + dt * v1[j]; }
//// symplectic-euler-on-a-manifold

      real z[NQ + N];
      @PROGRAM@(t, live, x, y);
      for (int j = 0; j < NQ; j++) z[j] = x[j];
      for (int j = 0; j < N; j++) { a[j] = y[j]; v1[j] = x[NQ + j] + dt * y[j]; z[NQ + j] = dt * v1[j]; }
      moved(t, live, z, q1);
//// rk4-on-a-manifold

      const double c[4] = {0.0, 0.5 * dt, 0.5 * dt, dt}, b[4] = {dt / 6.0, dt / 3.0, dt / 3.0, dt / 6.0};
      real z[NQ + N], p[2 * N], r[N], sum[N]; /* r is the rate of the step from q that z holds */
      for (int j = 0; j < NQ; j++) z[j] = x[j];
      for (int j = 0; j < N; j++) { v0[j] = v1[j] = r[j] = x[NQ + j]; sum[j] = y[j] = R(0.0); }
      for (int s = 0; s < 4; s++) {
        for (int j = 0; j < N; j++) { p[j] = z[NQ + j] = c[s] * r[j]; p[N + j] = x[NQ + j] = v0[j] + c[s] * y[j]; }
        if (s) { moved(t, live, z, x); step_rate(t, live, p, r); }
        @PROGRAM@(t, live, x, y);
        for (int j = 0; j < N; j++) {
          if (!s) a[j] = y[j];
          sum[j] += b[s] * r[j]; v1[j] += b[s] * y[j];
        }
      }
      for (int j = 0; j < N; j++) z[NQ + j] = sum[j];
      moved(t, live, z, q1);
//// rk4

      const double c[4] = {0.0, 0.5 * dt, 0.5 * dt, dt}, b[4] = {dt / 6.0, dt / 3.0, dt / 3.0, dt / 6.0};
      for (int j = 0; j < N; j++) { q0[j] = q1[j] = x[j]; v0[j] = v1[j] = x[N + j]; y[j] = R(0.0); }
      for (int s = 0; s < 4; s++) {
        for (int j = 0; j < N; j++) { x[j] = q0[j] + c[s] * x[N + j]; x[N + j] = v0[j] + c[s] * y[j]; }
        @PROGRAM@(t, live, x, y);
        for (int j = 0; j < N; j++) {
          if (!s) a[j] = y[j];
          q1[j] += b[s] * x[N + j]; v1[j] += b[s] * y[j];
        }
      }
//// implicit-midpoint

      const double h = 0.5 * dt;
      double length[LANES]; int done[LANES];
      for (int j = 0; j < N; j++) { q0[j] = x[j]; v0[j] = m[j] = x[N + j]; d[j] = R(0.0); }
      for (int k = 0; k < LANES; k++) { length[k] = 1.0; done[k] = 0; }
      @PROGRAM@(t, live, x, y);
      for (int j = 0; j < N; j++) a[j] = y[j];
      for (int round = 0; round < ROUNDS; round++) {
        for (int j = 0; j < N; j++) { x[j] = q0[j] + h * m[j]; x[N + j] = m[j]; }
        @PROGRAM@(t, live, x, y);
        int left = 0;
        for (int k = 0; k < live; k++) {
          double J[N][N], r[N], turned = 0.0, size = 0.0, step = 0.0, all = 0.0;
          if (done[k]) continue;
          for (int i = 0; i < N; i++) {
            r[i] = -(AT(m[i], k) - AT(v0[i], k) - h * AT(y[i], k));
            for (int j = 0; j < N; j++)
              J[i][j] = (i == j) - h * (AT(y[N + @COLUMNS@ * i + N + j], k) + h * AT(y[N + @COLUMNS@ * i + j], k));
          }
          for (int p = 0; p < N; p++) {
            int best = p;
            for (int i = p + 1; i < N; i++) if (fabs(J[i][p]) > fabs(J[best][p])) best = i;
            for (int j = 0; j < N; j++) { const double z = J[p][j]; J[p][j] = J[best][j]; J[best][j] = z; }
            const double z = r[p]; r[p] = r[best]; r[best] = z;
            for (int i = p + 1; i < N; i++) {
              const double w = J[i][p] / J[p][p];
              for (int j = p; j < N; j++) J[i][j] -= w * J[p][j];
              r[i] -= w * r[p];
            }
          }
          for (int i = N - 1; i >= 0; i--) {
            for (int j = i + 1; j < N; j++) r[i] -= J[i][j] * r[j];
            r[i] /= J[i][i];
          }
          for (int i = 0; i < N; i++) {
            turned += r[i] * AT(d[i], k); size += AT(d[i], k) * AT(d[i], k);
            step += r[i] * r[i]; all += AT(m[i], k) * AT(m[i], k);
          }
          if (turned < -0.5 * size && length[k] > 1e-4) { /* beyond the root: go back on the same step */
            const double shorter = fmin(fmax(1.0 / (1.0 - turned / size), 0.1), 0.5) * length[k];
            for (int i = 0; i < N; i++) AT(m[i], k) += (shorter - length[k]) * AT(d[i], k);
            length[k] = shorter;
          } else {
            for (int i = 0; i < N; i++) { AT(d[i], k) = r[i]; AT(m[i], k) += r[i]; }
            length[k] = 1.0;
            done[k] = sqrt(step) <= 1e-9 * (1.0 + sqrt(all));
          }
          left |= !done[k];
        }
        if (!left) break;
      }
      for (int j = 0; j < N; j++) { q1[j] = q0[j] + dt * m[j]; v1[j] = 2.0 * m[j] - v0[j]; }
      for (int k = 0; k < live; k++) if (!done[k]) AT(v1[0], k) = NAN;
