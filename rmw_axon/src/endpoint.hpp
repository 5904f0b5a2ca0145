// SPDX-License-Identifier: MIT OR Apache-2.0

// The objects behind publishers, subscriptions, servers and clients.

#ifndef ENDPOINT_HPP_
#define ENDPOINT_HPP_

#include <array>
#include <cstdint>
#include <memory>
#include <mutex>
#include <string>
#include <unordered_map>

#include "axon.h"
#include "cdr/plan.hpp"
#include "context.hpp"
#include "features.hpp"
#include "rmw/event.h"
#include "rmw/types.h"
#include "rosidl_runtime_c/message_type_support_struct.h"
#include "rosidl_runtime_c/service_type_support_struct.h"

namespace rmw_axon
{

// One event of an endpoint, to which the data of an rmw_event_t point. It lasts as long as its endpoint.
struct EventSource
{
  axon_event_t handle{};
};

// The requested events of an endpoint.
class EventSources
{
public:
  ~EventSources();

  // Returns the event of a kind; `make` creates it at the first request.
  template<typename Make>
  EventSource & of(rmw_event_type_t kind, Make make)
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    auto & source = sources_.at(static_cast<size_t>(kind));
    if (!source) {
      auto made = std::make_unique<EventSource>();
      made->handle = make();
      source = std::move(made);
    }
    return *source;
  }

private:
  std::mutex mutex_;
  std::array<std::unique_ptr<EventSource>, AXON_RMW_LAST_EVENT + 1> sources_;
};

struct Publisher
{
  rmw_publisher_t rmw{};
  axon_publisher_t handle{};
  axon_gid_t gid{};
  rmw_qos_profile_t qos{};
  cdr::Plan plan;
  std::string topic;
  std::string label;
  EventSources events;
  // Lent messages, by their address.
  std::mutex loans_mutex;
  std::unordered_map<void *, axon_loan_t> loans;

  ~Publisher();
};

struct Subscription
{
  rmw_subscription_t rmw{};
  axon_subscription_t handle{};
  axon_gid_t gid{};
  rmw_qos_profile_t qos{};
  cdr::Plan plan;
  std::string topic;
  std::string label;
  EventSources events;
  // Lent messages, by their address: a sample in place, or 0 for a copy.
  std::mutex loans_mutex;
  std::unordered_map<void *, axon_sample_t> loans;

  ~Subscription();
};

struct Service
{
  rmw_service_t rmw{};
  axon_server_t handle{};
  rmw_qos_profile_t qos{};
  cdr::ServicePlans plans;
  std::string name;
  std::string label;

  ~Service();
};

struct Client
{
  rmw_client_t rmw{};
  axon_client_t handle{};
  axon_gid_t gid{};
  rmw_qos_profile_t qos{};
  cdr::ServicePlans plans;
  std::string name;
  std::string label;

  ~Client();
};

// Returns the name of an endpoint in error texts: topic /scan (node /robot/lidar)
std::string label(const char * what, const char * name, const Node & node);

// Returns the object behind rmw's handle, after the checks that every function must make.
Publisher & publisher_of(const rmw_publisher_t * publisher);
Subscription & subscription_of(const rmw_subscription_t * subscription);
Service & service_of(const rmw_service_t * service);
Client & client_of(const rmw_client_t * client);

// Names in a new endpoint's options, which all kinds of endpoints set in the same way. The options point to
// them.
struct EndpointNames
{
  std::string name;
  std::string type;
  std::array<uint8_t, 32> hash{};
};

axon_endpoint_options_t endpoint_options(
  EndpointNames & names, const rmw_qos_profile_t & profile,
  const rosidl_message_type_support_t * type_support);
axon_endpoint_options_t endpoint_options(
  EndpointNames & names, const rmw_qos_profile_t & profile,
  const rosidl_service_type_support_t * type_support);

// A taken message in place, and its information.
class Taken
{
public:
  Taken() = default;
  ~Taken();
  Taken(const Taken &) = delete;
  Taken & operator=(const Taken &) = delete;

  explicit operator bool() const {return sample.id != 0;}

  // Gives the sample up without releasing it.
  axon_sample_t keep();

  axon_sample_t sample{};
  const uint8_t * data = nullptr;
  size_t size = 0;
  axon_message_info_t info{};
};

}  // namespace rmw_axon

#endif  // ENDPOINT_HPP_
