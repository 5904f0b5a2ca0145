// SPDX-License-Identifier: MIT OR Apache-2.0

#include "shown.hpp"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <utility>

#include "rmw/ret_types.h"
#include "rmw/validate_full_topic_name.h"
#include "rmw/validate_namespace.h"
#include "rmw/validate_node_name.h"

namespace rmw_axon
{

namespace
{

// Characters without a shape of their own, from the first to the last of each row. Unicode's categories Cc, Cf, Zl
// and Zp, as far as a terminal may act on them.
constexpr std::pair<char32_t, char32_t> steering[] = {
  {0x00, 0x1F}, {0x7F, 0x9F}, {0xAD, 0xAD}, {0x600, 0x605}, {0x61C, 0x61C}, {0x6DD, 0x6DD},
  {0x70F, 0x70F}, {0x180E, 0x180E}, {0x200B, 0x200F}, {0x2028, 0x202E}, {0x2060, 0x206F},
  {0xD800, 0xDFFF}, {0xFEFF, 0xFEFF}, {0xFFF0, 0xFFFB}, {0xE0000, 0xE0FFF}};

bool steers(char32_t character)
{
  return std::any_of(
    std::begin(steering), std::end(steering), [&](const auto & range) {
      return range.first <= character && character <= range.second;
    });
}

struct Character
{
  // 0 if the bytes are not UTF-8.
  char32_t value;
  size_t length;
};

// Returns the character at `at`, or one byte that is not UTF-8.
Character character_at(const std::string & text, size_t at)
{
  const auto byte = [&](size_t i) {return static_cast<uint8_t>(text[i]);};
  const uint8_t first = byte(at);
  if (first < 0x80) {
    return {first, 1};
  }
  size_t length = 0;
  char32_t value = 0;
  if (first >= 0xC2 && first < 0xE0) {
    length = 2;
    value = first & 0x1Fu;
  } else if (first >= 0xE0 && first < 0xF0) {
    length = 3;
    value = first & 0x0Fu;
  } else if (first >= 0xF0 && first < 0xF5) {
    length = 4;
    value = first & 0x07u;
  }
  if (length == 0 || text.size() - at < length) {
    return {0, 1};
  }
  for (size_t i = at + 1; i < at + length; ++i) {
    if ((byte(i) & 0xC0u) != 0x80) {
      return {0, 1};
    }
    value = value << 6 | (byte(i) & 0x3Fu);
  }
  // A longer form than needed hides a character.
  const char32_t least = length == 2 ? 0x80 : length == 3 ? 0x800 : 0x10000;
  return value < least || value > 0x10FFFF ? Character{0, 1} : Character{value, length};
}

template<typename Items, typename Strange>
void leave_out(Items & items, Strange strange)
{
  items.erase(std::remove_if(items.begin(), items.end(), strange), items.end());
}

bool is_node_name(const std::string & name)
{
  int result = RMW_NODE_NAME_VALID;
  return rmw_validate_node_name(name.c_str(), &result, nullptr) == RMW_RET_OK &&
         result == RMW_NODE_NAME_VALID;
}

bool is_namespace(const std::string & name)
{
  int result = RMW_NAMESPACE_VALID;
  return rmw_validate_namespace(name.c_str(), &result, nullptr) == RMW_RET_OK &&
         result == RMW_NAMESPACE_VALID;
}

}  // namespace

std::string printable(const std::string & text)
{
  std::string shown;
  shown.reserve(text.size());
  for (size_t at = 0; at < text.size(); ) {
    const Character next = character_at(text, at);
    if (steers(next.value)) {
      shown += '?';
    } else {
      shown.append(text, at, next.length);
    }
    at += next.length;
  }
  return shown;
}

bool is_printable(const std::string & text)
{
  return printable(text) == text;
}

bool is_full_name(const std::string & name)
{
  int result = RMW_TOPIC_VALID;
  return rmw_validate_full_topic_name(name.c_str(), &result, nullptr) == RMW_RET_OK &&
         result == RMW_TOPIC_VALID;
}

void leave_out_strange(std::vector<NameAndTypes> & names, bool all_names)
{
  leave_out(
    names, [&](NameAndTypes & one) {
      if (!(all_names ? is_printable(one.name) : is_full_name(one.name))) {
        return true;
      }
      leave_out(one.types, [](const std::string & type) {return !is_printable(type);});
      return one.types.empty();
    });
}

void leave_out_strange(std::vector<NodeNames> & nodes)
{
  leave_out(
    nodes, [](const NodeNames & node) {
      return !is_node_name(node.name) || !is_namespace(node.name_space);
    });
  for (NodeNames & node : nodes) {
    node.enclave = printable(node.enclave);
  }
}

}  // namespace rmw_axon
