// A controller manager of one controller: rows of q, v, q_d, v_d, a_d on stdin, efforts on stdout.
#include "stubs.hpp"

std::unique_ptr<controller_interface::ControllerInterface> create();

int main() {
  const auto controller = create();
  const auto node = controller->get_node();
  controller->on_init();
  if (controller->on_configure({}) != controller_interface::CallbackReturn::ERROR) return 3;  // nothing is given yet
  node->parameters["joints"].words = {"pan", "lift", "bend"};
  node->parameters["stiffness"].numbers = {100.0, 100.0, 100.0};
  node->parameters["damping"].numbers = {20.0, 20.0, 20.0};
  node->parameters["effort_limits"].numbers = {3.0, 3.0, 3.0};
  if (controller->on_configure({}) != controller_interface::CallbackReturn::SUCCESS) return 4;
  if (controller->state_interface_configuration().names[3] != "lift/velocity") return 5;
  controller->command_interfaces_.resize(controller->command_interface_configuration().names.size());
  controller->state_interfaces_.resize(controller->state_interface_configuration().names.size());
  double x[15];
  for (bool begun = false;; begun = true) {
    for (double &value : x)
      if (std::scanf("%lf", &value) != 1) return 0;
    for (std::size_t i = 0; i < 3; i++) {
      controller->state_interfaces_[2 * i].value = x[i];
      controller->state_interfaces_[2 * i + 1].value = x[3 + i];
    }
    if (!begun) controller->on_activate({});
    node->publish(std::make_shared<trajectory_msgs::msg::JointTrajectoryPoint>(
        trajectory_msgs::msg::JointTrajectoryPoint{{x + 6, x + 9}, {x + 9, x + 12}, {x + 12, x + 15}}));
    if (controller->update({}, {}) != controller_interface::return_type::OK) return 6;
    for (const auto &command : controller->command_interfaces_) std::printf("%.17g ", command.value);
    std::printf("\n");
  }
}
