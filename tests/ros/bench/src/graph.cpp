// SPDX-License-Identifier: MIT OR Apache-2.0

// One of many processes that are started at once:
//   bench_graph INDEX COUNT
//
// A node with a publisher and a subscription on a topic of all. Says when its graph has all COUNT of them, and stays until
// its standard input ends.

#include <cinttypes>
#include <cstdio>
#include <cstdlib>
#include <chrono>
#include <memory>
#include <string>

#include "clock.hpp"
#include "rclcpp/rclcpp.hpp"
#include "std_msgs/msg/u_int8_multi_array.hpp"

int main(int argc, char ** argv)
{
  if (argc != 3) {
    std::fprintf(stderr, "bench_graph INDEX COUNT\n");
    return 2;
  }
  const size_t count = std::strtoul(argv[2], nullptr, 10);
  rclcpp::init(argc, argv);
  {
    using Message = std_msgs::msg::UInt8MultiArray;
    constexpr const char * topic = "/everybody";
    auto node = std::make_shared<rclcpp::Node>(std::string("bench_") + argv[1]);
    auto publisher = node->create_publisher<Message>(topic, 10);
    auto subscription = node->create_subscription<Message>(topic, 10, [](const Message &) {});
    const auto whole = [&] {
        return node->count_publishers(topic) == count && node->count_subscribers(topic) == count &&
               node->get_node_names().size() == count;
      };
    auto event = node->get_graph_event();
    while (rclcpp::ok() && !whole()) {
      node->wait_for_graph_change(event, std::chrono::milliseconds(500));
      event->check_and_clear();
    }
    std::printf("%" PRIu64 "\n", now_ns());
    std::fflush(stdout);
    while (std::getchar() != EOF) {
    }
  }
  rclcpp::shutdown();
  return EXIT_SUCCESS;
}
