// SPDX-License-Identifier: MIT OR Apache-2.0

// Hand-written introspection: types that no generator makes, with the fields that every distribution has.
// Fields that only some distributions have are zero.

#ifndef MADE_HPP_
#define MADE_HPP_

#include <gtest/gtest.h>

#include <cstddef>
#include <deque>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "cdr/codec.hpp"
#include "rosidl_typesupport_introspection_c/field_types.h"
#include "rosidl_typesupport_introspection_c/identifier.h"
#include "rosidl_typesupport_introspection_c/message_introspection.h"
#include "rosidl_typesupport_introspection_cpp/identifier.hpp"
#include "rosidl_typesupport_introspection_cpp/message_introspection.hpp"

namespace made
{

using Bytes = std::vector<uint8_t>;

namespace id
{
constexpr uint8_t DOUBLE = rosidl_typesupport_introspection_c__ROS_TYPE_DOUBLE;
constexpr uint8_t INT16 = rosidl_typesupport_introspection_c__ROS_TYPE_INT16;
constexpr uint8_t UINT8 = rosidl_typesupport_introspection_c__ROS_TYPE_UINT8;
constexpr uint8_t UINT16 = rosidl_typesupport_introspection_c__ROS_TYPE_UINT16;
constexpr uint8_t UINT64 = rosidl_typesupport_introspection_c__ROS_TYPE_UINT64;
constexpr uint8_t BOOLEAN = rosidl_typesupport_introspection_c__ROS_TYPE_BOOLEAN;
constexpr uint8_t STRING = rosidl_typesupport_introspection_c__ROS_TYPE_STRING;
constexpr uint8_t WSTRING = rosidl_typesupport_introspection_c__ROS_TYPE_WSTRING;
constexpr uint8_t MESSAGE = rosidl_typesupport_introspection_c__ROS_TYPE_MESSAGE;
}  // namespace id

// Returns the type's own introspection, whichever was requested.
inline const rosidl_message_type_support_t * itself(
  const rosidl_message_type_support_t * handle, const char * identifier)
{
  return std::string(handle->typesupport_identifier) == identifier ? handle : nullptr;
}

// Members keep their place while others are added.
template<typename Members, typename Member>
class Type
{
public:
  Member & one(const char * name, uint8_t type_id, size_t offset)
  {
    Member & member = all_->members.emplace_back();
    member.name_ = name;
    member.type_id_ = type_id;
    member.offset_ = static_cast<uint32_t>(offset);
    return member;
  }

  const rosidl_message_type_support_t * handle() const
  {
    all_->flat.assign(all_->members.begin(), all_->members.end());
    all_->description.member_count_ = static_cast<uint32_t>(all_->flat.size());
    all_->description.members_ = all_->flat.data();
    all_->handle.data = &all_->description;
    all_->handle.func = itself;
    return &all_->handle;
  }

protected:
  struct All
  {
    std::deque<Member> members;
    std::vector<Member> flat;
    Members description{};
    rosidl_message_type_support_t handle{};
  };

  std::unique_ptr<All> all_ = std::make_unique<All>();
};

using CMembers = rosidl_typesupport_introspection_c__MessageMembers;
using CMember = rosidl_typesupport_introspection_c__MessageMember;
using CppMembers = rosidl_typesupport_introspection_cpp::MessageMembers;
using CppMember = rosidl_typesupport_introspection_cpp::MessageMember;

class CType : public Type<CMembers, CMember>
{
public:
  CType(
    const char * name, size_t size, decltype(CMembers::init_function) init,
    decltype(CMembers::fini_function) end)
  {
    all_->description.message_namespace_ = "made__msg";
    all_->description.message_name_ = name;
    all_->description.size_of_ = size;
    all_->description.init_function = init;
    all_->description.fini_function = end;
    all_->handle.typesupport_identifier = rosidl_typesupport_introspection_c__identifier;
  }
};

template<typename Message>
class CppType : public Type<CppMembers, CppMember>
{
public:
  explicit CppType(const char * name)
  {
    all_->description.message_namespace_ = "made::msg";
    all_->description.message_name_ = name;
    all_->description.size_of_ = sizeof(Message);
    all_->description.init_function = [](void * memory, rosidl_runtime_cpp::MessageInitialization) {
        new (memory) Message();
      };
    all_->description.fini_function = [](void * memory) {
        static_cast<Message *>(memory)->~Message();
      };
    all_->handle.typesupport_identifier = rosidl_typesupport_introspection_cpp::typesupport_identifier;
  }

  // Adds a sequence, with the functions that rosidl generates for one. A std::vector<bool> has none that
  // return a pointer.
  template<typename Sequence>
  CppMember & sequence(const char * name, uint8_t type_id, size_t offset)
  {
    using Item = std::decay_t<decltype(std::declval<const Sequence &>()[0])>;
    CppMember & member = one(name, type_id, offset);
    member.is_array_ = true;
    member.size_function = [](const void * sequence) {
        return static_cast<const Sequence *>(sequence)->size();
      };
    member.resize_function = [](void * sequence, size_t size) {
        static_cast<Sequence *>(sequence)->resize(size);
      };
    member.fetch_function = [](const void * sequence, size_t index, void * into) {
        *static_cast<Item *>(into) = (*static_cast<const Sequence *>(sequence))[index];
      };
    member.assign_function = [](void * sequence, size_t index, const void * from) {
        (*static_cast<Sequence *>(sequence))[index] = *static_cast<const Item *>(from);
      };
    if constexpr (!std::is_same_v<Sequence, std::vector<bool>>) {
      member.get_const_function = [](const void * sequence, size_t index) -> const void * {
          return &(*static_cast<const Sequence *>(sequence))[index];
        };
      member.get_function = [](void * sequence, size_t index) -> void * {
          return &(*static_cast<Sequence *>(sequence))[index];
        };
    }
    return member;
  }
};

// A message of a plan's type, in memory that AddressSanitizer knows the end of.
class Message
{
public:
  explicit Message(const rmw_axon::cdr::Plan & plan)
  : plan_(plan), memory_(std::make_unique<uint64_t[]>((plan.size_of + 7) / 8))
  {
    plan.init(get());
  }

  ~Message() {plan_.fini(get());}

  void * get() {return memory_.get();}

private:
  const rmw_axon::cdr::Plan & plan_;
  std::unique_ptr<uint64_t[]> memory_;
};

inline Bytes encoded(const rmw_axon::cdr::Plan & plan, const void * message)
{
  Bytes bytes(rmw_axon::cdr::encoded_size(plan, message));
  EXPECT_EQ(rmw_axon::cdr::encode(plan, message, bytes.data(), bytes.size()), bytes.size());
  return bytes;
}

}  // namespace made

#endif  // MADE_HPP_
