// u = M (a_d + Kd (v_d - v) + Kp (q_d - q)) + h - friction, by the program that `forcegp export --to c` wrote.
// No allocation, no exceptions: it runs in the control loop.
#pragma once
#include <algorithm>
#include <cmath>

#include "model.hpp"  // written by CMake: the exported header, and `namespace model`

namespace forcegp_controller {

struct Gains {
  model::Velocities stiffness{}, damping{}, limits{};  // 1/s^2, 1/s, Nm or N
};

class ComputedTorque {
 public:
  explicit ComputedTorque(const Gains &gains = {}) : gains_(gains) {}

  void restart() {
    memory_ = {};
    begun_ = false;
  }

  // The torques at (q, v) for a reference; the last ones where there are none, with a status that says why.
  model::Result step(const model::Positions &q, const model::Velocities &v, const model::Positions &q_d,
                     const model::Velocities &v_d, const model::Velocities &a_d) {
#ifdef FORCEGP_REMEMBERS
    if (begun_) memory_ = model::remember(memory_, before_, q, 0.0);
#endif
    before_ = q;
    begun_ = true;
    model::Velocities a{};
    for (std::size_t i = 0; i < a.size(); i++)
      a[i] = a_d[i] + gains_.damping[i] * (v_d[i] - v[i]) + gains_.stiffness[i] * (q_d[i] - q[i]);
    // at the measured velocity dry friction would follow noise
    model::Result found = model::inverse_dynamics(q, v_d, a, {}, memory_);
    if (!found) {
      found.value = last_;
      return found;
    }
    for (std::size_t i = 0; i < a.size(); i++)
      found.value[i] = std::clamp(found.value[i], -gains_.limits[i], gains_.limits[i]);
    last_ = found.value;
    return found;
  }

 private:
  Gains gains_;
  model::Velocities last_{};
  model::Positions before_{};
  model::Memory memory_{};
  bool begun_ = false;
};

}  // namespace forcegp_controller
