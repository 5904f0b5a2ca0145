// SPDX-License-Identifier: MIT OR Apache-2.0

// Tests the codec against the streams of another implementation (Fast-CDR behind rosidl's generated code), in
// C and in C++, and against invalid streams.

#include <gtest/gtest.h>

#include <cstring>
#include <memory>
#include <random>
#include <string>
#include <vector>

#include "cdr/codec.hpp"
#include "fastcdr/Cdr.h"
#include "rosidl_typesupport_cpp/message_type_support.hpp"
#include "rosidl_typesupport_fastrtps_cpp/identifier.hpp"
#include "rosidl_typesupport_fastrtps_cpp/message_type_support.h"
#include "test_msgs/message_fixtures.hpp"
#include "test_msgs/msg/arrays.h"
#include "test_msgs/msg/basic_types.h"
#include "test_msgs/msg/bounded_sequences.h"
#include "test_msgs/msg/builtins.h"
#include "test_msgs/msg/constants.h"
#include "test_msgs/msg/defaults.h"
#include "test_msgs/msg/empty.h"
#include "test_msgs/msg/multi_nested.h"
#include "test_msgs/msg/nested.h"
#include "test_msgs/msg/strings.h"
#include "test_msgs/msg/unbounded_sequences.h"
#include "test_msgs/msg/w_strings.h"

// Humble has Fast-CDR 1.
#if __has_include("fastcdr/CdrSizeCalculator.hpp")
#define AXON_FAST_CDR_2 1
#else
#define AXON_FAST_CDR_2 0
#endif

namespace cdr = rmw_axon::cdr;
using Bytes = std::vector<uint8_t>;
using Cdr = eprosima::fastcdr::Cdr;

namespace
{

template<typename Message>
const rosidl_message_type_support_t * handle()
{
  return rosidl_typesupport_cpp::get_message_type_support_handle<Message>();
}

template<typename Message>
Bytes foreign(const Message & message, Cdr::Endianness order)
{
  const auto * support = get_message_typesupport_handle(
    handle<Message>(), rosidl_typesupport_fastrtps_cpp::typesupport_identifier);
  const auto * callbacks = static_cast<const message_type_support_callbacks_t *>(support->data);
  Bytes bytes(callbacks->get_serialized_size(&message) + 64);
  eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char *>(bytes.data()), bytes.size());
#if AXON_FAST_CDR_2
  Cdr stream(buffer, order, eprosima::fastcdr::CdrVersion::XCDRv1);
  stream.set_encoding_flag(eprosima::fastcdr::EncodingAlgorithmFlag::PLAIN_CDR);
#else
  Cdr stream(buffer, order, Cdr::DDS_CDR);
#endif
  stream.serialize_encapsulation();
  EXPECT_TRUE(callbacks->cdr_serialize(&message, stream));
#if AXON_FAST_CDR_2
  bytes.resize(stream.get_serialized_data_length());
#else
  bytes.resize(stream.getSerializedDataLength());
#endif
  return bytes;
}

Bytes ours(const cdr::Plan & plan, const void * message)
{
  Bytes bytes(cdr::encoded_size(plan, message));
  EXPECT_EQ(cdr::encode(plan, message, bytes.data(), bytes.size()), bytes.size());
  return bytes;
}

// A message of a plan's type, in memory that AddressSanitizer knows the end of.
class Made
{
public:
  explicit Made(const cdr::Plan & plan)
  : plan_(plan), memory_(std::make_unique<uint64_t[]>((plan.size_of + 7) / 8))
  {
    plan.init(get());
  }

  ~Made() {plan_.fini(get());}

  void * get() {return memory_.get();}

private:
  const cdr::Plan & plan_;
  std::unique_ptr<uint64_t[]> memory_;
};

// Returns the byte orders in which Fast-CDR writes valid streams. Fast-CDR 1 swaps the bytes of its own
// pointer where it should swap those of an array's items: its streams in the other order cannot be read.
std::vector<Cdr::Endianness> orders()
{
#if AXON_FAST_CDR_2
  return {Cdr::LITTLE_ENDIANNESS, Cdr::BIG_ENDIANNESS};
#else
  return {Cdr::LITTLE_ENDIANNESS};
#endif
}

template<typename CppMessage>
struct Case
{
  std::vector<typename CppMessage::SharedPtr> messages;
  const rosidl_message_type_support_t * in_c;
};

// Calls `test` with the samples of each type and the type's support in C.
template<typename Test>
void of_every_type(Test test)
{
  using namespace test_msgs::msg;  // NOLINT
#define IN_C(name) ROSIDL_GET_MSG_TYPE_SUPPORT(test_msgs, msg, name)
  test(Case<Empty>{get_messages_empty(), IN_C(Empty)});
  test(Case<BasicTypes>{get_messages_basic_types(), IN_C(BasicTypes)});
  test(Case<Constants>{get_messages_constants(), IN_C(Constants)});
  test(Case<Defaults>{get_messages_defaults(), IN_C(Defaults)});
  test(Case<Strings>{get_messages_strings(), IN_C(Strings)});
  test(Case<Arrays>{get_messages_arrays(), IN_C(Arrays)});
  test(Case<UnboundedSequences>{get_messages_unbounded_sequences(), IN_C(UnboundedSequences)});
  test(Case<BoundedSequences>{get_messages_bounded_sequences(), IN_C(BoundedSequences)});
  test(Case<MultiNested>{get_messages_multi_nested(), IN_C(MultiNested)});
  test(Case<Nested>{get_messages_nested(), IN_C(Nested)});
  test(Case<Builtins>{get_messages_builtins(), IN_C(Builtins)});
  test(Case<WStrings>{get_messages_wstrings(), IN_C(WStrings)});
#undef IN_C
}

}  // namespace

TEST(Codec, writes_fast_cdr_bytes_and_reads_both_byte_orders)
{
  of_every_type(
    [](const auto & type) {
      using Message = std::decay_t<decltype(*type.messages[0])>;
      const cdr::Plan plan = cdr::plan(handle<Message>());
      for (const auto & message : type.messages) {
        const Bytes stream = ours(plan, message.get());
        EXPECT_EQ(stream, foreign(*message, Cdr::LITTLE_ENDIANNESS)) << plan.type;
        for (const auto order : orders()) {
          const Bytes from = foreign(*message, order);
          Message read;
          cdr::decode(plan, from.data(), from.size(), &read);
          EXPECT_EQ(read, *message) << plan.type;
          // The message already holds values.
          for (const auto & before : type.messages) {
            Message used = *before;
            cdr::decode(plan, from.data(), from.size(), &used);
            EXPECT_EQ(used, *message) << plan.type;
          }
        }
      }
    });
}

TEST(Codec, messages_in_c_have_the_same_streams)
{
  of_every_type(
    [](const auto & type) {
      using Message = std::decay_t<decltype(*type.messages[0])>;
      const cdr::Plan cpp = cdr::plan(handle<Message>());
      const cdr::Plan c = cdr::plan(type.in_c);
      EXPECT_EQ(c.language, cdr::Language::C);
      EXPECT_EQ(c.type, cpp.type);
      EXPECT_EQ(c.fixed, cpp.fixed) << c.type;
      EXPECT_EQ(c.plain, cpp.plain) << c.type;
      Made made(c);
      for (const auto & message : type.messages) {
        for (const auto order : orders()) {
          const Bytes from = foreign(*message, order);
          cdr::decode(c, from.data(), from.size(), made.get());
          EXPECT_EQ(ours(c, made.get()), ours(cpp, message.get())) << c.type;
        }
      }
    });
}

TEST(Codec, a_stream_cut_anywhere_is_an_error_and_no_read_beyond_it)
{
  of_every_type(
    [](const auto & type) {
      using Message = std::decay_t<decltype(*type.messages[0])>;
      for (const auto * support : {handle<Message>(), type.in_c}) {
        const cdr::Plan plan = cdr::plan(support);
        for (const auto & message : type.messages) {
          const Bytes whole = foreign(*message, Cdr::LITTLE_ENDIANNESS);
          const size_t step = 1 + whole.size() / 500;
          for (size_t size = 0; size < whole.size(); size += step) {
            const std::unique_ptr<uint8_t[]> cut(new uint8_t[size]);
            std::memcpy(cut.get(), whole.data(), size);
            Made made(plan);
            EXPECT_THROW(cdr::decode(plan, cut.get(), size, made.get()), cdr::Error)
              << plan.type << ", " << size << " of " << whole.size();
          }
        }
      }
    });
}

TEST(Codec, random_changes_end_in_a_message_or_an_error)
{
  std::mt19937 random(7);
  of_every_type(
    [&](const auto & type) {
      using Message = std::decay_t<decltype(*type.messages[0])>;
      for (const auto * support : {handle<Message>(), type.in_c}) {
        const cdr::Plan plan = cdr::plan(support);
        for (const auto & message : type.messages) {
          const Bytes whole = foreign(*message, Cdr::LITTLE_ENDIANNESS);
          for (int round = 0; round < 300; ++round) {
            Bytes bytes = whole;
            for (uint32_t changes = random() % 8 + 1; changes-- > 0; ) {
              const uint8_t values[] = {0, 1, 2, 0x7f, 0x80, 0xff, static_cast<uint8_t>(random())};
              bytes[random() % bytes.size()] = values[random() % sizeof(values)];
            }
            Made made(plan);
            try {
              cdr::decode(plan, bytes.data(), bytes.size(), made.get());
              ours(plan, made.get());
            } catch (const cdr::Error &) {
            }
          }
        }
      }
    });
}

TEST(Codec, a_length_allocates_nothing_that_the_stream_could_not_hold)
{
  // 2^32 - 1 items announced, none there: an allocation of that size would throw bad_alloc, or end the test.
  const cdr::Plan plan = cdr::plan(handle<test_msgs::msg::UnboundedSequences>());
  const Bytes stream = {0, 1, 0, 0, 0xff, 0xff, 0xff, 0xff, 0, 0};
  test_msgs::msg::UnboundedSequences message;
  EXPECT_THROW(cdr::decode(plan, stream.data(), stream.size(), &message), cdr::Error);
}

TEST(Codec, bounds_hold_in_both_directions)
{
  const cdr::Plan plan = cdr::plan(handle<test_msgs::msg::Strings>());
  test_msgs::msg::Strings message;
  message.bounded_string_value = std::string(23, 'x');
  EXPECT_THROW(cdr::encoded_size(plan, &message), cdr::Error);
  message.bounded_string_value.pop_back();
  Bytes stream = ours(plan, &message);
  cdr::decode(plan, stream.data(), stream.size(), &message);

  const cdr::Plan wide = cdr::plan(handle<test_msgs::msg::UnboundedSequences>());
  const cdr::Plan bounded = cdr::plan(handle<test_msgs::msg::BoundedSequences>());
  test_msgs::msg::UnboundedSequences many;
  many.bool_values.resize(4);
  stream = ours(wide, &many);
  test_msgs::msg::BoundedSequences few;
  EXPECT_THROW(cdr::decode(bounded, stream.data(), stream.size(), &few), cdr::Error);
}

TEST(Codec, a_bool_is_true_or_false)
{
  const cdr::Plan plan = cdr::plan(handle<test_msgs::msg::BasicTypes>());
  test_msgs::msg::BasicTypes message;
  Bytes stream = ours(plan, &message);
  stream[cdr::HEADER] = 2;
  cdr::decode(plan, stream.data(), stream.size(), &message);
  uint8_t memory = 0;
  std::memcpy(&memory, &message.bool_value, 1);
  EXPECT_EQ(memory, 1);

  // The byte stands for memory that the program has not set.
  memory = 0x7f;
  std::memcpy(static_cast<void *>(&message.bool_value), &memory, 1);
  stream = ours(plan, &message);
  EXPECT_EQ(stream[cdr::HEADER], 1);
}

TEST(Codec, an_unknown_representation_is_refused_by_number)
{
  const cdr::Plan plan = cdr::plan(handle<test_msgs::msg::BasicTypes>());
  test_msgs::msg::BasicTypes message;
  Bytes stream = ours(plan, &message);
  stream[1] = 7;
  try {
    cdr::decode(plan, stream.data(), stream.size(), &message);
    FAIL();
  } catch (const cdr::Error & error) {
    EXPECT_NE(std::string(error.what()).find("representation 7"), std::string::npos);
  }
}

TEST(Codec, a_plain_message_is_read_where_it_lies)
{
  const cdr::Plan plan = cdr::plan(handle<test_msgs::msg::BasicTypes>());
  ASSERT_TRUE(plan.plain && plan.has_bool);
  for (const auto & message : get_messages_basic_types()) {
    Bytes stream = ours(plan, message.get());
    stream.resize(cdr::HEADER + plan.size_of);
    ASSERT_TRUE(cdr::readable_in_place(plan, stream.data(), stream.size()));
    test_msgs::msg::BasicTypes read;
    std::memcpy(static_cast<void *>(&read), stream.data() + cdr::HEADER, sizeof(read));
    EXPECT_EQ(read, *message);
    // A short stream, one with an invalid bool, and one in the other byte order are not readable in place.
    EXPECT_FALSE(cdr::readable_in_place(plan, stream.data(), stream.size() - 1));
    stream[cdr::HEADER] = 2;
    EXPECT_FALSE(cdr::readable_in_place(plan, stream.data(), stream.size()));
    stream[cdr::HEADER] = 1;
    stream[1] ^= 1;
    EXPECT_FALSE(cdr::readable_in_place(plan, stream.data(), stream.size()));
  }
  EXPECT_FALSE(cdr::plan(handle<test_msgs::msg::Strings>()).plain);
  EXPECT_FALSE(cdr::plan(handle<test_msgs::msg::UnboundedSequences>()).plain);
}

TEST(Codec, a_type_support_without_introspection_is_named)
{
  const auto find = [](const rosidl_message_type_support_t *, const char *) {
      return static_cast<const rosidl_message_type_support_t *>(nullptr);
    };
  // Humble's has three members, later ones have six.
  rosidl_message_type_support_t none{};
  none.typesupport_identifier = "a_stranger";
  none.func = find;
  try {
    cdr::plan(&none);
    FAIL();
  } catch (const cdr::Error & error) {
    EXPECT_NE(std::string(error.what()).find("a_stranger"), std::string::npos);
  }
}
