/* @NAME@.h with types of fixed size, for C++17: no allocation, no exceptions. */
#pragma once
#include <array>
#include "@NAME@.h"

namespace @NAME@ {

template <int size>
using Vector = std::array<double, size>;
using Positions = Vector<@NQ@>;
using Velocities = Vector<@NV@>; /* and accelerations, joint forces, u of the actuators */
using Inputs = Vector<@NU@>;     /* u with what friction remembers and switches of contacts */
using Memory = Vector<@MEMORY@>;
using NormalForces = Vector<@CONTACTS@>;

struct Result { /* the value, and @NAME@_OK or bits of what was wrong */
  Velocities value{};
  int status = @NAME@_OK;
  explicit operator bool() const { return status == @NAME@_OK; }
};

inline Result forward_dynamics(const Positions &q, const Velocities &v, const Inputs &u) {
  Result found;
  found.status = @NAME@_mean(q.data(), v.data(), u.data(), found.value.data());
  return found;
}
@CPP@
}  // namespace @NAME@
