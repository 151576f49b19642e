// What the controller needs of ROS 2, by the names of its packages, for a compiler without ROS.
#pragma once
#include <cstdio>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#define RCLCPP_ERROR(logger, ...) (void)(logger), std::fprintf(stderr, __VA_ARGS__)
#define PLUGINLIB_EXPORT_CLASS(Own, Base) std::unique_ptr<Base> create() { return std::make_unique<Own>(); }

namespace rclcpp {
struct Time {};
struct Duration {};
struct SystemDefaultsQoS {};
template <class T>
struct Subscription {
  using SharedPtr = std::shared_ptr<Subscription>;
  std::function<void(std::shared_ptr<T>)> callback;
};
}  // namespace rclcpp
namespace rclcpp_lifecycle {
struct State {};
}  // namespace rclcpp_lifecycle
namespace trajectory_msgs::msg {
struct JointTrajectoryPoint {
  std::vector<double> positions, velocities, accelerations;
};
}  // namespace trajectory_msgs::msg
namespace realtime_tools {
template <class T>
struct RealtimeBuffer {
  T value{};
  void writeFromNonRT(const T &given) { value = given; }
  T *readFromRT() { return &value; }
};
}  // namespace realtime_tools

struct Parameter {
  std::vector<std::string> words;
  std::vector<double> numbers;
  std::vector<std::string> as_string_array() const { return words; }
  std::vector<double> as_double_array() const { return numbers; }
};
struct Node {
  std::map<std::string, Parameter> parameters;
  std::function<void(std::shared_ptr<trajectory_msgs::msg::JointTrajectoryPoint>)> publish;
  Parameter get_parameter(const std::string &name) { return parameters[name]; }
  int get_logger() { return 0; }
  template <class T, class Callback>
  typename rclcpp::Subscription<T>::SharedPtr create_subscription(const std::string &, rclcpp::SystemDefaultsQoS,
                                                                  Callback callback) {
    publish = callback;
    return std::make_shared<rclcpp::Subscription<T>>();
  }
};

namespace controller_interface {
enum class CallbackReturn { SUCCESS, ERROR };
enum class return_type { OK, ERROR };
enum class interface_configuration_type { ALL, INDIVIDUAL, NONE };
struct InterfaceConfiguration {
  interface_configuration_type type;
  std::vector<std::string> names;
};
struct Interface {
  double value = 0.0;
  double get_value() const { return value; }
  bool set_value(double given) { return value = given, true; }
};
class ControllerInterface {
 public:
  virtual ~ControllerInterface() = default;
  virtual CallbackReturn on_init() = 0;
  virtual InterfaceConfiguration command_interface_configuration() const = 0;
  virtual InterfaceConfiguration state_interface_configuration() const = 0;
  virtual CallbackReturn on_configure(const rclcpp_lifecycle::State &) = 0;
  virtual CallbackReturn on_activate(const rclcpp_lifecycle::State &) = 0;
  virtual return_type update(const rclcpp::Time &, const rclcpp::Duration &) = 0;
  std::shared_ptr<Node> get_node() const { return node_; }
  template <class T>
  void auto_declare(const std::string &, const T &) {}
  std::vector<Interface> command_interfaces_, state_interfaces_;

 private:
  std::shared_ptr<Node> node_ = std::make_shared<Node>();
};
}  // namespace controller_interface
