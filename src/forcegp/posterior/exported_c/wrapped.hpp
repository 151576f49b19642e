//// inverse_dynamics
/* u of the actuators for an acceleration, as @NAME@_inverse_dynamics */
inline Result inverse_dynamics(const Positions &q, const Velocities &v, const Velocities &a,
                               const NormalForces &normal_force = {}, const Memory &memory = {}) {
  Result found;
  found.status = @NAME@_inverse_dynamics(q.data(), v.data(), a.data(), normal_force.data(), memory.data(),
                                         found.value.data());
  return found;
}

//// components
/* each force by itself, as @NAME@_forces: @NAMED@ */
inline int forces(const Positions &q, const Velocities &v, const Inputs &u,
                  std::array<Velocities, @PARTS@> &force) {
  return @NAME@_forces(q.data(), v.data(), u.data(), force.front().data());
}

//// remember
/* what friction remembers after the joints went from q to q_next in dt seconds */
inline Memory remember(const Memory &memory, const Positions &q, const Positions &q_next, double dt) {
  Memory next{};
  @NAME@_remember(memory.data(), q.data(), q_next.data(), dt, next.data());
  return next;
}

//// monitor
/* a monitor of contacts, called every @PERIOD@ s, as @NAME@_monitor_step */
class Monitor {
 public:
  struct State {
    Velocities torque{};
    double distance = 0.0;
    bool alarm = false;
    int status = @NAME@_OK;
  };
  State step(const Positions &q, const Velocities &v, const Velocities &u) {
    State found;
    int alarm = 0;
    found.status = @NAME@_monitor_step(&state_, q.data(), v.data(), u.data(), found.torque.data(), &found.distance,
                                       &alarm);
    found.alarm = alarm != 0;
    return found;
  }
  void restart() { state_ = {}; }
  /* where a torque comes from, as @NAME@_monitor_place; link is -1 where that is not known */
  static @NAME@_contact_place place(const Positions &q, const Velocities &torque) {
    @NAME@_contact_place found;
    @NAME@_monitor_place(q.data(), torque.data(), &found);
    return found;
  }

 private:
  @NAME@_monitor_state state_{};
};

