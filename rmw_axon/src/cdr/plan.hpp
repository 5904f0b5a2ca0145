// SPDX-License-Identifier: MIT OR Apache-2.0

// How a message lies in memory and how it lies in a CDR stream, worked out once per type from its
// introspection, in C and in C++. Encoding and decoding walk a plan; no generated code takes part.

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

// What is wrong with a message or a stream: said with the field's name.
class Error : public std::runtime_error
{
public:
  using std::runtime_error::runtime_error;
};

enum class Language { C, Cpp };

// What a field holds, once or many times.
enum class Item { Number, Bool, LongDouble, WChar, String, WString, Message };

enum class Shape { One, Array, Sequence };

// How a sequence stores its items.
enum class Container
{
  // Unknown: each item is reached through the introspection's functions.
  Opaque,
  // One after another: a std::vector in C++; data, size and capacity in C.
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
  // The introspection's type_id_, which tells a vector of floats from one of integers.
  uint8_t type_id = 0;
  // Bytes of an item in the stream, and their alignment there. 0 for strings and messages.
  size_t width = 0;
  size_t alignment = 1;
  // Bytes from the start of the message, and from one item to the next.
  size_t offset = 0;
  size_t stride = 0;
  // Array: how many items. Sequence: at most so many.
  size_t count = 1;
  // Strings: at most so many characters.
  size_t characters = SIZE_MAX;
  // Item::Message
  std::unique_ptr<Plan> message;
  // Shape::Sequence
  Container container = Container::Opaque;
  // As introspection gives them.
  size_t (* size)(const void *) = nullptr;
  const void * (*at)(const void *, size_t) = nullptr;
  void * (*at_mutable)(void *, size_t) = nullptr;
  void (* fetch)(const void *, size_t, void *) = nullptr;
  void (* assign)(void *, size_t, const void *) = nullptr;
  void (* resize_cpp)(void *, size_t) = nullptr;
  bool (* resize_c)(void *, size_t) = nullptr;
  // An unbounded sequence in C++ is a std::vector; a bounded one is a class of its own.
  bool bounded = false;

  // This and the fields after it that lie without a gap in memory and, where the stream's position
  // agrees with the offset modulo `run_alignment`, in the stream too: one copy for all of them.
  size_t run_fields = 1;
  size_t run_bytes = 0;
  size_t run_alignment = 1;
};

struct Plan
{
  Language language = Language::Cpp;
  // As `ros2 interface show` takes it: std_msgs/msg/String
  std::string type;
  size_t size_of = 0;
  // Of a plain type: where a message may lie.
  size_t alignment = 1;
  std::vector<Field> fields;
  // The fewest bytes that one can have in a stream. At least 1.
  size_t least = 0;
  // Bytes of the body where all messages of the type have as many: no string, no sequence.
  std::optional<size_t> fixed;
  // The memory is the body, byte for byte but for padding.
  bool plain = false;
  // Plain, and with a byte that is not any value's: a bool.
  bool has_bool = false;

  // What every new message is made by, zeroed or with its defaults, and ended by.
  void init(void * message) const;
  void (* init_c)(void *, rosidl_runtime_c__message_initialization) = nullptr;
  void (* init_cpp)(void *, rosidl_runtime_cpp::MessageInitialization) = nullptr;
  void (* fini)(void *) = nullptr;
};

// Throws Error where no introspection comes with the type, in C or in C++.
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
