// SPDX-License-Identifier: MIT OR Apache-2.0

// Features that AXON does not have, and that the API reports as unsupported: preallocation, content filters,
// network flow endpoints, and messages of types that are known only at run time.

#include <string>

#include "endpoint.hpp"
#include "error.hpp"
#include "features.hpp"
#include "rmw/get_network_flow_endpoints.h"
#include "rmw/rmw.h"

using rmw_axon::Failure;
using rmw_axon::guarded;
using rmw_axon::require;

namespace
{

[[noreturn]] void unsupported(const std::string & what)
{
  throw Failure(RMW_RET_UNSUPPORTED, "rmw_axon has no " + what);
}

}  // namespace

extern "C" {

rmw_ret_t rmw_init_publisher_allocation(
  const rosidl_message_type_support_t *, const rosidl_runtime_c__Sequence__bound *,
  rmw_publisher_allocation_t *)
{
  return guarded([] {unsupported("preallocation for publishers");});
}

rmw_ret_t rmw_fini_publisher_allocation(rmw_publisher_allocation_t *)
{
  return guarded([] {unsupported("preallocation for publishers");});
}

rmw_ret_t rmw_init_subscription_allocation(
  const rosidl_message_type_support_t *, const rosidl_runtime_c__Sequence__bound *,
  rmw_subscription_allocation_t *)
{
  return guarded([] {unsupported("preallocation for subscriptions");});
}

rmw_ret_t rmw_fini_subscription_allocation(rmw_subscription_allocation_t *)
{
  return guarded([] {unsupported("preallocation for subscriptions");});
}

rmw_ret_t rmw_get_serialized_message_size(
  const rosidl_message_type_support_t *, const rosidl_runtime_c__Sequence__bound *, size_t *)
{
  return guarded([] {unsupported("serialized sizes from bounds alone");});
}

rmw_ret_t rmw_subscription_set_content_filter(
  rmw_subscription_t * subscription, const rmw_subscription_content_filter_options_t *)
{
  return guarded(
    [&] {
      rmw_axon::subscription_of(subscription);
      unsupported("content filters");
    });
}

rmw_ret_t rmw_subscription_get_content_filter(
  const rmw_subscription_t * subscription, rcutils_allocator_t *,
  rmw_subscription_content_filter_options_t *)
{
  return guarded(
    [&] {
      rmw_axon::subscription_of(subscription);
      unsupported("content filters");
    });
}

rmw_ret_t rmw_publisher_get_network_flow_endpoints(
  const rmw_publisher_t *, rcutils_allocator_t *, rmw_network_flow_endpoint_array_t *)
{
  return guarded([] {unsupported("network flow endpoints");});
}

rmw_ret_t rmw_subscription_get_network_flow_endpoints(
  const rmw_subscription_t *, rcutils_allocator_t *, rmw_network_flow_endpoint_array_t *)
{
  return guarded([] {unsupported("network flow endpoints");});
}

#if AXON_RMW_DYNAMIC_MESSAGES
rmw_ret_t rmw_take_dynamic_message(
  const rmw_subscription_t *, rosidl_dynamic_typesupport_dynamic_data_t *, bool *,
  rmw_subscription_allocation_t *)
{
  return guarded([] {unsupported("dynamic messages");});
}

rmw_ret_t rmw_take_dynamic_message_with_info(
  const rmw_subscription_t *, rosidl_dynamic_typesupport_dynamic_data_t *, bool *,
  rmw_message_info_t *, rmw_subscription_allocation_t *)
{
  return guarded([] {unsupported("dynamic messages");});
}

rmw_ret_t rmw_serialization_support_init(
  const char *, rcutils_allocator_t *, rosidl_dynamic_typesupport_serialization_support_t *)
{
  return guarded([] {unsupported("dynamic messages");});
}
#endif

}
