// SPDX-License-Identifier: MIT OR Apache-2.0

#include <memory>
#include <string>

#include "endpoint.hpp"
#include "error.hpp"
#include "names.hpp"
#include "qos.hpp"
#include "rmw/rmw.h"
#include "take.hpp"
#include "trace.hpp"

using rmw_axon::Failure;
using rmw_axon::Subscription;
using rmw_axon::check;
using rmw_axon::guarded;
using rmw_axon::require;
using rmw_axon::subscription_of;

namespace rmw_axon
{

Subscription::~Subscription()
{
  for (const auto & [message, sample] : loans) {
    end_loan(*this, message, sample);
  }
  axon_session_subscription_destroy(handle);
}

}  // namespace rmw_axon

extern "C" {

rmw_subscription_t * rmw_create_subscription(
  const rmw_node_t * node, const rosidl_message_type_support_t * type_support,
  const char * topic_name, const rmw_qos_profile_t * qos_policies,
  const rmw_subscription_options_t * subscription_options)
{
  return rmw_axon::guarded_pointer(
    [&] {
      rmw_axon::Node & of = rmw_axon::node_of(node);
      require(type_support, "type_support");
      require(topic_name, "topic_name");
      require(qos_policies, "qos_policies");
      require(subscription_options, "subscription_options");
      if (subscription_options->require_unique_network_flow_endpoints ==
      RMW_UNIQUE_NETWORK_FLOW_ENDPOINTS_STRICTLY_REQUIRED)
      {
        throw Failure(
          RMW_RET_UNSUPPORTED,
          std::string("topic ") + topic_name + ": AXON has no unique network flow endpoints, "
          "and options require them strictly");
      }
      const bool avoid = qos_policies->avoid_ros_namespace_conventions;
      rmw_axon::EndpointNames names;
      names.name = rmw_axon::topic_name(topic_name, avoid);
      auto subscription = std::make_unique<Subscription>();
      subscription->plan = rmw_axon::cdr::plan(type_support);
      names.type = subscription->plan.type;
      auto options = rmw_axon::endpoint_options(names, *qos_policies, type_support);
      options.ignore_local = subscription_options->ignore_local_publications ? 1 : 0;
      check(axon_session_subscription_create(of.handle, &options, &subscription->handle));
      axon_qos_t qos{};
      check(axon_session_subscription_describe(subscription->handle, &subscription->gid, &qos));
      subscription->qos = rmw_axon::from_core(qos);
      subscription->qos.avoid_ros_namespace_conventions = avoid;
      subscription->topic = topic_name;
      subscription->label = rmw_axon::label("topic", topic_name, of);
      subscription->rmw.implementation_identifier = rmw_axon::identifier;
      subscription->rmw.data = subscription.get();
      subscription->rmw.topic_name = subscription->topic.c_str();
      subscription->rmw.options = *subscription_options;
      subscription->rmw.can_loan_messages = subscription->plan.plain;
      // A filter that is asked for is not applied: the caller reads here that it has to filter itself.
      subscription->rmw.is_cft_enabled = false;
      rmw_axon::trace::subscription_created(*subscription);
      return &subscription.release()->rmw;
    });
}

rmw_ret_t rmw_destroy_subscription(rmw_node_t * node, rmw_subscription_t * subscription)
{
  return guarded(
    [&] {
      rmw_axon::node_of(node);
      delete &subscription_of(subscription);
    });
}

rmw_ret_t rmw_subscription_count_matched_publishers(
  const rmw_subscription_t * subscription, size_t * publisher_count)
{
  return guarded(
    [&] {
      Subscription & of = subscription_of(subscription);
      require(publisher_count, "publisher_count");
      check(axon_session_subscription_matched(of.handle, publisher_count));
    });
}

rmw_ret_t rmw_subscription_get_actual_qos(
  const rmw_subscription_t * subscription, rmw_qos_profile_t * qos)
{
  return guarded(
    [&] {
      Subscription & of = subscription_of(subscription);
      require(qos, "qos");
      *qos = of.qos;
    });
}

rmw_ret_t rmw_subscription_set_on_new_message_callback(
  rmw_subscription_t * subscription, rmw_event_callback_t callback, const void * user_data)
{
  return guarded(
    [&] {
      Subscription & of = subscription_of(subscription);
      check(axon_session_subscription_set_callback(of.handle, callback, user_data));
    });
}

}
