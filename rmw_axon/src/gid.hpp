// SPDX-License-Identifier: MIT OR Apache-2.0

#ifndef GID_HPP_
#define GID_HPP_

#include <cstddef>
#include <cstdint>
#include <cstring>

#include "axon.h"
#include "rmw/types.h"

namespace rmw_axon
{

// Copies AXON's sixteen bytes to a GID field of rmw. The field is longer in Humble; the rest is zeros.
template<typename Byte, size_t size>
void copy_gid(const axon_gid_t & from, Byte (& to)[size])
{
  static_assert(size >= sizeof(from.bytes) && sizeof(Byte) == 1);
  std::memset(to, 0, size);
  std::memcpy(to, from.bytes, sizeof(from.bytes));
}

template<typename Byte, size_t size>
axon_gid_t to_core(const Byte (& from)[size])
{
  axon_gid_t gid;
  std::memcpy(gid.bytes, from, sizeof(gid.bytes));
  return gid;
}

rmw_gid_t from_core(const axon_gid_t & gid);

}  // namespace rmw_axon

#endif  // GID_HPP_
