// SPDX-License-Identifier: Apache-2.0
// A node that takes the models of an identifier, checks each, and keeps the last one that is good
// enough: the C++ side of ctsid_ros/examples/tuner_node.py.
//
//   model_consumer --ros-args -p inputs:="[torque]" -p outputs:="[rate]"
//
// Remap identifier/model if the identifier has another name.
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/string.hpp>

#include "model_message.hpp"

class ModelConsumer : public rclcpp::Node
{
public:
  ModelConsumer()
  : Node("model_consumer")
  {
    using Names = std::vector<std::string>;
    limits_.inputs = declare_parameter<Names>("inputs", Names{"torque"});
    limits_.outputs = declare_parameter<Names>("outputs", Names{"rate"});
    limits_.vague = declare_parameter("vague", limits_.vague);
    limits_.fit = declare_parameter("fit", limits_.fit);
    limits_.fresh_fit = declare_parameter("fresh_fit", limits_.fresh_fit);
    limits_.age = declare_parameter("age", limits_.age);
    const auto latched = rclcpp::QoS(1).reliable().transient_local();
    verdict_ = create_publisher<std_msgs::msg::String>("~/verdict", latched);
    models_ = create_subscription<std_msgs::msg::String>(
      "identifier/model", latched,
      [this](const std_msgs::msg::String & message) {take(message.data);});
  }

private:
  // A model that fails any step changes nothing: the last good one stays.
  void take(const std::string & text)
  {
    try {
      auto model = ctsid_example::decode(text);
      const auto why = ctsid_example::objection(model, now().nanoseconds(), limits_);
      if (!why.empty()) {
        tell("Refused: " + why);
        return;
      }
      good_ = std::move(model);
      tell("Accepted: " + good_->reason);
      // Design with *good_ here; then ask objection() once more, for the design took its time.
    } catch (const std::runtime_error & error) {
      tell(std::string("Refused: ") + error.what());
    }
  }

  void tell(const std::string & sentence)
  {
    RCLCPP_INFO(get_logger(), "%s", sentence.c_str());
    std_msgs::msg::String message;
    message.data = sentence;
    verdict_->publish(message);
  }

  ctsid_example::Limits limits_;
  std::optional<ctsid_example::Model> good_;
  rclcpp::Publisher<std_msgs::msg::String>::SharedPtr verdict_;
  rclcpp::Subscription<std_msgs::msg::String>::SharedPtr models_;
};

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<ModelConsumer>());
  rclcpp::shutdown();
  return 0;
}
