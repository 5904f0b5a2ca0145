// SPDX-License-Identifier: MIT OR Apache-2.0

// Converts messages to and from CDR for programs that ask for it: rosbag2, generic publishers, tools.

#include <string>

#include "cdr/codec.hpp"
#include "cdr/plan.hpp"
#include "error.hpp"
#include "rmw/rmw.h"

using rmw_axon::Failure;
using rmw_axon::guarded;
using rmw_axon::require;

extern "C" {

rmw_ret_t rmw_serialize(
  const void * ros_message, const rosidl_message_type_support_t * type_support,
  rmw_serialized_message_t * serialized_message)
{
  return guarded(
    [&] {
      require(ros_message, "ros_message");
      require(type_support, "type_support");
      require(serialized_message, "serialized_message");
      const rmw_axon::cdr::Plan plan = rmw_axon::cdr::plan(type_support);
      const size_t size = rmw_axon::cdr::encoded_size(plan, ros_message);
      const rmw_ret_t resized = rmw_serialized_message_resize(serialized_message, size);
      if (resized != RMW_RET_OK) {
        throw Failure(resized, plan.type + ": no memory for the serialized message");
      }
      serialized_message->buffer_length =
      rmw_axon::cdr::encode(plan, ros_message, serialized_message->buffer, size);
    });
}

rmw_ret_t rmw_deserialize(
  const rmw_serialized_message_t * serialized_message,
  const rosidl_message_type_support_t * type_support, void * ros_message)
{
  return guarded(
    [&] {
      require(serialized_message, "serialized_message");
      require(type_support, "type_support");
      require(ros_message, "ros_message");
      const rmw_axon::cdr::Plan plan = rmw_axon::cdr::plan(type_support);
      const uint8_t * stream = serialized_message->buffer;
      try {
        rmw_axon::cdr::decode(plan, stream, serialized_message->buffer_length, ros_message);
      } catch (const rmw_axon::cdr::Error & error) {
        throw Failure(RMW_RET_ERROR, "no " + plan.type + ": " + error.what());
      }
    });
}

}
