// SPDX-License-Identifier: MIT OR Apache-2.0

// Finds out how a sequence stores its items, by looking at one.

#ifndef CDR__CONTAINER_HPP_
#define CDR__CONTAINER_HPP_

#include <cstddef>

#include "cdr/plan.hpp"
#include "rosidl_typesupport_introspection_c/message_introspection.h"
#include "rosidl_typesupport_introspection_cpp/message_introspection.hpp"

namespace rmw_axon::cdr
{

// Returns how to reach the items of `member` of `members`; `field` is its field with the introspection's
// functions. Throws Error if these functions do not suffice.
Container container_of(
  const rosidl_typesupport_introspection_c__MessageMembers & members,
  const rosidl_typesupport_introspection_c__MessageMember & member, const Field & field);
Container container_of(
  const rosidl_typesupport_introspection_cpp::MessageMembers & members,
  const rosidl_typesupport_introspection_cpp::MessageMember & member, const Field & field);

// Returns the bytes from the member's start to the next member, or to the message's end.
size_t room_of(
  const rosidl_typesupport_introspection_c__MessageMembers & members,
  const rosidl_typesupport_introspection_c__MessageMember & member);
size_t room_of(
  const rosidl_typesupport_introspection_cpp::MessageMembers & members,
  const rosidl_typesupport_introspection_cpp::MessageMember & member);

}  // namespace rmw_axon::cdr

#endif  // CDR__CONTAINER_HPP_
