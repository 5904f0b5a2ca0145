// SPDX-License-Identifier: MIT OR Apache-2.0

#include "trace.hpp"

#include <chrono>
#include <cstring>

// The tracepoints of the distribution's tracetools, as tracetools.cmake found them: whether tracetools exists
// and records, whether rmw_publish has a timestamp, and whether there are tracepoints of clients and
// services.
#ifndef AXON_TRACE
#define AXON_TRACE 0
#endif
#ifndef AXON_TRACE_TIMESTAMP
#define AXON_TRACE_TIMESTAMP 0
#endif
#ifndef AXON_TRACE_SERVICES
#define AXON_TRACE_SERVICES 0
#endif

#if AXON_TRACE
#include "tracetools/tracetools.h"
#endif

namespace rmw_axon::trace
{

namespace
{

#if AXON_TRACE
// A GID as tracetools reads it: 16 bytes, up to tracetools 8.3 24.
struct Gid
{
  explicit Gid(const axon_gid_t & gid)
  {
    std::memcpy(bytes, gid.bytes, sizeof(gid.bytes));
  }

  uint8_t bytes[24] = {};
};
#endif

#if AXON_TRACE_TIMESTAMP || AXON_TRACE_SERVICES
// Returns the time of the clock that AXON_TIME_NOW uses.
int64_t now()
{
  const auto since_epoch = std::chrono::system_clock::now().time_since_epoch();
  return std::chrono::duration_cast<std::chrono::nanoseconds>(since_epoch).count();
}
#endif

}  // namespace

void publisher_created([[maybe_unused]] const Publisher & publisher)
{
#if AXON_TRACE
  ros_trace_rmw_publisher_init(&publisher.rmw, Gid(publisher.gid).bytes);
#endif
}

void subscription_created([[maybe_unused]] const Subscription & subscription)
{
#if AXON_TRACE
  ros_trace_rmw_subscription_init(&subscription.rmw, Gid(subscription.gid).bytes);
#endif
}

void client_created([[maybe_unused]] const Client & client)
{
#if AXON_TRACE_SERVICES
  ros_trace_rmw_client_init(&client.rmw, Gid(client.gid).bytes);
#endif
}

int64_t publish(
  [[maybe_unused]] const Publisher & publisher, [[maybe_unused]] const void * message)
{
#if AXON_TRACE_TIMESTAMP
  if (ros_trace_enabled_rmw_publish()) {
    const int64_t timestamp = now();
    ros_trace_do_rmw_publish(&publisher.rmw, message, timestamp);
    return timestamp;
  }
#elif AXON_TRACE
  ros_trace_rmw_publish(message);
#endif
  return AXON_TIME_NOW;
}

void send_request(
  [[maybe_unused]] const Client & client, [[maybe_unused]] const void * request,
  [[maybe_unused]] int64_t sequence)
{
#if AXON_TRACE_SERVICES
  ros_trace_rmw_send_request(&client.rmw, request, sequence);
#endif
}

int64_t send_response(
  [[maybe_unused]] const Service & service, [[maybe_unused]] const void * response,
  [[maybe_unused]] const axon_gid_t & client, [[maybe_unused]] int64_t sequence)
{
#if AXON_TRACE_SERVICES
  if (ros_trace_enabled_rmw_send_response()) {
    const int64_t timestamp = now();
    ros_trace_do_rmw_send_response(
      &service.rmw, response, Gid(client).bytes, sequence, timestamp);
    return timestamp;
  }
#endif
  return AXON_TIME_NOW;
}

template<>
Take<Subscription>::~Take()
{
#if AXON_TRACE
  ros_trace_rmw_take(&endpoint_.rmw, message_, taken_.info.source_timestamp, delivered_);
#endif
}

template<>
Take<Service>::~Take()
{
#if AXON_TRACE_SERVICES
  ros_trace_rmw_take_request(
    &endpoint_.rmw, message_, Gid(taken_.info.sender).bytes,
    static_cast<int64_t>(taken_.info.publication_sequence), delivered_);
#endif
}

template<>
Take<Client>::~Take()
{
#if AXON_TRACE_SERVICES
  ros_trace_rmw_take_response(
    &endpoint_.rmw, message_, static_cast<int64_t>(taken_.info.publication_sequence),
    taken_.info.source_timestamp, delivered_);
#endif
}

}  // namespace rmw_axon::trace
