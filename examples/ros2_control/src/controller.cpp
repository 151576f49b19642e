// ros2_control: effort commands from positions and velocities, for references on ~/reference.
#include <memory>
#include <string>
#include <vector>

#include "controller_interface/controller_interface.hpp"
#include "forcegp_controller/computed_torque.hpp"
#include "pluginlib/class_list_macros.hpp"
#include "realtime_tools/realtime_buffer.hpp"
#include "trajectory_msgs/msg/joint_trajectory_point.hpp"

namespace forcegp_controller {

using CallbackReturn = controller_interface::CallbackReturn;
using Point = trajectory_msgs::msg::JointTrajectoryPoint;
constexpr std::size_t JOINTS = std::tuple_size_v<model::Velocities>;

class Controller : public controller_interface::ControllerInterface {
 public:
  CallbackReturn on_init() override {
    auto_declare<std::vector<std::string>>("joints", {});
    for (const auto *name : {"stiffness", "damping", "effort_limits"}) auto_declare<std::vector<double>>(name, {});
    return CallbackReturn::SUCCESS;
  }

  controller_interface::InterfaceConfiguration command_interface_configuration() const override {
    return named({"effort"});
  }

  controller_interface::InterfaceConfiguration state_interface_configuration() const override {
    return named({"position", "velocity"});
  }

  CallbackReturn on_configure(const rclcpp_lifecycle::State &) override {
    joints_ = get_node()->get_parameter("joints").as_string_array();
    Gains gains;
    if (joints_.size() != JOINTS || !taken("stiffness", gains.stiffness) || !taken("damping", gains.damping) ||
        !taken("effort_limits", gains.limits)) {
      RCLCPP_ERROR(get_node()->get_logger(),
                   "joints, stiffness, damping and effort_limits need %zu entries each, in the order of the exported "
                   "header",
                   JOINTS);
      return CallbackReturn::ERROR;
    }
    controller_ = ComputedTorque(gains);
    subscription_ = get_node()->create_subscription<Point>(
        "~/reference", rclcpp::SystemDefaultsQoS(), [this](std::shared_ptr<Point> point) {
          const bool whole = point->positions.size() == JOINTS && point->velocities.size() == JOINTS &&
                             point->accelerations.size() == JOINTS;
          if (whole) reference_.writeFromNonRT(point);
        });
    return CallbackReturn::SUCCESS;
  }

  CallbackReturn on_activate(const rclcpp_lifecycle::State &) override {
    controller_.restart();
    reference_.writeFromNonRT(nullptr);
    hold_ = read(0, 2);
    return CallbackReturn::SUCCESS;
  }

  controller_interface::return_type update(const rclcpp::Time &, const rclcpp::Duration &) override {
    const auto q = read(0, 2), v = read(1, 2);
    auto q_d = hold_;
    model::Velocities v_d{}, a_d{};
    if (const auto point = *reference_.readFromRT()) {
      std::copy_n(point->positions.begin(), JOINTS, q_d.begin());
      std::copy_n(point->velocities.begin(), JOINTS, v_d.begin());
      std::copy_n(point->accelerations.begin(), JOINTS, a_d.begin());
    }
    const auto found = controller_.step(q, v, q_d, v_d, a_d);
    for (std::size_t i = 0; i < JOINTS; i++) (void)command_interfaces_[i].set_value(found.value[i]);
    return found ? controller_interface::return_type::OK : controller_interface::return_type::ERROR;
  }

 private:
  controller_interface::InterfaceConfiguration named(const std::vector<std::string> &kinds) const {
    controller_interface::InterfaceConfiguration wanted{controller_interface::interface_configuration_type::INDIVIDUAL,
                                                        {}};
    for (const auto &joint : joints_)
      for (const auto &kind : kinds) wanted.names.push_back(joint + "/" + kind);
    return wanted;
  }

  bool taken(const std::string &name, model::Velocities &to) {
    const auto given = get_node()->get_parameter(name).as_double_array();
    if (given.size() != JOINTS) return false;
    std::copy(given.begin(), given.end(), to.begin());
    return true;
  }

  model::Velocities read(std::size_t first, std::size_t stride) const {
    model::Velocities x{};
    for (std::size_t i = 0; i < JOINTS; i++) x[i] = state_interfaces_[first + stride * i].get_value();
    return x;
  }

  std::vector<std::string> joints_;
  ComputedTorque controller_;
  model::Positions hold_{};
  realtime_tools::RealtimeBuffer<std::shared_ptr<Point>> reference_;
  rclcpp::Subscription<Point>::SharedPtr subscription_;
};

}  // namespace forcegp_controller

PLUGINLIB_EXPORT_CLASS(forcegp_controller::Controller, controller_interface::ControllerInterface)
