// SPDX-License-Identifier: MIT OR Apache-2.0

#include "cdr/plan.hpp"

#include <algorithm>
#include <utility>

#include "cdr/container.hpp"
#include "rcutils/error_handling.h"
#include "rosidl_runtime_c/string.h"
#include "rosidl_runtime_c/u16string.h"
#include "rosidl_typesupport_introspection_c/field_types.h"
#include "rosidl_typesupport_introspection_c/identifier.h"
#include "rosidl_typesupport_introspection_c/message_introspection.h"
#include "rosidl_typesupport_introspection_c/service_introspection.h"
#include "rosidl_typesupport_introspection_cpp/identifier.hpp"
#include "rosidl_typesupport_introspection_cpp/message_introspection.hpp"
#include "rosidl_typesupport_introspection_cpp/service_introspection.hpp"

namespace rmw_axon::cdr
{

namespace
{

using CMembers = rosidl_typesupport_introspection_c__MessageMembers;
using CMember = rosidl_typesupport_introspection_c__MessageMember;
using CppMembers = rosidl_typesupport_introspection_cpp::MessageMembers;
using CppMember = rosidl_typesupport_introspection_cpp::MessageMember;

// std_msgs::msg (C++) or std_msgs__msg (C), and String: std_msgs/msg/String
std::string ros_name(const char * name_space, const char * name)
{
  std::string type = name_space;
  for (const char * separator : {"::", "__"}) {
    for (size_t at; (at = type.find(separator)) != std::string::npos; ) {
      type.replace(at, 2, "/");
    }
  }
  return type + "/" + name;
}

struct Scalar
{
  Item item;
  size_t in_memory;
  size_t in_stream;
  size_t alignment;
};

// rosidl's C and C++ type ids are the same numbers.
Scalar scalar(uint8_t type_id, Language language)
{
  const bool c = language == Language::C;
  switch (type_id) {
    case rosidl_typesupport_introspection_c__ROS_TYPE_CHAR:
    case rosidl_typesupport_introspection_c__ROS_TYPE_OCTET:
    case rosidl_typesupport_introspection_c__ROS_TYPE_UINT8:
    case rosidl_typesupport_introspection_c__ROS_TYPE_INT8:
      return {Item::Number, 1, 1, 1};
    case rosidl_typesupport_introspection_c__ROS_TYPE_UINT16:
    case rosidl_typesupport_introspection_c__ROS_TYPE_INT16:
      return {Item::Number, 2, 2, 2};
    case rosidl_typesupport_introspection_c__ROS_TYPE_FLOAT:
    case rosidl_typesupport_introspection_c__ROS_TYPE_UINT32:
    case rosidl_typesupport_introspection_c__ROS_TYPE_INT32:
      return {Item::Number, 4, 4, 4};
    case rosidl_typesupport_introspection_c__ROS_TYPE_DOUBLE:
    case rosidl_typesupport_introspection_c__ROS_TYPE_UINT64:
    case rosidl_typesupport_introspection_c__ROS_TYPE_INT64:
      return {Item::Number, 8, 8, 8};
    case rosidl_typesupport_introspection_c__ROS_TYPE_BOOLEAN:
      return {Item::Bool, 1, 1, 1};
    case rosidl_typesupport_introspection_c__ROS_TYPE_LONG_DOUBLE:
      return {Item::LongDouble, sizeof(long double), 16, 8};
    case rosidl_typesupport_introspection_c__ROS_TYPE_WCHAR:
      // The other middlewares write four bytes for a character of two.
      return {Item::WChar, 2, 4, 4};
    case rosidl_typesupport_introspection_c__ROS_TYPE_STRING:
      return {Item::String, c ? sizeof(rosidl_runtime_c__String) : sizeof(std::string), 0, 4};
    case rosidl_typesupport_introspection_c__ROS_TYPE_WSTRING:
      return {Item::WString, c ? sizeof(rosidl_runtime_c__U16String) : sizeof(std::u16string), 0, 4};
    default:
      throw Error("a field of a type that introspection does not know: " + std::to_string(type_id));
  }
}

size_t least_of(const Field & field)
{
  if (field.shape == Shape::Sequence) {
    return sizeof(uint32_t);
  }
  size_t item = field.width;
  if (field.item == Item::String || field.item == Item::WString) {
    item = sizeof(uint32_t);
  } else if (field.item == Item::Message) {
    item = field.message->least;
  }
  return item * field.count;
}

// Joins neighbouring fields that one copy can carry. They must be numbers, of which every byte is part of a
// value.
void find_runs(std::vector<Field> & fields)
{
  for (size_t i = fields.size(); i-- > 0; ) {
    Field & field = fields[i];
    if (field.item != Item::Number || field.shape == Shape::Sequence) {
      continue;
    }
    field.run_bytes = field.width * field.count;
    field.run_alignment = field.alignment;
    if (i + 1 == fields.size()) {
      continue;
    }
    const Field & next = fields[i + 1];
    if (next.run_bytes != 0 && next.offset == field.offset + field.run_bytes) {
      field.run_fields += next.run_fields;
      field.run_bytes += next.run_bytes;
      field.run_alignment = std::max(field.run_alignment, next.run_alignment);
    }
  }
}

// Returns the end of the body that starts at `position`, for fields without strings and sequences. Also
// determines whether every item has the same position in memory.
size_t lay_out(const Plan & plan, size_t position, size_t memory, bool & as_in_memory, bool & has_bool)
{
  for (const Field & field : plan.fields) {
    if (field.item == Item::Message) {
      for (size_t i = 0; i < field.count; ++i) {
        const size_t at = memory + field.offset + i * field.stride;
        position = lay_out(*field.message, position, at, as_in_memory, has_bool);
      }
      continue;
    }
    position = (position + field.alignment - 1) / field.alignment * field.alignment;
    as_in_memory &= position == memory + field.offset && field.stride == field.width;
    // Neither is read back in the form in which it is written.
    as_in_memory &= field.item != Item::LongDouble && field.item != Item::WChar;
    has_bool |= field.item == Item::Bool;
    position += field.width * field.count;
  }
  return position;
}

bool all_fixed(const Plan & plan)
{
  return std::all_of(
    plan.fields.begin(), plan.fields.end(), [](const Field & field) {
      return field.shape != Shape::Sequence && field.item != Item::String &&
             field.item != Item::WString && (!field.message || all_fixed(*field.message));
    });
}

template<typename Members>
Plan build(const Members & members);

template<typename Member>
void set_functions(const Member & member, Field & field)
{
  field.size = member.size_function;
  field.at = member.get_const_function;
  field.at_mutable = member.get_function;
  field.fetch = member.fetch_function;
  field.assign = member.assign_function;
  if constexpr (std::is_same_v<Member, CMember>) {
    field.resize_c = member.resize_function;
  } else {
    field.resize_cpp = member.resize_function;
  }
}

// A distribution may store a type in an unknown way. This detects a type that takes less memory than
// expected.
template<typename Members, typename Member>
void require_room(const Members & members, const Member & member, size_t size)
{
  const size_t room = room_of(members, member);
  if (size > room) {
    throw Error(
            std::string(member.name_) + ": has " + std::to_string(room) + " bytes in a message, " +
            std::to_string(size) + " are expected: rmw_axon does not know this distribution's layout");
  }
}

// Appends the fields of the member in a message at `base`. A single nested message is replaced by its fields.
template<typename Members, typename Member>
void append(const Members & members, const Member & member, size_t base, std::vector<Field> & fields)
{
  constexpr Language language =
    std::is_same_v<Member, CMember> ? Language::C : Language::Cpp;
  Field field;
  field.name = member.name_;
  field.type_id = member.type_id_;
  field.offset = base + member.offset_;
  if (member.is_array_) {
    field.shape = member.array_size_ != 0 && !member.is_upper_bound_ ? Shape::Array : Shape::Sequence;
    field.bounded = member.is_upper_bound_;
    field.count = member.array_size_ != 0 ? member.array_size_ : SIZE_MAX;
  }
  if (member.type_id_ == rosidl_typesupport_introspection_c__ROS_TYPE_MESSAGE) {
    const auto * nested = static_cast<const Members *>(member.members_->data);
    if (!member.is_array_) {
      require_room(members, member, nested->size_of_);
      for (uint32_t i = 0; i < nested->member_count_; ++i) {
        append(*nested, nested->members_[i], field.offset, fields);
      }
      return;
    }
    field.item = Item::Message;
    field.stride = nested->size_of_;
    field.message = std::make_unique<Plan>(build(*nested));
  } else {
    const Scalar type = scalar(member.type_id_, language);
    field.item = type.item;
    field.width = type.in_stream;
    field.alignment = type.alignment;
    field.stride = type.in_memory;
    if (member.string_upper_bound_ != 0) {
      field.characters = member.string_upper_bound_;
    }
  }
  if (field.shape == Shape::Sequence) {
    set_functions(member, field);
    field.container = container_of(members, member, field);
  } else {
    require_room(members, member, field.stride * field.count);
  }
  fields.push_back(std::move(field));
}

template<typename Members>
Plan build(const Members & members)
{
  Plan plan;
  plan.type = ros_name(members.message_namespace_, members.message_name_);
  plan.size_of = members.size_of_;
  if constexpr (std::is_same_v<Members, CMembers>) {
    plan.language = Language::C;
    plan.init_c = members.init_function;
  } else {
    plan.language = Language::Cpp;
    plan.init_cpp = members.init_function;
  }
  plan.fini = members.fini_function;
  for (uint32_t i = 0; i < members.member_count_; ++i) {
    append(members, members.members_[i], 0, plan.fields);
  }
  find_runs(plan.fields);
  for (const Field & field : plan.fields) {
    plan.least += least_of(field);
    const size_t alignment = field.message ? field.message->alignment : field.alignment;
    plan.alignment = std::max(plan.alignment, alignment);
  }
  if (all_fixed(plan)) {
    plan.plain = true;
    plan.fixed = lay_out(plan, 0, 0, plan.plain, plan.has_bool);
  }
  return plan;
}

// Returns the handle that `find` gives for the first of the two languages that has one.
template<typename Handle>
const Handle * introspection(const Handle * handle, Language & language)
{
  if (handle == nullptr) {
    throw Error("type support is null");
  }
  if (const auto * c = handle->func(handle, rosidl_typesupport_introspection_c__identifier)) {
    language = Language::C;
    return c;
  }
  rcutils_reset_error();
  using rosidl_typesupport_introspection_cpp::typesupport_identifier;
  if (const auto * cpp = handle->func(handle, typesupport_identifier)) {
    language = Language::Cpp;
    return cpp;
  }
  rcutils_reset_error();
  throw Error(
          std::string("type support of ") + handle->typesupport_identifier +
          " has no introspection, in C or in C++");
}

}  // namespace

void Plan::init(void * message) const
{
  if (init_c != nullptr) {
    init_c(message, ROSIDL_RUNTIME_C_MSG_INIT_ALL);
  } else {
    init_cpp(message, rosidl_runtime_cpp::MessageInitialization::ALL);
  }
}

Plan plan(const rosidl_message_type_support_t * type_support)
{
  Language language{};
  const auto * found = introspection(type_support, language);
  return language == Language::C ? build(*static_cast<const CMembers *>(found->data)) :
         build(*static_cast<const CppMembers *>(found->data));
}

ServicePlans plans(const rosidl_service_type_support_t * type_support)
{
  Language language{};
  const auto * found = introspection(type_support, language);
  const auto both = [](const auto & service) {
      return ServicePlans{
        ros_name(service.service_namespace_, service.service_name_),
        build(*service.request_members_), build(*service.response_members_)};
    };
  if (language == Language::C) {
    using Members = rosidl_typesupport_introspection_c__ServiceMembers;
    return both(*static_cast<const Members *>(found->data));
  }
  using rosidl_typesupport_introspection_cpp::ServiceMembers;
  return both(*static_cast<const ServiceMembers *>(found->data));
}

}  // namespace rmw_axon::cdr
