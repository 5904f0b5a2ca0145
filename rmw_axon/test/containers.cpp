// SPDX-License-Identifier: MIT OR Apache-2.0

// Tests sequences whose container is neither a std::vector nor C's data, size and capacity. rosidl 5.1.4 made
// uint8[] one of these. The containers here belong to no distribution, so that the test runs on all of them.

#include <gtest/gtest.h>

#include <algorithm>
#include <cstddef>
#include <cstring>
#include <deque>
#include <memory>
#include <string>
#include <vector>

#include "made.hpp"

namespace cdr = rmw_axon::cdr;

namespace
{

using made::Bytes;

// A container as large as a std::vector, with its fields in another order.
template<typename Item>
class Counted
{
public:
  size_t size() const {return size_;}
  Item & operator[](size_t index) {return items_[index];}
  const Item & operator[](size_t index) const {return items_[index];}

  void resize(size_t size)
  {
    auto items = std::make_unique<Item[]>(size);
    for (size_t i = 0; i < std::min(size, size_); ++i) {
      items[i] = std::move(items_[i]);
    }
    items_ = std::move(items);
    size_ = size;
    capacity_ = size;
  }

private:
  size_t size_ = 0;
  std::unique_ptr<Item[]> items_;
  size_t capacity_ = 0;
};

// Eight bytes, with the items elsewhere: as large as rosidl::Buffer.
template<typename Item>
class Boxed
{
public:
  size_t size() const {return items_->size();}
  void resize(size_t size) {items_->resize(size);}
  Item & operator[](size_t index) {return (*items_)[index];}
  const Item & operator[](size_t index) const {return (*items_)[index];}

private:
  std::unique_ptr<Counted<Item>> items_ = std::make_unique<Counted<Item>>();
};

struct Point
{
  double x = 0;
  int16_t y = 0;
};

// Values stand behind sequences, where a write beyond these would change them. The last one ends the message.
template<template<typename ...> class Sequence>
struct Mixed
{
  Sequence<uint8_t> bytes;
  uint64_t first = 0x1111111111111111;
  Sequence<double> doubles;
  uint64_t second = 0x2222222222222222;
  Sequence<std::string> strings;
  Sequence<std::u16string> wide;
  Sequence<Point> points;
  uint64_t third = 0x3333333333333333;
  Sequence<bool> flags;
  Sequence<uint16_t> at_most_three;
  Sequence<uint8_t> last;
};

template<typename Item>
using Vector = std::vector<Item>;
template<typename Item>
using Deque = std::deque<Item>;

const made::CppType<Point> & point()
{
  static const made::CppType<Point> type = [] {
      made::CppType<Point> type("Point");
      type.one("x", made::id::DOUBLE, offsetof(Point, x));
      type.one("y", made::id::INT16, offsetof(Point, y));
      return type;
    }();
  return type;
}

template<template<typename ...> class Sequence>
made::CppType<Mixed<Sequence>> mixed()
{
  using Message = Mixed<Sequence>;
  made::CppType<Message> type("Mixed");
#define SEQUENCE(name, type_id) \
  type.template sequence<decltype(Message::name)>(#name, made::id::type_id, offsetof(Message, name))
  SEQUENCE(bytes, UINT8);
  type.one("first", made::id::UINT64, offsetof(Message, first));
  SEQUENCE(doubles, DOUBLE);
  type.one("second", made::id::UINT64, offsetof(Message, second));
  SEQUENCE(strings, STRING);
  SEQUENCE(wide, WSTRING);
  SEQUENCE(points, MESSAGE).members_ = point().handle();
  type.one("third", made::id::UINT64, offsetof(Message, third));
  SEQUENCE(flags, BOOLEAN);
  auto & bounded = SEQUENCE(at_most_three, UINT16);
  bounded.is_upper_bound_ = true;
  bounded.array_size_ = 3;
  SEQUENCE(last, UINT8);
#undef SEQUENCE
  return type;
}

template<typename Message>
void fill(Message & message, size_t count)
{
  message.bytes.resize(count);
  message.doubles.resize(count);
  message.strings.resize(count);
  message.wide.resize(count);
  message.points.resize(count);
  message.flags.resize(count);
  message.at_most_three.resize(count % 4);
  message.last.resize(count);
  for (size_t i = 0; i < count; ++i) {
    message.bytes[i] = static_cast<uint8_t>(i + 1);
    message.doubles[i] = static_cast<double>(i) / 3;
    message.strings[i] = std::string(i, 's');
    message.wide[i] = std::u16string(i, u'w');
    message.points[i].x = static_cast<double>(i);
    message.points[i].y = static_cast<int16_t>(i);
    message.flags[i] = i % 2 == 0;
    if (i < message.at_most_three.size()) {
      message.at_most_three[i] = static_cast<uint16_t>(i);
    }
    message.last[i] = static_cast<uint8_t>(0xff - i);
  }
}

Bytes of_vectors(size_t count)
{
  Mixed<Vector> message;
  fill(message, count);
  const auto type = mixed<Vector>();
  return made::encoded(cdr::plan(type.handle()), &message);
}

// C: the items are elsewhere, and a count stands where rosidl has the pointer.
struct BoxInC
{
  uint64_t tag;
  Bytes * items;
};

struct MessageInC
{
  BoxInC bytes;
  uint64_t after;
  BoxInC last;
};

void init_in_c(void * message, rosidl_runtime_c__message_initialization)
{
  auto & made = *static_cast<MessageInC *>(message);
  made = {{7, new Bytes}, 0x4444444444444444, {7, new Bytes}};
}

void end_in_c(void * message)
{
  delete static_cast<MessageInC *>(message)->bytes.items;
  delete static_cast<MessageInC *>(message)->last.items;
}

made::CType in_c()
{
  made::CType type("Mixed", sizeof(MessageInC), init_in_c, end_in_c);
  const auto sequence = [&](const char * name, size_t offset) {
      auto & member = type.one(name, made::id::UINT8, offset);
      member.is_array_ = true;
      member.size_function = [](const void * box) {
          return static_cast<const BoxInC *>(box)->items->size();
        };
      member.get_const_function = [](const void * box, size_t index) -> const void * {
          return &(*static_cast<const BoxInC *>(box)->items)[index];
        };
      member.get_function = [](void * box, size_t index) -> void * {
          return &(*static_cast<BoxInC *>(box)->items)[index];
        };
      member.fetch_function = [](const void * box, size_t index, void * into) {
          std::memcpy(into, &(*static_cast<const BoxInC *>(box)->items)[index], 1);
        };
      member.assign_function = [](void * box, size_t index, const void * from) {
          std::memcpy(&(*static_cast<BoxInC *>(box)->items)[index], from, 1);
        };
      member.resize_function = [](void * box, size_t size) {
          static_cast<BoxInC *>(box)->items->resize(size);
          return true;
        };
    };
  sequence("bytes", offsetof(MessageInC, bytes));
  type.one("after", made::id::UINT64, offsetof(MessageInC, after));
  sequence("last", offsetof(MessageInC, last));
  return type;
}

template<template<typename ...> class Sequence>
void round_trips()
{
  using Message = Mixed<Sequence>;
  const auto type = mixed<Sequence>();
  const cdr::Plan plan = cdr::plan(type.handle());
  for (const size_t count : {0, 1, 3, 700}) {
    auto written = std::make_unique<Message>();
    fill(*written, count);
    const Bytes stream = made::encoded(plan, written.get());
    EXPECT_EQ(stream, of_vectors(count));
    // The message holds no items, fewer, or more.
    for (const size_t before : {0, 1, 900}) {
      auto read = std::make_unique<Message>();
      fill(*read, before);
      cdr::decode(plan, stream.data(), stream.size(), read.get());
      EXPECT_EQ(read->first, 0x1111111111111111u);
      EXPECT_EQ(read->second, 0x2222222222222222u);
      EXPECT_EQ(read->third, 0x3333333333333333u);
      EXPECT_EQ(made::encoded(plan, read.get()), stream);
    }
  }
}

}  // namespace

TEST(Containers, sequence_of_eight_bytes_is_read_and_written_through_its_functions)
{
  round_trips<Boxed>();
}

TEST(Containers, sequence_in_another_order_than_a_vectors_is_read_and_written)
{
  round_trips<Counted>();
}

TEST(Containers, sequence_whose_items_are_not_adjacent_is_read_and_written)
{
  round_trips<Deque>();
}

TEST(Containers, vectors_are_read_and_written)
{
  round_trips<Vector>();
}

TEST(Containers, sequence_in_c_of_another_layout_is_read_and_written)
{
  const auto type = in_c();
  const cdr::Plan plan = cdr::plan(type.handle());
  made::Message written(plan);
  auto & from = *static_cast<MessageInC *>(written.get());
  *from.bytes.items = {1, 2, 3};
  from.last.items->assign(700, 9);
  const Bytes stream = made::encoded(plan, written.get());
  const Bytes start = {0, 1, 0, 0, 3, 0, 0, 0, 1, 2, 3, 0};
  EXPECT_EQ(Bytes(stream.begin(), stream.begin() + start.size()), start);
  made::Message read(plan);
  cdr::decode(plan, stream.data(), stream.size(), read.get());
  auto & into = *static_cast<MessageInC *>(read.get());
  EXPECT_EQ(*into.bytes.items, *from.bytes.items);
  EXPECT_EQ(*into.last.items, *from.last.items);
  EXPECT_EQ(into.after, 0x4444444444444444u);
}

TEST(Containers, streams_cut_anywhere_and_in_the_other_byte_order_are_judged_alike)
{
  const auto boxed = mixed<Boxed>();
  const auto vectors = mixed<Vector>();
  const cdr::Plan plan = cdr::plan(boxed.handle());
  const cdr::Plan known = cdr::plan(vectors.handle());
  const Bytes whole = of_vectors(5);
  for (size_t size = 0; size < whole.size(); ++size) {
    for (const bool little : {false, true}) {
      // The stream is on the heap, so that AddressSanitizer detects a read beyond its end.
      const std::unique_ptr<uint8_t[]> cut(new uint8_t[size + 2]);
      std::memcpy(cut.get(), whole.data(), size);
      cut[1] = size > 1 && little;
      made::Message message(plan);
      made::Message same(known);
      std::string refused;
      std::string expected;
      try {
        cdr::decode(plan, cut.get(), size, message.get());
      } catch (const cdr::Error & error) {
        refused = error.what();
      }
      try {
        cdr::decode(known, cut.get(), size, same.get());
      } catch (const cdr::Error & error) {
        expected = error.what();
      }
      EXPECT_EQ(refused.empty(), expected.empty()) << size << ": " << refused << " / " << expected;
    }
  }
}

TEST(Containers, vectors_of_all_but_bool_are_known_and_nothing_else_is)
{
  const auto vectors = mixed<Vector>();
  for (const cdr::Field & field : cdr::plan(vectors.handle()).fields) {
    if (field.shape == cdr::Shape::Sequence) {
      const bool known = field.item != cdr::Item::Bool;
      EXPECT_EQ(field.container, known ? cdr::Container::Contiguous : cdr::Container::Opaque) << field.name;
    }
  }
  const auto boxed = mixed<Boxed>();
  const auto counted = mixed<Counted>();
  const auto deque = mixed<Deque>();
  const auto c = in_c();
  for (const auto * handle : {boxed.handle(), counted.handle(), deque.handle(), c.handle()}) {
    for (const cdr::Field & field : cdr::plan(handle).fields) {
      EXPECT_EQ(field.container, cdr::Container::Opaque) << field.name;
    }
  }
}

TEST(Containers, field_that_has_less_memory_than_its_type_takes_is_refused)
{
  struct Small
  {
    uint64_t text;
    uint64_t after;
  };
  for (const bool last : {false, true}) {
    made::CppType<Small> type("Small");
    type.one("text", made::id::STRING, last ? offsetof(Small, after) : offsetof(Small, text));
    type.one("other", made::id::UINT64, last ? offsetof(Small, text) : offsetof(Small, after));
    try {
      cdr::plan(type.handle());
      FAIL();
    } catch (const cdr::Error & error) {
      EXPECT_NE(std::string(error.what()).find("text: has 8 bytes"), std::string::npos) << error.what();
    }
  }
}

TEST(Containers, sequence_without_functions_for_its_items_is_refused)
{
  struct One
  {
    std::vector<double> values;
  };
  made::CppType<One> type("One");
  type.sequence<std::vector<double>>("values", made::id::DOUBLE, 0).assign_function = nullptr;
  EXPECT_THROW(cdr::plan(type.handle()), cdr::Error);
}

TEST(Containers, sequence_that_does_not_take_the_streams_length_is_an_error)
{
  struct One
  {
    Boxed<uint8_t> bytes;
  };
  made::CppType<One> type("One");
  type.sequence<Boxed<uint8_t>>("bytes", made::id::UINT8, 0).resize_function = [](void *, size_t) {};
  const cdr::Plan plan = cdr::plan(type.handle());
  const Bytes stream = {0, 1, 0, 0, 2, 0, 0, 0, 1, 2};
  One message;
  EXPECT_THROW(cdr::decode(plan, stream.data(), stream.size(), &message), cdr::Error);
}
