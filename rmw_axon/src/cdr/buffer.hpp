// SPDX-License-Identifier: MIT OR Apache-2.0

// rosidl::Buffer<uint8_t>, which rosidl has from 5.1.4 on. In C++ every unbounded uint8[] is one. In C a
// sequence's `data` points to one while `is_rosidl_buffer` is set. Its bytes may be on another device.

#ifndef CDR__BUFFER_HPP_
#define CDR__BUFFER_HPP_

#include <cstddef>
#include <cstdint>
#include <type_traits>

#include "rosidl_runtime_c/primitives_sequence.h"

#if __has_include("rosidl_buffer/buffer.hpp")
#define AXON_ROSIDL_BUFFER 1
#else
#define AXON_ROSIDL_BUFFER 0
#endif

namespace rmw_axon::cdr::buffer
{

// Whether `Member` can mark a field as a Buffer: `is_rosidl_buffer_`.
template<typename Member, typename = void>
struct Flagged : std::false_type {};
template<typename Member>
struct Flagged<Member, std::void_t<decltype(Member::is_rosidl_buffer_)>>: std::true_type {};

template<typename Member>
bool is_one(const Member & member)
{
  if constexpr (Flagged<Member>::value) {
    return member.is_rosidl_buffer_;
  } else {
    return false;
  }
}

// Whether a sequence in C may hold a Buffer.
template<typename Sequence, typename = void>
struct MayHold : std::false_type {};
template<typename Sequence>
struct MayHold<Sequence, std::void_t<decltype(Sequence::is_rosidl_buffer)>>: std::true_type {};

// Returns the Buffer that a sequence of numbers in C holds, or null. All sequences of numbers have one
// layout.
template<typename Sequence = rosidl_runtime_c__uint8__Sequence>
const void * held_in_c(const void * sequence)
{
  if constexpr (MayHold<Sequence>::value) {
    const auto & held = *static_cast<const Sequence *>(sequence);
    return held.is_rosidl_buffer ? held.data : nullptr;
  } else {
    return nullptr;
  }
}

#if AXON_ROSIDL_BUFFER

size_t size(const void * buffer);

// Copies `size` bytes, the size that the Buffer reported, from wherever they are. Returns false if the Buffer
// has another size now.
bool copy_to(const void * buffer, uint8_t * into, size_t size);

// Makes it a Buffer in this process's memory with these bytes.
void assign(void * buffer, const uint8_t * from, size_t size);

#else

// No distribution without the header has a Buffer.
inline size_t size(const void *) {return 0;}
inline bool copy_to(const void *, uint8_t *, size_t) {return false;}
inline void assign(void *, const uint8_t *, size_t) {}

#endif

}  // namespace rmw_axon::cdr::buffer

#endif  // CDR__BUFFER_HPP_
