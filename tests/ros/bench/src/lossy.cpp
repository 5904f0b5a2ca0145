// SPDX-License-Identifier: MIT OR Apache-2.0

// One end of a stream over a path that loses packets:
//   bench_lossy pub SIZE HZ reliable|best_effort DEPTH     DEPTH 0: KEEP_ALL
//   bench_lossy sub SIZE HZ reliable|best_effort DEPTH
//
// Each says `ready` when it has met the other one. The publisher begins with the first line of its standard input and
// ends with it; the subscription ends with it as well. Then each prints a line of JSON.
//
// A message carries the time at which it was due. If `publish` takes longer than a period, the publisher goes on with
// the newest message that is due, as a timer of rclcpp does, and the messages in between are counted as due.

#include <poll.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cinttypes>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <random>
#include <string>
#include <thread>
#include <unordered_set>
#include <vector>

#include "clock.hpp"
#include "rcl/error_handling.h"
#include "rclcpp/rclcpp.hpp"
#include "std_msgs/msg/u_int8_multi_array.hpp"

namespace
{

using Bytes = std_msgs::msg::UInt8MultiArray;

constexpr uint64_t second = 1'000'000'000;
constexpr uint64_t patience = 60 * second;

// In front of every message.
struct Stamp
{
  uint64_t due;
  uint64_t number;
};

struct Arguments
{
  size_t size;
  double hz;
  bool reliable;
  size_t depth;

  bool keeps_all() const {return depth == 0;}
  // The profile of one implementation goes by the topic's name.
  const char * topic() const {return keeps_all() ? "/bench_keep_all" : "/bench";}
};

rclcpp::QoS qos(const Arguments & arguments)
{
  rclcpp::QoS qos(std::max<size_t>(arguments.depth, 1));
  if (arguments.keeps_all()) {
    qos.keep_all();
  }
  return arguments.reliable ? qos.reliable() : qos.best_effort();
}

// Waits for input until `time`: a line, or its end.
bool has_input(uint64_t time)
{
  pollfd input{STDIN_FILENO, POLLIN, 0};
  const uint64_t now = now_ns();
  const uint64_t left = time > now ? time - now : 0;
  timespec wait{static_cast<time_t>(left / second), static_cast<long>(left % second)};
  return ppoll(&input, 1, &wait, nullptr) > 0;
}

template<typename Count>
bool meet(Count count)
{
  const uint64_t end = now_ns() + patience;
  while (count() == 0) {
    if (now_ns() > end || !rclcpp::ok()) {
      return false;
    }
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
  }
  std::printf("ready\n");
  std::fflush(stdout);
  return true;
}

int publish(rclcpp::Node & node, const Arguments & arguments)
{
  const auto publisher = node.create_publisher<Bytes>(arguments.topic(), qos(arguments));
  if (!meet([&] {return publisher->get_subscription_count();})) {
    return EXIT_FAILURE;
  }
  char line[16];
  if (read(STDIN_FILENO, line, sizeof(line)) <= 0) {
    return EXIT_FAILURE;
  }
  Bytes message;
  message.data.resize(arguments.size);
  // No compression makes it shorter.
  std::mt19937 random;  // NOLINT: the same bytes in every run
  for (auto & byte : message.data) {
    byte = static_cast<uint8_t>(random());
  }
  const auto period = static_cast<uint64_t>(1e9 / arguments.hz);
  const uint64_t begin = now_ns();
  uint64_t published = 0;
  uint64_t longest = 0;
  uint64_t next = 0;
  while (!has_input(begin + next * period)) {
    const uint64_t before = now_ns();
    const uint64_t number = std::max(next, (before - begin) / period);
    const Stamp stamp{begin + number * period, number};
    std::memcpy(message.data.data(), &stamp, sizeof(stamp));
    try {
      publisher->publish(message);
      ++published;
    } catch (const rclcpp::exceptions::RCLError &) {
      // A history that is full for too long refuses it.
      rcl_reset_error();
    }
    longest = std::max(longest, now_ns() - before);
    next = number + 1;
  }
  const uint64_t due = std::max(next, (now_ns() - begin) / period);
  std::printf(
    "{\"due\": %" PRIu64 ", \"published\": %" PRIu64 ", \"longest_publish_ms\": %.3f}\n", due,
    published, static_cast<double>(longest) / 1e6);
  std::fflush(stdout);
  // What is under way is still sent until this process is ended.
  std::this_thread::sleep_for(std::chrono::nanoseconds(patience));
  return EXIT_SUCCESS;
}

int subscribe(const rclcpp::Node::SharedPtr & node, const Arguments & arguments)
{
  std::vector<double> ages;
  std::unordered_set<uint64_t> numbers;
  uint64_t repeated = 0;
  const auto subscription = node->create_subscription<Bytes>(
    arguments.topic(), qos(arguments), [&](const Bytes & message) {
      const uint64_t now = now_ns();
      Stamp stamp{};
      std::memcpy(&stamp, message.data.data(), sizeof(stamp));
      if (numbers.insert(stamp.number).second) {
        ages.push_back(static_cast<double>(now - stamp.due) / 1e6);
      } else {
        ++repeated;
      }
    });
  if (!meet([&] {return subscription->get_publisher_count();})) {
    return EXIT_FAILURE;
  }
  rclcpp::executors::SingleThreadedExecutor executor;
  executor.add_node(node);
  std::thread until_end([&] {
      while (!has_input(now_ns() + second)) {}
      executor.cancel();
    });
  executor.spin();
  until_end.join();
  std::printf("{\"repeated\": %" PRIu64 ", \"ages_ms\": [", repeated);
  for (size_t i = 0; i < ages.size(); ++i) {
    std::printf("%s%.3f", i == 0 ? "" : ", ", ages[i]);
  }
  std::printf("]}\n");
  std::fflush(stdout);
  return EXIT_SUCCESS;
}

}  // namespace

int main(int argc, char ** argv)
{
  if (argc != 6) {
    std::fprintf(stderr, "bench_lossy: see the head of lossy.cpp\n");
    return 2;
  }
  const Arguments arguments{
    static_cast<size_t>(std::atol(argv[2])), std::atof(argv[3]),
    std::string("reliable") == argv[4], static_cast<size_t>(std::atol(argv[5]))};
  if (arguments.size < sizeof(Stamp) || arguments.hz <= 0) {
    std::fprintf(stderr, "bench_lossy: SIZE is at least %zu, HZ above 0\n", sizeof(Stamp));
    return 2;
  }
  rclcpp::init(argc, argv);
  const std::string role = argv[1];
  auto node = std::make_shared<rclcpp::Node>("bench_" + role);
  const int status = role == "pub" ? publish(*node, arguments) : subscribe(node, arguments);
  rclcpp::shutdown();
  return status;
}
