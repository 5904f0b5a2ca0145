// SPDX-License-Identifier: MIT OR Apache-2.0

#include "cdr/container.hpp"

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <memory>
#include <new>
#include <string>
#include <type_traits>

#include "cdr/buffer.hpp"
#include "rosidl_typesupport_introspection_c/field_types.h"

namespace rmw_axon::cdr
{

namespace
{

using CMembers = rosidl_typesupport_introspection_c__MessageMembers;
using CMember = rosidl_typesupport_introspection_c__MessageMember;
using CppMembers = rosidl_typesupport_introspection_cpp::MessageMembers;
using CppMember = rosidl_typesupport_introspection_cpp::MessageMember;

// A sequence's memory, both as C's data, size and capacity and as the three pointers of a std::vector.
struct Words
{
  uintptr_t first;
  uintptr_t second;
  uintptr_t third;
};

// An initialised message, for the time of a look at its sequences.
template<typename Members>
class Sample
{
public:
  explicit Sample(const Members & members)
  : members_(members),
    memory_(std::make_unique<std::max_align_t[]>(members.size_of_ / sizeof(std::max_align_t) + 1))
  {
    if constexpr (std::is_same_v<Members, CMembers>) {
      members.init_function(memory_.get(), ROSIDL_RUNTIME_C_MSG_INIT_ALL);
    } else {
      members.init_function(memory_.get(), rosidl_runtime_cpp::MessageInitialization::ALL);
    }
  }

  ~Sample() {members_.fini_function(memory_.get());}

  uint8_t * at(size_t offset) {return reinterpret_cast<uint8_t *>(memory_.get()) + offset;}

private:
  const Members & members_;
  std::unique_ptr<std::max_align_t[]> memory_;
};

void resize(const Field & field, void * sequence, size_t size)
{
  if (field.resize_cpp != nullptr) {
    field.resize_cpp(sequence, size);
  } else if (!field.resize_c(sequence, size)) {
    throw std::bad_alloc();
  }
}

// Returns whether the sequence's memory is that of a container with adjacent items at these addresses.
bool is_contiguous(const Field & field, uint8_t * sequence, size_t size)
{
  if (field.size(sequence) != size) {
    return false;
  }
  const auto first = reinterpret_cast<uintptr_t>(field.at(sequence, 0));
  const auto last = reinterpret_cast<uintptr_t>(field.at(sequence, size - 1));
  if (reinterpret_cast<uintptr_t>(field.at_mutable(sequence, 0)) != first ||
    last != first + (size - 1) * field.stride)
  {
    return false;
  }
  Words words;
  std::memcpy(&words, sequence, sizeof(words));
  if (field.resize_c != nullptr) {
    return words.first == first && words.second == size && words.third >= size;
  }
  return words.first == first && words.second == first + size * field.stride && words.third >= words.second;
}

template<typename Members, typename Member>
size_t room(const Members & members, const Member & member)
{
  size_t end = members.size_of_;
  for (uint32_t i = 0; i < members.member_count_; ++i) {
    if (members.members_[i].offset_ > member.offset_) {
      end = std::min<size_t>(end, members.members_[i].offset_);
    }
  }
  return end > member.offset_ ? end - member.offset_ : 0;
}

template<typename Members, typename Member>
bool looks_contiguous(const Members & members, const Member & member, const Field & field)
{
  if (field.at == nullptr || field.at_mutable == nullptr || room(members, member) < sizeof(Words)) {
    return false;
  }
  Sample<Members> sample(members);
  uint8_t * sequence = sample.at(member.offset_);
  // The check runs for two sizes, so that no number in memory passes by chance for a size or an address.
  for (const size_t size : {size_t{1}, std::min<size_t>(field.count, 5)}) {
    resize(field, sequence, size);
    if (!is_contiguous(field, sequence, size)) {
      return false;
    }
  }
  return true;
}

void require_functions(const Field & field)
{
  const bool items = field.width == 0 ? field.at != nullptr && field.at_mutable != nullptr :
    field.fetch != nullptr && field.assign != nullptr;
  if (!items || field.size == nullptr || (field.resize_c == nullptr && field.resize_cpp == nullptr)) {
    throw Error(
            std::string(field.name) + ": the introspection lacks functions to reach this sequence's items");
  }
}

template<typename Members, typename Member>
Container find(const Members & members, const Member & member, const Field & field)
{
  require_functions(field);
  if (std::is_same_v<Members, CppMembers> && buffer::is_one(member)) {
    const bool bytes = member.type_id_ == rosidl_typesupport_introspection_c__ROS_TYPE_UINT8;
    return bytes ? Container::Buffer : Container::Opaque;
  }
  return looks_contiguous(members, member, field) ? Container::Contiguous : Container::Opaque;
}

}  // namespace

Container container_of(const CMembers & members, const CMember & member, const Field & field)
{
  return find(members, member, field);
}

Container container_of(const CppMembers & members, const CppMember & member, const Field & field)
{
  return find(members, member, field);
}

size_t room_of(const CMembers & members, const CMember & member)
{
  return room(members, member);
}

size_t room_of(const CppMembers & members, const CppMember & member)
{
  return room(members, member);
}

}  // namespace rmw_axon::cdr
