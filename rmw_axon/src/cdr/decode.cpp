// SPDX-License-Identifier: MIT OR Apache-2.0

#include <algorithm>
#include <cstring>
#include <limits>
#include <string>

#include "cdr/codec.hpp"
#include "cdr/items.hpp"

namespace rmw_axon::cdr
{

namespace
{

// Keeps the compiler from reading `value` from the stream again: the second read could differ.
template<typename Number>
Number once(Number value)
{
  asm volatile ("" : "+r" (value));
  return value;
}

// Kept out of line, because valid streams never reach it.
[[noreturn, gnu::cold, gnu::noinline]] void fail(const Field & field, const char * what)
{
  throw Error(std::string(field.name) + ": " + what);
}

[[noreturn, gnu::cold, gnu::noinline]] void fail_of(
  const Field & field, size_t length, const char * what, size_t most)
{
  throw Error(
          std::string(field.name) + ": " + std::to_string(length) + " items, " + what + " " +
          std::to_string(most));
}

void reverse(uint8_t * bytes, size_t width, size_t count)
{
  for (size_t i = 0; i < count; ++i) {
    std::reverse(bytes + i * width, bytes + (i + 1) * width);
  }
}

class Reader
{
public:
  Reader(const uint8_t * body, size_t size, bool swapped)
  : body_(body), size_(size), swapped_(swapped) {}

  // Returns the next `size` bytes, aligned.
  const uint8_t * bytes(size_t size, size_t alignment, const Field & field)
  {
    align(alignment, field);
    if (size > size_ - position_) {
      fail(field, "the stream ends within it");
    }
    const uint8_t * at = body_ + position_;
    position_ += size;
    return at;
  }

  void align(size_t alignment, const Field & field)
  {
    // An alignment is a power of two.
    const size_t padding = (~position_ + 1) & (alignment - 1);
    if (padding > size_ - position_) {
      fail(field, "the stream ends before it");
    }
    position_ += padding;
  }

  uint32_t word(const Field & field)
  {
    uint32_t value;
    std::memcpy(&value, bytes(sizeof(value), sizeof(value), field), sizeof(value));
    value = once(value);
    return swapped_ ? __builtin_bswap32(value) : value;
  }

  // Reads the length of a sequence or a string, of items that have at least `least` bytes each.
  size_t length(size_t most, size_t least, const Field & field)
  {
    const size_t length = word(field);
    if (length > most) {
      fail_of(field, length, "allowed are", most);
    }
    if (length > (size_ - position_) / least) {
      fail_of(field, length, "the stream ends after", (size_ - position_) / least);
    }
    return length;
  }

  size_t position() const {return position_;}
  bool swapped() const {return swapped_;}

private:
  const uint8_t * body_;
  size_t size_;
  bool swapped_;
  size_t position_ = 0;
};

// Any byte except 0 is true, so that no other value gets into a bool.
uint8_t flag(const uint8_t * at)
{
  return once(*at) != 0;
}

char16_t wide_character(Reader & reader, const Field & field)
{
  const uint32_t character = reader.word(field);
  if (character > std::numeric_limits<char16_t>::max()) {
    fail(field, "a character beyond UTF-16");
  }
  return static_cast<char16_t>(character);
}

template<typename In>
void get_string(const Field & field, void * into, Reader & reader)
{
  // The length includes the terminating byte 0; some writers omit it in an empty string.
  const size_t most = field.characters == SIZE_MAX ? SIZE_MAX : field.characters + 1;
  const size_t length = reader.length(most, 1, field);
  if (length == 0) {
    return In::set_string(into, "", 0);
  }
  const auto * text = reinterpret_cast<const char *>(reader.bytes(length, 1, field));
  if (once(text[length - 1]) != 0) {
    fail(field, "a string that does not end with the byte 0");
  }
  In::set_string(into, text, length - 1);
}

template<typename In>
void get_wide_string(const Field & field, void * into, Reader & reader)
{
  const size_t length = reader.length(field.characters, sizeof(uint32_t), field);
  char16_t * text = In::resize_wide(into, length);
  for (size_t i = 0; i < length; ++i) {
    text[i] = wide_character(reader, field);
  }
}

// Returns whether adjacent messages are read by one copy. The bytes between their fields have no meaning, in
// memory and in the stream.
bool as_in_memory(const Plan & plan)
{
  return plan.plain && !plan.has_bool && *plan.fixed == plan.size_of;
}

template<typename In>
void get_message(const Plan & plan, uint8_t * message, Reader & reader);

// Reads `count` items that are adjacent in memory.
template<typename In>
void get_items(const Field & field, uint8_t * into, size_t count, Reader & reader)
{
  switch (field.item) {
    case Item::Number:
    case Item::LongDouble: {
        const size_t size = count * field.width;
        std::memcpy(into, reader.bytes(size, field.alignment, field), size);
        if (reader.swapped()) {
          reverse(into, field.width, count);
        }
        return;
      }
    case Item::Bool: {
        const uint8_t * from = reader.bytes(count, 1, field);
        for (size_t i = 0; i < count; ++i) {
          into[i] = flag(from + i);
        }
        return;
      }
    case Item::WChar:
      for (size_t i = 0; i < count; ++i) {
        const char16_t character = wide_character(reader, field);
        std::memcpy(into + i * field.stride, &character, sizeof(character));
      }
      return;
    case Item::String:
      for (size_t i = 0; i < count; ++i) {
        get_string<In>(field, into + i * field.stride, reader);
      }
      return;
    case Item::WString:
      for (size_t i = 0; i < count; ++i) {
        get_wide_string<In>(field, into + i * field.stride, reader);
      }
      return;
    case Item::Message:
      if (as_in_memory(*field.message) && !reader.swapped() &&
        reader.position() % field.message->alignment == 0)
      {
        const size_t size = count * field.stride;
        std::memcpy(into, reader.bytes(size, 1, field), size);
        return;
      }
      for (size_t i = 0; i < count; ++i) {
        get_message<In>(*field.message, into + i * field.stride, reader);
      }
      return;
  }
}

size_t least_of_item(const Field & field)
{
  switch (field.item) {
    case Item::String:
    case Item::WString:
      return sizeof(uint32_t);
    case Item::Message:
      return field.message->least;
    default:
      return field.width;
  }
}

// Reads `size` items, and passes each to the introspection's functions.
template<typename In>
void get_each(const Field & field, uint8_t * sequence, size_t size, Reader & reader)
{
  In::resize(field, sequence, size);
  if (field.size(sequence) != size) {
    fail(field, "the sequence cannot be given the stream's length");
  }
  if (field.item == Item::Bool) {
    const uint8_t * from = reader.bytes(size, 1, field);
    for (size_t i = 0; i < size; ++i) {
      const bool value = flag(from + i) != 0;
      field.assign(sequence, i, &value);
    }
    return;
  }
  OneItem item;
  for (size_t i = 0; i < size; ++i) {
    if (field.width != 0) {
      get_items<In>(field, item.bytes, 1, reader);
      field.assign(sequence, i, item.bytes);
    } else {
      get_items<In>(field, static_cast<uint8_t *>(field.at_mutable(sequence, i)), 1, reader);
    }
  }
}

template<typename In>
void get_sequence(const Field & field, uint8_t * sequence, Reader & reader)
{
  const size_t size = reader.length(field.count, least_of_item(field), field);
  if (field.container == Container::Buffer) {
    return buffer::assign(sequence, reader.bytes(size, 1, field), size);
  }
  In::release_buffer(field, sequence);
  if (field.container == Container::Opaque) {
    return get_each<In>(field, sequence, size, reader);
  }
  if (field.item == Item::Number && !reader.swapped()) {
    const uint8_t * from = size == 0 ? nullptr :
      reader.bytes(size * field.width, field.alignment, field);
    return In::set_numbers(field, sequence, from, size);
  }
  In::resize(field, sequence, size);
  if (size == 0) {
    return;
  }
  get_items<In>(field, In::items(field, static_cast<void *>(sequence)), size, reader);
}

template<typename In>
void get_message(const Plan & plan, uint8_t * message, Reader & reader)
{
  for (size_t i = 0; i < plan.fields.size(); ) {
    const Field & field = plan.fields[i];
    if (field.run_fields > 1 && !reader.swapped()) {
      reader.align(field.alignment, field);
      if (((reader.position() ^ field.offset) & (field.run_alignment - 1)) == 0) {
        std::memcpy(message + field.offset, reader.bytes(field.run_bytes, 1, field), field.run_bytes);
        i += field.run_fields;
        continue;
      }
    }
    if (field.shape == Shape::Sequence) {
      get_sequence<In>(field, message + field.offset, reader);
    } else {
      get_items<In>(field, message + field.offset, field.count, reader);
    }
    ++i;
  }
}

// Returns whether the stream is in the other byte order. Throws if it is not plain CDR.
bool other_order(const uint8_t * stream, size_t size)
{
  if (size < HEADER) {
    throw Error("a stream of " + std::to_string(size) + " bytes, its header alone has 4");
  }
  const uint8_t high = once(stream[0]);
  const uint8_t low = once(stream[1]);
  if (high != 0 || low > 1) {
    throw Error(
            "representation " + std::to_string(high * 256 + low) +
            " in the header: plain CDR is 0 (big endian) or 1 (little endian)");
  }
  uint8_t own[HEADER];
  write_header(own);
  return low != own[1];
}

bool bools_are_sound(const Plan & plan, const uint8_t * message)
{
  for (const Field & field : plan.fields) {
    for (size_t i = 0; i < field.count; ++i) {
      const uint8_t * item = message + field.offset + i * field.stride;
      if (field.item == Item::Bool && once(*item) > 1) {
        return false;
      }
      if (field.item == Item::Message && !bools_are_sound(*field.message, item)) {
        return false;
      }
    }
  }
  return true;
}

}  // namespace

void decode(const Plan & plan, const uint8_t * stream, size_t size, void * message)
{
  const bool swapped = other_order(stream, size);
  Reader reader(stream + HEADER, size - HEADER, swapped);
  auto * bytes = static_cast<uint8_t *>(message);
  if (plan.language == Language::C) {
    get_message<InC>(plan, bytes, reader);
  } else {
    get_message<InCpp>(plan, bytes, reader);
  }
}

bool readable_in_place(const Plan & plan, const uint8_t * stream, size_t size)
{
  if (!plan.plain || size < HEADER + plan.size_of || other_order(stream, size)) {
    return false;
  }
  return !plan.has_bool || bools_are_sound(plan, stream + HEADER);
}

}  // namespace rmw_axon::cdr
