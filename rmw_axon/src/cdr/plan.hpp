// SPDX-License-Identifier: MIT OR Apache-2.0

// The layout of a message in memory and in a CDR stream. It is computed once per type from the type's
// introspection, in C and in C++. Encoding and decoding follow a plan; they use no generated code.

#ifndef CDR__PLAN_HPP_
#define CDR__PLAN_HPP_

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "rosidl_runtime_c/message_initialization.h"
#include "rosidl_runtime_c/message_type_support_struct.h"
#include "rosidl_runtime_c/service_type_support_struct.h"
#include "rosidl_runtime_cpp/message_initialization.hpp"

namespace rmw_axon::cdr
{

// A defect of a message or a stream; the text has the field's name.
class Error : public std::runtime_error
{
public:
  using std::runtime_error::runtime_error;
};

enum class Language { C, Cpp };

// The kind of a field's items.
enum class Item { Number, Bool, LongDouble, WChar, String, WString, Message };

enum class Shape { One, Array, Sequence };

// The storage of a sequence's items.
enum class Container
{
  // The layout is unknown: each item is reached through the introspection's functions.
  Opaque,
  // The items are adjacent: a std::vector in C++; data, size and capacity in C.
  Contiguous,
  // C++: a rosidl::Buffer<uint8_t>.
  Buffer,
};

struct Plan;

struct Field
{
  const char * name = "";
  Item item = Item::Number;
  Shape shape = Shape::One;
  // The introspection's type_id_, which distinguishes a vector of floats from one of integers.
  uint8_t type_id = 0;
  // Bytes of an item in the stream, and their alignment there. 0 for strings and messages.
  size_t width = 0;
  size_t alignment = 1;
  // Bytes from the start of the message, and from one item to the next.
  size_t offset = 0;
  size_t stride = 0;
  // Array: the number of items. Sequence: their maximum number.
  size_t count = 1;
  // Strings: the maximum number of characters.
  size_t characters = SIZE_MAX;
  // Item::Message
  std::unique_ptr<Plan> message;
  // Shape::Sequence
  Container container = Container::Opaque;
  // The functions of the introspection.
  size_t (* size)(const void *) = nullptr;
  const void * (*at)(const void *, size_t) = nullptr;
  void * (*at_mutable)(void *, size_t) = nullptr;
  void (* fetch)(const void *, size_t, void *) = nullptr;
  void (* assign)(void *, size_t, const void *) = nullptr;
  void (* resize_cpp)(void *, size_t) = nullptr;
  bool (* resize_c)(void *, size_t) = nullptr;
  // An unbounded sequence in C++ is a std::vector; a bounded one is a class of its own.
  bool bounded = false;

  // The run of this field and the following ones without a gap between them in memory. They have no gap in
  // the stream either if its position equals the offset modulo `run_alignment`. One copy carries the whole
  // run.
  size_t run_fields = 1;
  size_t run_bytes = 0;
  size_t run_alignment = 1;
};

struct Plan
{
  Language language = Language::Cpp;
  // The name, as `ros2 interface show` accepts it: std_msgs/msg/String
  std::string type;
  size_t size_of = 0;
  // For a plain type: the alignment of a message in memory.
  size_t alignment = 1;
  std::vector<Field> fields;
  // Minimum number of bytes of a message in a stream, at least 1.
  size_t least = 0;
  // Number of bytes of the body, if all messages of the type have the same number: no string, no sequence.
  std::optional<size_t> fixed;
  // True if the memory equals the body, byte for byte except for padding.
  bool plain = false;
  // True if the type is plain and has a bool, for which not every byte is a valid value.
  bool has_bool = false;

  // The functions that make every new message, zeroed or with its defaults, and that end it.
  void init(void * message) const;
  void (* init_c)(void *, rosidl_runtime_c__message_initialization) = nullptr;
  void (* init_cpp)(void *, rosidl_runtime_cpp::MessageInitialization) = nullptr;
  void (* fini)(void *) = nullptr;
};

// Computes the plan of a type. Throws Error if the type has no introspection, in C or in C++.
Plan plan(const rosidl_message_type_support_t * type_support);

struct ServicePlans
{
  // example_interfaces/srv/AddTwoInts
  std::string type;
  Plan request;
  Plan response;
};

ServicePlans plans(const rosidl_service_type_support_t * type_support);

}  // namespace rmw_axon::cdr

#endif  // CDR__PLAN_HPP_
