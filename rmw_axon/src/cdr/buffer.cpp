// SPDX-License-Identifier: MIT OR Apache-2.0

#include "cdr/buffer.hpp"

#include <cstring>
#include <vector>

#include "rosidl_typesupport_introspection_cpp/message_introspection.hpp"

#if AXON_ROSIDL_BUFFER
#include "rosidl_buffer/buffer.hpp"
#endif

namespace rmw_axon::cdr::buffer
{

static_assert(
  AXON_ROSIDL_BUFFER || (
    !Flagged<rosidl_typesupport_introspection_cpp::MessageMember>::value &&
    !MayHold<rosidl_runtime_c__uint8__Sequence>::value),
  "this rosidl makes uint8[] a rosidl::Buffer, but rosidl_buffer/buffer.hpp is not found");

#if AXON_ROSIDL_BUFFER

using Buffer = rosidl::Buffer<uint8_t>;

namespace
{

bool is_here(const Buffer & buffer)
{
  return buffer.get_backend_type() == "cpu";
}

}  // namespace

size_t size(const void * buffer)
{
  return static_cast<const Buffer *>(buffer)->size();
}

bool copy_to(const void * buffer, uint8_t * into, size_t size)
{
  const auto & from = *static_cast<const Buffer *>(buffer);
  if (!is_here(from)) {
    const std::vector<uint8_t> copy = from.to_vector();
    if (copy.size() != size) {
      return false;
    }
    std::memcpy(into, copy.data(), size);
    return true;
  }
  if (from.size() != size) {
    return false;
  }
  std::memcpy(into, from.data(), size);
  return true;
}

void assign(void * buffer, const uint8_t * from, size_t size)
{
  auto & into = *static_cast<Buffer *>(buffer);
  if (!is_here(into)) {
    into = Buffer();
  }
  into.assign(from, from + size);
}

#endif

}  // namespace rmw_axon::cdr::buffer
