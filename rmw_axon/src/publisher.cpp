// SPDX-License-Identifier: MIT OR Apache-2.0

#include <algorithm>
#include <cstdint>
#include <memory>
#include <string>

#include "cdr/codec.hpp"
#include "endpoint.hpp"
#include "error.hpp"
#include "names.hpp"
#include "qos.hpp"
#include "rmw/rmw.h"
#include "trace.hpp"

namespace rmw_axon
{

namespace
{

// Messages up to this size are serialized on the stack: the core copies small ones anyway.
constexpr size_t SMALL = 1024;

void publish(Publisher & publisher, const void * message)
{
  uint64_t skipped = 0;
  check(axon_session_publisher_skip_unread(publisher.handle, &skipped));
  if (skipped != 0) {
    trace::publish(publisher, message);
    return;
  }
  const size_t size = cdr::encoded_size(publisher.plan, message);
  if (size <= SMALL) {
    uint8_t stream[SMALL];
    cdr::encode(publisher.plan, message, stream, size);
    const int64_t timestamp = trace::publish(publisher, message);
    check(axon_session_publisher_publish(publisher.handle, stream, size, timestamp, nullptr));
    return;
  }
  axon_loan_t loan{};
  uint8_t * stream = nullptr;
  check(axon_session_publisher_loan(publisher.handle, 0, size, &loan, &stream));
  try {
    cdr::encode(publisher.plan, message, stream, size);
  } catch (...) {
    axon_session_loan_abandon(loan);
    throw;
  }
  check(axon_session_loan_publish(loan, size, trace::publish(publisher, message), nullptr));
}

}  // namespace

}  // namespace rmw_axon

using rmw_axon::Failure;
using rmw_axon::Publisher;
using rmw_axon::check;
using rmw_axon::guarded;
using rmw_axon::publisher_of;
using rmw_axon::require;

extern "C" {

rmw_publisher_t * rmw_create_publisher(
  const rmw_node_t * node, const rosidl_message_type_support_t * type_support,
  const char * topic_name, const rmw_qos_profile_t * qos_profile,
  const rmw_publisher_options_t * publisher_options)
{
  return rmw_axon::guarded_pointer(
    [&] {
      rmw_axon::Node & of = rmw_axon::node_of(node);
      require(type_support, "type_support");
      require(topic_name, "topic_name");
      require(qos_profile, "qos_profile");
      require(publisher_options, "publisher_options");
      if (publisher_options->require_unique_network_flow_endpoints ==
      RMW_UNIQUE_NETWORK_FLOW_ENDPOINTS_STRICTLY_REQUIRED)
      {
        throw Failure(
          RMW_RET_UNSUPPORTED,
          std::string("topic ") + topic_name + ": AXON has no unique network flow endpoints, "
          "and options require them strictly");
      }
      const bool avoid = qos_profile->avoid_ros_namespace_conventions;
      rmw_axon::EndpointNames names;
      names.name = rmw_axon::topic_name(topic_name, avoid);
      auto publisher = std::make_unique<Publisher>();
      publisher->plan = rmw_axon::cdr::plan(type_support);
      names.type = publisher->plan.type;
      auto options = rmw_axon::endpoint_options(names, *qos_profile, type_support);
      if (publisher->plan.plain) {
        // For messages of the expected length, loans are in place from a smaller size on.
        const size_t size = rmw_axon::cdr::HEADER + publisher->plan.size_of;
        options.expected_len = static_cast<uint32_t>(std::min<size_t>(size, UINT32_MAX));
      }
      check(axon_session_publisher_create(of.handle, &options, &publisher->handle));
      axon_qos_t qos{};
      check(axon_session_publisher_describe(publisher->handle, &publisher->gid, &qos));
      publisher->qos = rmw_axon::from_core(qos);
      publisher->qos.avoid_ros_namespace_conventions = avoid;
      publisher->topic = topic_name;
      publisher->label = rmw_axon::label("topic", topic_name, of);
      publisher->rmw.implementation_identifier = rmw_axon::identifier;
      publisher->rmw.data = publisher.get();
      publisher->rmw.topic_name = publisher->topic.c_str();
      publisher->rmw.options = *publisher_options;
      publisher->rmw.can_loan_messages = publisher->plan.plain;
      rmw_axon::trace::publisher_created(*publisher);
      return &publisher.release()->rmw;
    });
}

rmw_ret_t rmw_destroy_publisher(rmw_node_t * node, rmw_publisher_t * publisher)
{
  return guarded(
    [&] {
      rmw_axon::node_of(node);
      delete &publisher_of(publisher);
    });
}

rmw_ret_t rmw_publish(
  const rmw_publisher_t * publisher, const void * ros_message, rmw_publisher_allocation_t *)
{
  return guarded(
    [&] {
      Publisher & of = publisher_of(publisher);
      require(ros_message, "ros_message");
      try {
        rmw_axon::publish(of, ros_message);
      } catch (const rmw_axon::cdr::Error & error) {
        throw Failure(RMW_RET_ERROR, of.label + ", " + of.plan.type + ": " + error.what());
      }
    });
}

rmw_ret_t rmw_publish_serialized_message(
  const rmw_publisher_t * publisher, const rmw_serialized_message_t * serialized_message,
  rmw_publisher_allocation_t *)
{
  return guarded(
    [&] {
      Publisher & of = publisher_of(publisher);
      require(serialized_message, "serialized_message");
      const int64_t timestamp = rmw_axon::trace::publish(of, serialized_message);
      check(
        axon_session_publisher_publish(
          of.handle, serialized_message->buffer, serialized_message->buffer_length, timestamp,
          nullptr));
    });
}

rmw_ret_t rmw_publisher_count_matched_subscriptions(
  const rmw_publisher_t * publisher, size_t * subscription_count)
{
  return guarded(
    [&] {
      Publisher & of = publisher_of(publisher);
      require(subscription_count, "subscription_count");
      check(axon_session_publisher_matched(of.handle, subscription_count));
    });
}

rmw_ret_t rmw_publisher_get_actual_qos(const rmw_publisher_t * publisher, rmw_qos_profile_t * qos)
{
  return guarded(
    [&] {
      Publisher & of = publisher_of(publisher);
      require(qos, "qos");
      *qos = of.qos;
    });
}

rmw_ret_t rmw_publisher_assert_liveliness(const rmw_publisher_t * publisher)
{
  return guarded([&] {check(axon_session_publisher_assert_liveliness(publisher_of(publisher).handle));});
}

rmw_ret_t rmw_publisher_wait_for_all_acked(
  const rmw_publisher_t * publisher, rmw_time_t wait_timeout)
{
  return guarded(
    [&] {
      const int64_t timeout = rmw_axon::timeout(&wait_timeout);
      check(axon_session_publisher_wait_acknowledged(publisher_of(publisher).handle, timeout));
    });
}

}
