"""Sums of squared exponentials about shared centres as machine code, which stores nothing but what is asked for."""

from __future__ import annotations

import ctypes

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.codegen.cpp_library import cpp_library

LANES = 8
"""Centres that are worked on at once; their number is filled up to a multiple with weights of zero."""

# exp(x) = 2^k exp(r) with |r| <= log(2) / 2 and the Taylor series of exp(r) to degree 13, whose remainder there is
# below 5e-18; log(2) in two parts (Cody & Waite, "Software Manual for the Elementary Functions", 1980). Below -708 it
# is 0.
SOURCE = r"""
#include <cstdint>
#include <cstring>
#define EACH for (int g = 0; g < B; ++g)
#ifdef __AVX512F__
constexpr int LANES = 8;
#else
constexpr int LANES = 4;
#endif
typedef double V __attribute__((vector_size(8 * LANES)));
typedef int64_t I __attribute__((vector_size(8 * LANES)));

constexpr double TAYLOR[] = {1.0 / 479001600.0, 1.0 / 39916800.0, 1.0 / 3628800.0, 1.0 / 362880.0, 1.0 / 40320.0,
                             1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0};

// several at once, so that none waits for the result before
template <int B> static inline __attribute__((always_inline)) void exponentials(const V *x, V *result) {
  const V low = V{} - 708.0, high = V{} + 709.0;
  const V shifter = V{} + 6755399441055744.0;      // 1.5 * 2^52: adding it rounds to an integer
  V biased[B], r[B], p[B];
  EACH {
    const V upper = x[g] < high ? x[g] : high, bounded = upper > low ? upper : low;
    biased[g] = bounded * 1.4426950408889634 + shifter;
    const V k = biased[g] - shifter;
    r[g] = (bounded - k * 6.93147180369123816490e-01) - k * 1.90821492927058770002e-10;
    p[g] = V{} + 1.0 / 6227020800.0;
  }
  for (int i = 0; i < 13; ++i) EACH p[g] = p[g] * r[g] + TAYLOR[i];
  EACH {
    I bits, value;
    memcpy(&bits, &biased[g], sizeof(V));
    memcpy(&value, &p[g], sizeof(V));
    value += bits << 52;                           // k joins the exponent of p
    V scaled;
    memcpy(&scaled, &value, sizeof(V));
    result[g] = x[g] > low ? scaled : V{};
  }
}

template <int B> static void block(long d, long centers, const double *in, const double *table, const double *own,
                                   const double *weights, double *mean, double *cross, long valid) {
  V sum[B] = {};
  const long width = d + 1;
  for (long j = 0; j < centers; j += LANES) {
    V e[B], k[B];
    EACH e[g] = *(const V *)(own + g * centers + j) + in[g * width + d];
    for (long i = 0; i < d; ++i) {
      const V z = *(const V *)(table + i * centers + j);
      EACH e[g] += in[g * width + i] * z;
    }
    exponentials<B>(e, k);
    EACH sum[g] += *(const V *)(weights + g * centers + j) * k[g];
    const long left = valid - j < LANES ? valid - j : LANES;       // the rest only fills up
    if (cross && left > 0) EACH memcpy(cross + g * valid + j, &k[g], left * sizeof(double));
  }
  EACH { mean[g] = 0.0; for (int l = 0; l < LANES; ++l) mean[g] += sum[g][l]; }
}

extern "C" void sums(long states, long latents, long d, long centers, long valid, const double *table,
                     const double *own, const double *weights, const double *in, double *mean, double *cross) {
  for (long s = 0; s < states; ++s)
    for (long first = 0; first < latents; first += 8) {
      const double *x = in + (s * latents + first) * (d + 1), *o = own + first * centers;
      const double *w = weights + first * centers;
      double *m = mean + s * latents + first, *k = cross ? cross + (s * latents + first) * valid : nullptr;
      switch (latents - first) {
        case 1: block<1>(d, centers, x, table, o, w, m, k, valid); break;
        case 2: block<2>(d, centers, x, table, o, w, m, k, valid); break;
        case 3: block<3>(d, centers, x, table, o, w, m, k, valid); break;
        case 4: block<4>(d, centers, x, table, o, w, m, k, valid); break;
        case 5: block<5>(d, centers, x, table, o, w, m, k, valid); break;
        case 6: block<6>(d, centers, x, table, o, w, m, k, valid); break;
        case 7: block<7>(d, centers, x, table, o, w, m, k, valid); break;
        default: block<8>(d, centers, x, table, o, w, m, k, valid);
      }
    }
}
"""


class CompiledSums:
    """E f_c = sum_j w_cj k_c(z, z_j) of latents that share their centres, on the CPU.

    `centers`, `own` and the inputs are those of `SharedCenters`.
    """

    def __init__(self, centers: Float[Tensor, "N d"], own: Float[Tensor, "G N"], weights: Float[Tensor, "G N"]) -> None:
        self._made_of = centers, own, weights
        valid = weights.shape[1]
        filled = -valid % LANES
        table = centers.mT

        def aligned(values: Tensor) -> Tensor:
            rows = torch.nn.functional.pad(values, (0, filled)).contiguous()
            held = torch.empty(rows.numel() + LANES, dtype=torch.float64)
            start = (-held.data_ptr() // 8) % LANES
            held[start : start + rows.numel()] = rows.flatten()
            return held[start : start + rows.numel()]

        self._held = aligned(table), aligned(own), aligned(weights)
        self.latents, self.valid = len(weights), valid
        self._head = (self.latents, len(table), valid + filled, valid, *(x.data_ptr() for x in self._held))
        self._sums = cpp_library(SOURCE, "sums").sums
        self._sums.restype = None
        self._sums.argtypes = [ctypes.c_long] * 5 + [ctypes.c_void_p] * 6

    def __reduce__(self) -> tuple[type[CompiledSums], tuple[Tensor, Tensor, Tensor]]:
        return CompiledSums, self._made_of  # addresses mean nothing in another process

    def __call__(
        self, inputs: Float[Tensor, "n _"], keep: bool
    ) -> tuple[Float[Tensor, "n G"], Float[Tensor, "n G N"] | None]:
        """The sums, and where asked for the kernel functions themselves; without a graph."""
        inputs = inputs.contiguous()
        mean = torch.empty(len(inputs), self.latents, dtype=torch.float64)
        cross = torch.empty(len(inputs), self.latents, self.valid, dtype=torch.float64) if keep else None
        self._sums(
            len(inputs), *self._head, inputs.data_ptr(), mean.data_ptr(), None if cross is None else cross.data_ptr()
        )
        return mean, cross
