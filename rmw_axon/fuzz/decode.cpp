// SPDX-License-Identifier: MIT OR Apache-2.0

// A libFuzzer target: any bytes as a stream of any of the types of test_msgs, in C and in C++. What is
// read must be a message that can be written again, and the second stream must be read as the same.
// README.md tells how to build and run it.

#include <cstring>
#include <memory>
#include <vector>

#include "cdr/codec.hpp"
#include "rosidl_typesupport_cpp/message_type_support.hpp"
#include "test_msgs/msg/arrays.h"
#include "test_msgs/msg/arrays.hpp"
#include "test_msgs/msg/basic_types.h"
#include "test_msgs/msg/basic_types.hpp"
#include "test_msgs/msg/bounded_sequences.h"
#include "test_msgs/msg/bounded_sequences.hpp"
#include "test_msgs/msg/multi_nested.h"
#include "test_msgs/msg/multi_nested.hpp"
#include "test_msgs/msg/strings.h"
#include "test_msgs/msg/strings.hpp"
#include "test_msgs/msg/unbounded_sequences.h"
#include "test_msgs/msg/unbounded_sequences.hpp"
#include "test_msgs/msg/w_strings.h"
#include "test_msgs/msg/w_strings.hpp"

namespace cdr = rmw_axon::cdr;

namespace
{

template<typename Message>
cdr::Plan in_cpp()
{
  return cdr::plan(rosidl_typesupport_cpp::get_message_type_support_handle<Message>());
}

const std::vector<cdr::Plan> & plans()
{
  static const std::vector<cdr::Plan> made = [] {
      std::vector<cdr::Plan> plans;
#define BOTH(name) \
  plans.push_back(in_cpp<test_msgs::msg::name>()); \
  plans.push_back(cdr::plan(ROSIDL_GET_MSG_TYPE_SUPPORT(test_msgs, msg, name)))
      BOTH(Arrays);
      BOTH(BasicTypes);
      BOTH(BoundedSequences);
      BOTH(MultiNested);
      BOTH(Strings);
      BOTH(UnboundedSequences);
      BOTH(WStrings);
#undef BOTH
      return plans;
    }();
  return made;
}

class Made
{
public:
  explicit Made(const cdr::Plan & plan)
  : plan_(plan), memory_(new uint64_t[(plan.size_of + 7) / 8])
  {
    plan.init(get());
  }

  ~Made() {plan_.fini(get());}

  void * get() {return memory_.get();}

private:
  const cdr::Plan & plan_;
  std::unique_ptr<uint64_t[]> memory_;
};

std::vector<uint8_t> stream_of(const cdr::Plan & plan, const void * message)
{
  std::vector<uint8_t> stream(cdr::encoded_size(plan, message));
  if (cdr::encode(plan, message, stream.data(), stream.size()) != stream.size()) {
    __builtin_trap();
  }
  return stream;
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t * data, size_t size)
{
  if (size == 0) {
    return 0;
  }
  const cdr::Plan & plan = plans()[data[0] % plans().size()];
  // Memory of its own, so that a read beyond it is seen.
  const std::unique_ptr<uint8_t[]> input(new uint8_t[size - 1]);
  std::memcpy(input.get(), data + 1, size - 1);
  Made message(plan);
  try {
    cdr::decode(plan, input.get(), size - 1, message.get());
  } catch (const cdr::Error &) {
    return 0;
  }
  const std::vector<uint8_t> once = stream_of(plan, message.get());
  Made again(plan);
  cdr::decode(plan, once.data(), once.size(), again.get());
  if (stream_of(plan, again.get()) != once) {
    __builtin_trap();
  }
  return 0;
}
