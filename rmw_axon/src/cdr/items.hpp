// SPDX-License-Identifier: MIT OR Apache-2.0

// The differences between messages of C and C++: strings and sequences.

#ifndef CDR__ITEMS_HPP_
#define CDR__ITEMS_HPP_

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <new>
#include <string>
#include <string_view>
#include <vector>

#include "cdr/buffer.hpp"
#include "cdr/plan.hpp"
#include "rosidl_runtime_c/primitives_sequence_functions.h"
#include "rosidl_runtime_c/string_functions.h"
#include "rosidl_runtime_c/u16string_functions.h"
#include "rosidl_typesupport_introspection_c/field_types.h"

namespace rmw_axon::cdr
{

// Room for an item that a function copies.
struct alignas(std::max_align_t) OneItem
{
  uint8_t bytes[sizeof(long double)];
};

struct InC
{
  // A Container::Contiguous in C.
  struct Sequence
  {
    uint8_t * data;
    size_t size;
    size_t capacity;
  };

  static std::string_view string(const void * item)
  {
    const auto & string = *static_cast<const rosidl_runtime_c__String *>(item);
    return string.data == nullptr ? std::string_view() : std::string_view(string.data, string.size);
  }

  static void set_string(void * item, const char * text, size_t size)
  {
    if (!rosidl_runtime_c__String__assignn(static_cast<rosidl_runtime_c__String *>(item), text, size)) {
      throw std::bad_alloc();
    }
  }

  static std::u16string_view wide(const void * item)
  {
    const auto & string = *static_cast<const rosidl_runtime_c__U16String *>(item);
    const auto * data = reinterpret_cast<const char16_t *>(string.data);
    return data == nullptr ? std::u16string_view() : std::u16string_view(data, string.size);
  }

  static char16_t * resize_wide(void * item, size_t size)
  {
    auto * string = static_cast<rosidl_runtime_c__U16String *>(item);
    if (!rosidl_runtime_c__U16String__resize(string, size)) {
      throw std::bad_alloc();
    }
    return reinterpret_cast<char16_t *>(string->data);
  }

  static size_t size(const Field & field, const void * sequence)
  {
    if (field.container == Container::Opaque) {
      return field.size(sequence);
    }
    return static_cast<const Sequence *>(sequence)->size;
  }

  static const uint8_t * items(const Field &, const void * field)
  {
    return static_cast<const Sequence *>(field)->data;
  }

  static uint8_t * items(const Field &, void * field)
  {
    return static_cast<const Sequence *>(field)->data;
  }

  static void resize(const Field & field, void * sequence, size_t length)
  {
    if (size(field, sequence) != length && !field.resize_c(sequence, length)) {
      throw std::bad_alloc();
    }
  }

  // Returns the Buffer that holds the sequence's items in place of the sequence, or null.
  static const void * buffer(const Field & field, const void * sequence)
  {
    // A Buffer holds only primitive types, which have a width.
    if (field.width == 0 || field.container != Container::Contiguous) {
      return nullptr;
    }
    const void * held = buffer::held_in_c(sequence);
    if (held != nullptr && field.width != 1) {
      throw Error(std::string(field.name) + ": items of more than a byte in a buffer of bytes");
    }
    return held;
  }

  // Makes the sequence hold its items itself. A Buffer that it held is released as its flags say.
  static void release_buffer(const Field & field, void * sequence)
  {
    if (buffer(field, sequence) != nullptr) {
      rosidl_runtime_c__uint8__Sequence__fini(static_cast<rosidl_runtime_c__uint8__Sequence *>(sequence));
    }
  }

  static void set_numbers(const Field & field, void * sequence, const uint8_t * from, size_t size)
  {
    resize(field, sequence, size);
    if (size != 0) {
      std::memcpy(items(field, sequence), from, size * field.width);
    }
  }
};

struct InCpp
{
  static std::string_view string(const void * item)
  {
    return *static_cast<const std::string *>(item);
  }

  static void set_string(void * item, const char * text, size_t size)
  {
    static_cast<std::string *>(item)->assign(text, size);
  }

  static std::u16string_view wide(const void * item)
  {
    return *static_cast<const std::u16string *>(item);
  }

  static char16_t * resize_wide(void * item, size_t size)
  {
    auto * string = static_cast<std::u16string *>(item);
    string->resize(size);
    return string->data();
  }

  static size_t size(const Field & field, const void * sequence)
  {
    return field.size(sequence);
  }

  static const uint8_t * items(const Field & field, const void * sequence)
  {
    return static_cast<const uint8_t *>(field.at(sequence, 0));
  }

  static uint8_t * items(const Field & field, void * sequence)
  {
    return static_cast<uint8_t *>(field.at_mutable(sequence, 0));
  }

  static void resize(const Field & field, void * sequence, size_t size)
  {
    field.resize_cpp(sequence, size);
  }

  static const void * buffer(const Field & field, const void * sequence)
  {
    return field.container == Container::Buffer ? sequence : nullptr;
  }

  static void release_buffer(const Field &, void *) {}

  template<typename Number>
  static void set_vector(void * sequence, const uint8_t * from, size_t size)
  {
    const auto * numbers = reinterpret_cast<const Number *>(from);
    static_cast<std::vector<Number> *>(sequence)->assign(numbers, numbers + size);
  }

  // Sets the items. If the sequence is a vector and the stream is aligned, a large image is not zeroed first.
  // For Container::Contiguous only.
  static void set_numbers(const Field & field, void * sequence, const uint8_t * from, size_t size)
  {
    if (!field.bounded && reinterpret_cast<uintptr_t>(from) % field.alignment == 0) {
      switch (field.type_id) {
        case rosidl_typesupport_introspection_c__ROS_TYPE_CHAR:
        case rosidl_typesupport_introspection_c__ROS_TYPE_OCTET:
        case rosidl_typesupport_introspection_c__ROS_TYPE_UINT8:
          return set_vector<uint8_t>(sequence, from, size);
        case rosidl_typesupport_introspection_c__ROS_TYPE_FLOAT:
          return set_vector<float>(sequence, from, size);
        case rosidl_typesupport_introspection_c__ROS_TYPE_DOUBLE:
          return set_vector<double>(sequence, from, size);
        case rosidl_typesupport_introspection_c__ROS_TYPE_INT8:
          return set_vector<int8_t>(sequence, from, size);
        case rosidl_typesupport_introspection_c__ROS_TYPE_UINT16:
          return set_vector<uint16_t>(sequence, from, size);
        case rosidl_typesupport_introspection_c__ROS_TYPE_INT16:
          return set_vector<int16_t>(sequence, from, size);
        case rosidl_typesupport_introspection_c__ROS_TYPE_UINT32:
          return set_vector<uint32_t>(sequence, from, size);
        case rosidl_typesupport_introspection_c__ROS_TYPE_INT32:
          return set_vector<int32_t>(sequence, from, size);
        case rosidl_typesupport_introspection_c__ROS_TYPE_UINT64:
          return set_vector<uint64_t>(sequence, from, size);
        case rosidl_typesupport_introspection_c__ROS_TYPE_INT64:
          return set_vector<int64_t>(sequence, from, size);
        default:
          break;
      }
    }
    resize(field, sequence, size);
    if (size != 0) {
      std::memcpy(items(field, sequence), from, size * field.width);
    }
  }
};

}  // namespace rmw_axon::cdr

#endif  // CDR__ITEMS_HPP_
