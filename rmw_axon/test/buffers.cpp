// SPDX-License-Identifier: MIT OR Apache-2.0

// rosidl::Buffer<uint8_t> in C++ and within a sequence in C, with its bytes in memory and on a device.
// Built where the distribution has it.

#include <gtest/gtest.h>

#include <cstddef>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "made.hpp"
#include "rosidl_buffer/buffer.hpp"
#include "rosidl_runtime_c/primitives_sequence_functions.h"

namespace cdr = rmw_axon::cdr;

namespace
{

using made::Bytes;
using Buffer = rosidl::Buffer<uint8_t>;
using Sequence = rosidl_runtime_c__uint8__Sequence;

// Bytes that only a copy brings into memory.
class Device : public rosidl::BufferImplBase<uint8_t>
{
public:
  explicit Device(Bytes bytes)
  : bytes_(std::move(bytes)) {}

  std::string get_backend_type() const override {return "device";}
  size_t size() const override {return bytes_.size();}

  std::unique_ptr<rosidl::BufferImplBase<uint8_t>> to_cpu() const override
  {
    auto copy = std::make_unique<rosidl::CpuBufferImpl<uint8_t>>();
    copy->get_storage() = bytes_;
    return copy;
  }

  std::unique_ptr<rosidl::BufferImplBase<uint8_t>> clone() const override
  {
    return std::make_unique<Device>(bytes_);
  }

private:
  Bytes bytes_;
};

Buffer on_device(const Bytes & bytes)
{
  return Buffer(std::make_unique<Device>(bytes));
}

struct Image
{
  uint32_t width = 0;
  Buffer data;
  uint64_t after = 0x5555555555555555;
  Buffer last;
};

made::CppType<Image> image()
{
  made::CppType<Image> type("Image");
  type.one("width", rosidl_typesupport_introspection_c__ROS_TYPE_UINT32, offsetof(Image, width));
  type.sequence<Buffer>("data", made::id::UINT8, offsetof(Image, data)).is_rosidl_buffer_ = true;
  type.one("after", made::id::UINT64, offsetof(Image, after));
  type.sequence<Buffer>("last", made::id::UINT8, offsetof(Image, last)).is_rosidl_buffer_ = true;
  return type;
}

struct ImageInC
{
  uint32_t width;
  Sequence data;
  uint64_t after;
  Sequence last;
};

void init_in_c(void * message, rosidl_runtime_c__message_initialization)
{
  auto & made = *static_cast<ImageInC *>(message);
  made.width = 0;
  made.after = 0x5555555555555555;
  rosidl_runtime_c__uint8__Sequence__init(&made.data, 0);
  rosidl_runtime_c__uint8__Sequence__init(&made.last, 0);
}

void end_in_c(void * message)
{
  rosidl_runtime_c__uint8__Sequence__fini(&static_cast<ImageInC *>(message)->data);
  rosidl_runtime_c__uint8__Sequence__fini(&static_cast<ImageInC *>(message)->last);
}

made::CType image_in_c()
{
  made::CType type("Image", sizeof(ImageInC), init_in_c, end_in_c);
  const auto sequence = [&](const char * name, size_t offset) {
      auto & member = type.one(name, made::id::UINT8, offset);
      member.is_array_ = true;
      member.is_rosidl_buffer_ = true;
      member.size_function = [](const void * sequence) {
          return static_cast<const Sequence *>(sequence)->size;
        };
      member.get_const_function = [](const void * sequence, size_t index) -> const void * {
          return static_cast<const Sequence *>(sequence)->data + index;
        };
      member.get_function = [](void * sequence, size_t index) -> void * {
          return static_cast<Sequence *>(sequence)->data + index;
        };
      member.fetch_function = [](const void * sequence, size_t index, void * into) {
          *static_cast<uint8_t *>(into) = static_cast<const Sequence *>(sequence)->data[index];
        };
      member.assign_function = [](void * sequence, size_t index, const void * from) {
          static_cast<Sequence *>(sequence)->data[index] = *static_cast<const uint8_t *>(from);
        };
      member.resize_function = [](void * sequence, size_t size) {
          rosidl_runtime_c__uint8__Sequence__fini(static_cast<Sequence *>(sequence));
          return rosidl_runtime_c__uint8__Sequence__init(static_cast<Sequence *>(sequence), size);
        };
    };
  type.one("width", rosidl_typesupport_introspection_c__ROS_TYPE_UINT32, offsetof(ImageInC, width));
  sequence("data", offsetof(ImageInC, data));
  type.one("after", made::id::UINT64, offsetof(ImageInC, after));
  sequence("last", offsetof(ImageInC, last));
  return type;
}

// Makes the sequence hold a Buffer: not owned and with size 0, as rclpy does, or owned, as a typesupport that
// reads a Buffer does.
void hold(Sequence & sequence, Buffer * buffer, bool owned)
{
  rosidl_runtime_c__uint8__Sequence__fini(&sequence);
  sequence.data = reinterpret_cast<uint8_t *>(buffer);
  sequence.size = owned ? buffer->size() : 0;
  sequence.is_rosidl_buffer = true;
  sequence.owns_rosidl_buffer = owned;
}

Bytes many(size_t count, uint8_t value)
{
  return Bytes(count, value);
}

// Returns the stream of an Image, written by the rules of CDR.
Bytes stream_of(uint32_t width, const Bytes & data, const Bytes & last)
{
  Bytes stream = {0, 1, 0, 0};
  const auto number = [&](uint64_t value, size_t size) {
      while ((stream.size() - 4) % size != 0) {
        stream.push_back(0);
      }
      for (size_t i = 0; i < size; ++i) {
        stream.push_back(static_cast<uint8_t>(value >> 8 * i));
      }
    };
  number(width, 4);
  number(data.size(), 4);
  stream.insert(stream.end(), data.begin(), data.end());
  number(0x5555555555555555, 8);
  number(last.size(), 4);
  stream.insert(stream.end(), last.begin(), last.end());
  return stream;
}

}  // namespace

TEST(Buffers, buffers_in_cpp_are_read_and_written)
{
  const auto type = image();
  const cdr::Plan plan = cdr::plan(type.handle());
  for (const size_t count : {0, 1, 5000}) {
    auto written = std::make_unique<Image>();
    written->width = 3;
    written->data = many(count, 7);
    written->last = many(count + 1, 8);
    const Bytes stream = made::encoded(plan, written.get());
    EXPECT_EQ(stream, stream_of(3, many(count, 7), many(count + 1, 8)));
    auto read = std::make_unique<Image>();
    read->data = many(900, 1);
    cdr::decode(plan, stream.data(), stream.size(), read.get());
    EXPECT_EQ(read->data.to_vector(), many(count, 7));
    EXPECT_EQ(read->after, 0x5555555555555555u);
    EXPECT_EQ(read->last.to_vector(), many(count + 1, 8));
  }
}

TEST(Buffers, bytes_of_a_device_are_written_and_bytes_that_come_are_in_memory)
{
  const auto type = image();
  const cdr::Plan plan = cdr::plan(type.handle());
  Image message;
  message.data = on_device(many(300, 7));
  message.last = on_device({});
  const Bytes stream = made::encoded(plan, &message);
  EXPECT_EQ(stream, stream_of(0, many(300, 7), {}));
  cdr::decode(plan, stream.data(), stream.size(), &message);
  EXPECT_EQ(message.data.get_backend_type(), "cpu");
  EXPECT_EQ(message.data.to_vector(), many(300, 7));
}

TEST(Buffers, stream_that_is_too_short_for_its_length_is_an_error)
{
  const auto type = image();
  const cdr::Plan plan = cdr::plan(type.handle());
  const Bytes whole = stream_of(3, many(9, 7), many(2, 8));
  for (size_t size = 0; size < whole.size(); ++size) {
    Image message;
    EXPECT_THROW(cdr::decode(plan, whole.data(), size, &message), cdr::Error) << size;
  }
}

TEST(Buffers, sequences_in_c_are_read_and_written_without_a_buffer)
{
  const auto type = image_in_c();
  const cdr::Plan plan = cdr::plan(type.handle());
  made::Message message(plan);
  const Bytes stream = stream_of(3, many(700, 7), many(2, 8));
  cdr::decode(plan, stream.data(), stream.size(), message.get());
  EXPECT_EQ(made::encoded(plan, message.get()), stream);
}

TEST(Buffers, buffer_that_a_sequence_in_c_holds_is_written_and_is_not_written_to)
{
  const auto type = image_in_c();
  const cdr::Plan plan = cdr::plan(type.handle());
  const Bytes stream = stream_of(0, many(8, 7), many(300, 9));
  for (const bool owned : {false, true}) {
    Buffer here(many(8, 7));
    Buffer elsewhere = on_device(many(300, 9));
    made::Message message(plan);
    auto & image = *static_cast<ImageInC *>(message.get());
    hold(image.data, owned ? new Buffer(here) : &here, owned);
    hold(image.last, owned ? new Buffer(elsewhere) : &elsewhere, owned);
    EXPECT_EQ(made::encoded(plan, message.get()), stream);
    // The new content has the same length as the current one.
    const Bytes other = stream_of(0, many(8, 1), many(300, 2));
    cdr::decode(plan, other.data(), other.size(), message.get());
    EXPECT_FALSE(image.data.is_rosidl_buffer || image.last.is_rosidl_buffer);
    EXPECT_EQ(made::encoded(plan, message.get()), other);
    EXPECT_EQ(here.to_vector(), many(8, 7));
  }
}
