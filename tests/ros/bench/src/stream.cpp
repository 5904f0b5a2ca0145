// SPDX-License-Identifier: MIT OR Apache-2.0

// One publisher, one subscription, messages of one size:
//   bench_stream pub bytes|fixed SIZE HZ SECONDS     HZ 0: as fast as it goes; SECONDS 0: until it is killed
//   bench_stream sub bytes|fixed SIZE                until the publisher says that it is done
//   bench_stream first bytes SIZE SPAWNED            until the first message; SPAWNED: when it was started, in ns
//
// `bytes` is a sequence, which is published as it is; `fixed` an array, which is lent by the middleware. The publisher
// writes the whole message, stamps it, publishes it. A line of JSON at the end says what was measured.

#include <algorithm>
#include <array>
#include <chrono>
#include <cinttypes>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "axon_bench/msg/fixed1024.hpp"
#include "axon_bench/msg/fixed1048576.hpp"
#include "axon_bench/msg/fixed4194304.hpp"
#include "axon_bench/msg/fixed64.hpp"
#include "axon_bench/msg/fixed65536.hpp"
#include "clock.hpp"
#include "rclcpp/rclcpp.hpp"
#include "std_msgs/msg/u_int8_multi_array.hpp"

namespace
{

using Bytes = std_msgs::msg::UInt8MultiArray;

constexpr const char * topic = "/bench";
constexpr uint64_t second = 1'000'000'000;

// In front of every message.
struct Stamp
{
  uint64_t time;    // 0 in the messages after the last one
  uint64_t number;
};

struct Arguments
{
  std::string role;
  size_t size;
  double hz;
  double seconds;
  uint64_t spawned;
};

rclcpp::QoS qos() {return rclcpp::QoS(10);}

// Writes a whole message: its last byte says which one it is.
void write(uint8_t * data, size_t size, Stamp stamp)
{
  std::memset(data, static_cast<int>(stamp.number & 0xff), size);
  stamp.time = stamp.time == 0 ? 0 : now_ns();
  std::memcpy(data, &stamp, sizeof(stamp));
}

template<typename M>
class Publisher
{
public:
  Publisher(rclcpp::Node & node, size_t size)
  : publisher_(node.create_publisher<M>(topic, qos())), size_(size)
  {
    if constexpr (std::is_same_v<M, Bytes>) {
      message_.data.resize(size);
    }
  }

  size_t readers() const {return publisher_->get_subscription_count();}

  void publish(Stamp stamp)
  {
    if constexpr (std::is_same_v<M, Bytes>) {
      write(message_.data.data(), size_, stamp);
      publisher_->publish(message_);
    } else {
      auto loan = publisher_->borrow_loaned_message();
      write(loan.get().data.data(), size_, stamp);
      publisher_->publish(std::move(loan));
    }
  }

private:
  typename rclcpp::Publisher<M>::SharedPtr publisher_;
  size_t size_;
  Bytes message_;
};

void sleep_until(uint64_t time)
{
  const uint64_t now = now_ns();
  if (time > now) {
    std::this_thread::sleep_for(std::chrono::nanoseconds(time - now));
  }
}

template<typename M>
int publish(rclcpp::Node & node, const Arguments & arguments)
{
  Publisher<M> publisher(node, arguments.size);
  const bool endless = arguments.seconds == 0;
  const uint64_t patience = now_ns() + 60 * second;
  while (!endless && publisher.readers() == 0) {
    if (now_ns() > patience || !rclcpp::ok()) {
      return EXIT_FAILURE;
    }
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
  }
  std::this_thread::sleep_for(std::chrono::milliseconds(endless ? 0 : 500));

  const uint64_t period = arguments.hz > 0 ? static_cast<uint64_t>(1e9 / arguments.hz) : 0;
  const uint64_t begin = now_ns();
  const uint64_t end = endless ? UINT64_MAX : begin + static_cast<uint64_t>(arguments.seconds * 1e9);
  const uint64_t cpu = cpu_ns();
  uint64_t number = 0;
  for (uint64_t next = begin; rclcpp::ok() && now_ns() < end; ++number) {
    if (period != 0) {
      next += period;
      sleep_until(next);
    }
    publisher.publish({1, number});
  }
  const double took = static_cast<double>(now_ns() - begin) / 1e9;
  std::printf(
    "{\"sent\": %" PRIu64 ", \"seconds\": %.6f, \"cpu_s\": %.6f}\n", number, took,
    static_cast<double>(cpu_ns() - cpu) / 1e9);
  std::fflush(stdout);
  for (int i = 0; i < 10; ++i) {
    std::this_thread::sleep_for(std::chrono::milliseconds(50));
    publisher.publish({0, number});
  }
  return EXIT_SUCCESS;
}

// What a subscription has seen.
struct Seen
{
  std::vector<uint64_t> latencies;
  uint64_t wrong = 0;
  uint64_t begin = 0;
  uint64_t end = 0;
  uint64_t cpu_at_begin = 0;
  uint64_t cpu_at_end = 0;
  bool done = false;
};

void take(const uint8_t * data, size_t size, Seen & seen)
{
  const uint64_t now = now_ns();
  Stamp stamp{};
  std::memcpy(&stamp, data, sizeof(stamp));
  if (stamp.time == 0) {
    seen.done = true;
    return;
  }
  if (size > sizeof(stamp) && data[size - 1] != (stamp.number & 0xff)) {
    ++seen.wrong;
  }
  if (seen.begin == 0) {
    seen.begin = now;
    seen.cpu_at_begin = cpu_ns();
  }
  seen.end = now;
  seen.latencies.push_back(now - stamp.time);
}

void report(Seen & seen)
{
  const size_t received = seen.latencies.size();
  // The first tenth warms up.
  std::vector<uint64_t> latencies(seen.latencies.begin() + static_cast<long>(received / 10), seen.latencies.end());
  std::sort(latencies.begin(), latencies.end());
  const auto quantile = [&](double part) {
      return latencies.empty() ? 0.0 :
             static_cast<double>(latencies[static_cast<size_t>(part * static_cast<double>(latencies.size() - 1))]) / 1e3;
    };
  std::printf(
    "{\"received\": %zu, \"wrong\": %" PRIu64 ", \"seconds\": %.6f, \"cpu_s\": %.6f, "
    "\"p50_us\": %.2f, \"p99_us\": %.2f, \"max_us\": %.2f}\n",
    received, seen.wrong, static_cast<double>(seen.end - seen.begin) / 1e9,
    static_cast<double>(seen.cpu_at_end - seen.cpu_at_begin) / 1e9,
    quantile(0.5), quantile(0.99), quantile(1.0));
}

template<typename M>
int subscribe(rclcpp::Node::SharedPtr node, const Arguments & arguments)
{
  Seen seen;
  seen.latencies.reserve(4'000'000);
  rclcpp::executors::SingleThreadedExecutor executor;
  const bool first = arguments.role == "first";
  auto subscription = node->create_subscription<M>(
    topic, qos(), [&](const M & message) {
      take(message.data.data(), message.data.size(), seen);
      if (first || seen.done) {
        seen.cpu_at_end = cpu_ns();
        executor.cancel();
      }
    });
  executor.add_node(node);
  executor.spin();
  if (first) {
    std::printf("{\"first_ms\": %.3f}\n", static_cast<double>(seen.end - arguments.spawned) / 1e6);
  } else {
    report(seen);
  }
  return EXIT_SUCCESS;
}

template<typename M>
int run(const Arguments & arguments)
{
  auto node = std::make_shared<rclcpp::Node>("bench_" + arguments.role);
  return arguments.role == "pub" ? publish<M>(*node, arguments) : subscribe<M>(node, arguments);
}

int run_fixed(const Arguments & arguments)
{
  using namespace axon_bench::msg;  // NOLINT
  switch (arguments.size) {
    case 64: return run<Fixed64>(arguments);
    case 1024: return run<Fixed1024>(arguments);
    case 65536: return run<Fixed65536>(arguments);
    case 1048576: return run<Fixed1048576>(arguments);
    case 4194304: return run<Fixed4194304>(arguments);
    default:
      std::fprintf(stderr, "no fixed type of %zu bytes\n", arguments.size);
      return 2;
  }
}

}  // namespace

int main(int argc, char ** argv)
{
  if (argc < 4 || std::atol(argv[3]) < static_cast<long>(sizeof(Stamp))) {
    std::fprintf(stderr, "bench_stream pub|sub|first bytes|fixed SIZE ...\n");
    return 2;
  }
  Arguments arguments{argv[1], static_cast<size_t>(std::atol(argv[3])), 0, 0, 0};
  if (arguments.role == "pub" && argc == 6) {
    arguments.hz = std::atof(argv[4]);
    arguments.seconds = std::atof(argv[5]);
  } else if (arguments.role == "first" && argc == 5) {
    arguments.spawned = std::strtoull(argv[4], nullptr, 10);
  } else if (arguments.role != "sub" || argc != 4) {
    std::fprintf(stderr, "bench_stream: see the head of stream.cpp\n");
    return 2;
  }
  rclcpp::init(argc, argv);
  const bool fixed = std::string("fixed") == argv[2];
  const int status = fixed ? run_fixed(arguments) : run<Bytes>(arguments);
  rclcpp::shutdown();
  return status;
}
