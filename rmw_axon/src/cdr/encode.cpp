// SPDX-License-Identifier: MIT OR Apache-2.0

#include <cfloat>
#include <cstring>
#include <limits>
#include <string>

#include "cdr/codec.hpp"
#include "cdr/items.hpp"

namespace rmw_axon::cdr
{

namespace
{

[[noreturn, gnu::cold, gnu::noinline]] void changed()
{
  throw Error("the message changed while it was written");
}

[[noreturn, gnu::cold, gnu::noinline]] void too_long(
  const Field & field, size_t length, size_t most, const char * what)
{
  throw Error(
          std::string(field.name) + ": " + std::to_string(length) + " " + what + ", at most " +
          std::to_string(most) + " are allowed");
}

size_t aligned(size_t position, size_t alignment)
{
  return (position + alignment - 1) & ~(alignment - 1);
}

// Counts.
class Measure
{
public:
  void align(size_t alignment) {position_ = aligned(position_, alignment);}
  void copy(const void *, size_t size) {position_ += size;}
  void copy_buffer(const void *, size_t size) {position_ += size;}
  void zeros(size_t size) {position_ += size;}
  size_t position() const {return position_;}

private:
  size_t position_ = 0;
};

// Writes.
class Writer
{
public:
  Writer(uint8_t * body, size_t capacity)
  : body_(body), capacity_(capacity) {}

  void align(size_t alignment)
  {
    zeros(aligned(position_, alignment) - position_);
  }

  void copy(const void * from, size_t size)
  {
    std::memcpy(room(size), from, size);
  }

  void copy_buffer(const void * from, size_t size)
  {
    if (!buffer::copy_to(from, room(size), size)) {
      changed();
    }
  }

  void zeros(size_t size)
  {
    std::memset(room(size), 0, size);
  }

  size_t position() const {return position_;}

private:
  uint8_t * room(size_t size)
  {
    // Another thread made the message longer while it was published.
    if (size > capacity_ - position_) {
      changed();
    }
    uint8_t * at = body_ + position_;
    position_ += size;
    return at;
  }

  uint8_t * body_;
  size_t capacity_;
  size_t position_ = 0;
};

template<typename Sink, typename Number>
void put(Sink & sink, Number number)
{
  sink.align(sizeof(number));
  sink.copy(&number, sizeof(number));
}

template<typename Sink>
void put_length(Sink & sink, size_t length, const Field & field)
{
  if (length > std::numeric_limits<uint32_t>::max()) {
    too_long(field, length, std::numeric_limits<uint32_t>::max(), "items");
  }
  put(sink, static_cast<uint32_t>(length));
}

void check(size_t length, size_t most, const char * what, const Field & field)
{
  if (length > most) {
    too_long(field, length, most, what);
  }
}

template<typename Sink>
void put_long_doubles(Sink & sink, const uint8_t * from, size_t count, const Field & field)
{
  sink.align(field.alignment);
  for (size_t i = 0; i < count; ++i) {
    // A long double of the x87 has ten bytes of value and six undefined bytes.
    constexpr size_t value = LDBL_MANT_DIG == 64 ? 10 : sizeof(long double);
    sink.copy(from + i * field.stride, value);
    sink.zeros(field.width - value);
  }
}

// Returns whether adjacent messages are written by one copy: there is no byte between their fields, where
// other data of the program could leak.
bool dense(const Plan & plan)
{
  return plan.plain && plan.fields.front().run_bytes == plan.size_of;
}

template<typename In, typename Sink>
void put_message(const Plan & plan, const uint8_t * message, Sink & sink);

// Writes `count` adjacent items.
template<typename In, typename Sink>
void put_items(const Field & field, const uint8_t * from, size_t count, Sink & sink)
{
  switch (field.item) {
    case Item::Number:
      sink.align(field.alignment);
      sink.copy(from, count * field.width);
      return;
    case Item::Bool:
      // A C program that did not set the bool leaves any byte there; every byte except 0 is true.
      for (size_t i = 0; i < count; ++i) {
        put(sink, static_cast<uint8_t>(from[i] != 0));
      }
      return;
    case Item::LongDouble:
      return put_long_doubles(sink, from, count, field);
    case Item::WChar:
      for (size_t i = 0; i < count; ++i) {
        char16_t character;
        std::memcpy(&character, from + i * field.stride, sizeof(character));
        put(sink, static_cast<uint32_t>(character));
      }
      return;
    case Item::String:
      for (size_t i = 0; i < count; ++i) {
        const std::string_view text = In::string(from + i * field.stride);
        check(text.size(), field.characters, "characters", field);
        put_length(sink, text.size() + 1, field);
        sink.copy(text.data(), text.size());
        sink.zeros(1);
      }
      return;
    case Item::WString:
      for (size_t i = 0; i < count; ++i) {
        const std::u16string_view text = In::wide(from + i * field.stride);
        check(text.size(), field.characters, "characters", field);
        put_length(sink, text.size(), field);
        for (const char16_t character : text) {
          put(sink, static_cast<uint32_t>(character));
        }
      }
      return;
    case Item::Message:
      if (dense(*field.message) && sink.position() % field.message->alignment == 0) {
        sink.copy(from, count * field.stride);
        return;
      }
      for (size_t i = 0; i < count; ++i) {
        put_message<In>(*field.message, from + i * field.stride, sink);
      }
      return;
  }
}

// Writes `size` items, which the introspection's functions return one by one. A std::vector<bool> has no item
// to point to.
template<typename In, typename Sink>
void put_each(const Field & field, const uint8_t * sequence, size_t size, Sink & sink)
{
  if (field.item == Item::Bool) {
    for (size_t i = 0; i < size; ++i) {
      bool value = false;
      field.fetch(sequence, i, &value);
      put(sink, static_cast<uint8_t>(value));
    }
    return;
  }
  OneItem item;
  for (size_t i = 0; i < size; ++i) {
    if (field.width != 0) {
      field.fetch(sequence, i, item.bytes);
      put_items<In>(field, item.bytes, 1, sink);
    } else {
      put_items<In>(field, static_cast<const uint8_t *>(field.at(sequence, i)), 1, sink);
    }
  }
}

template<typename In, typename Sink>
void put_sequence(const Field & field, const uint8_t * sequence, Sink & sink)
{
  const void * buffer = In::buffer(field, sequence);
  const size_t size = buffer != nullptr ? buffer::size(buffer) : In::size(field, sequence);
  check(size, field.count, "items", field);
  put_length(sink, size, field);
  if (size == 0) {
    return;
  }
  if (buffer != nullptr) {
    sink.copy_buffer(buffer, size);
  } else if (field.container == Container::Contiguous) {
    put_items<In>(field, In::items(field, static_cast<const void *>(sequence)), size, sink);
  } else {
    put_each<In>(field, sequence, size, sink);
  }
}

template<typename In, typename Sink>
void put_message(const Plan & plan, const uint8_t * message, Sink & sink)
{
  for (size_t i = 0; i < plan.fields.size(); ) {
    const Field & field = plan.fields[i];
    if (field.run_fields > 1) {
      sink.align(field.alignment);
      if (((sink.position() ^ field.offset) & (field.run_alignment - 1)) == 0) {
        sink.copy(message + field.offset, field.run_bytes);
        i += field.run_fields;
        continue;
      }
    }
    if (field.shape == Shape::Sequence) {
      put_sequence<In>(field, message + field.offset, sink);
    } else {
      put_items<In>(field, message + field.offset, field.count, sink);
    }
    ++i;
  }
}

template<typename Sink>
void put_body(const Plan & plan, const void * message, Sink & sink)
{
  const auto * bytes = static_cast<const uint8_t *>(message);
  if (plan.language == Language::C) {
    put_message<InC>(plan, bytes, sink);
  } else {
    put_message<InCpp>(plan, bytes, sink);
  }
}

}  // namespace

size_t encoded_size(const Plan & plan, const void * message)
{
  if (plan.fixed) {
    return HEADER + *plan.fixed;
  }
  Measure measure;
  put_body(plan, message, measure);
  return HEADER + measure.position();
}

size_t encode(const Plan & plan, const void * message, uint8_t * out, size_t capacity)
{
  if (capacity < HEADER) {
    throw Error("no room for the header");
  }
  write_header(out);
  Writer writer(out + HEADER, capacity - HEADER);
  put_body(plan, message, writer);
  return HEADER + writer.position();
}

void write_header(uint8_t * out)
{
  // The representation identifier, CDR_BE (0x0000) or CDR_LE (0x0001), and two bytes of options.
  const uint16_t one = 1;
  uint8_t little = 0;
  std::memcpy(&little, &one, 1);
  const uint8_t header[HEADER] = {0, little, 0, 0};
  std::memcpy(out, header, HEADER);
}

}  // namespace rmw_axon::cdr
