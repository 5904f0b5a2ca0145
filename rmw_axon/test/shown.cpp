// SPDX-License-Identifier: MIT OR Apache-2.0

// Tests the names that a peer may choose, and their form in ROS's tools.

#include "shown.hpp"

#include <gtest/gtest.h>

#include <string>
#include <vector>

using rmw_axon::NameAndTypes;
using rmw_axon::NodeNames;

namespace
{

// Sets the title of a terminal.
const char evil[] = "\x1b]0;evil\x07";

std::vector<std::string> shown(std::vector<NameAndTypes> names, bool all_names)
{
  rmw_axon::leave_out_strange(names, all_names);
  std::vector<std::string> left;
  for (const auto & one : names) {
    for (const auto & type : one.types) {
      left.push_back(one.name + " " + type);
    }
    EXPECT_FALSE(one.types.empty()) << one.name;
  }
  return left;
}

using Texts = std::vector<std::string>;

}  // namespace

TEST(Shown, TopicsThatAreNoneInRosAreLeftOut)
{
  const std::string type = "std_msgs/msg/String";
  const std::vector<NameAndTypes> names = {
    {"/scan", {type}},
    {std::string("/x") + evil, {type}},
    {"bare", {type}},
    {"/a b", {type}},
    {"/line\nbreak", {type}},
    {"/\xC3\x9C""ber", {type}},
    {"/turn\xE2\x80\xAE", {type}},
    {"", {type}},
    {"/", {type}},
    {"/a//b", {type}}};
  EXPECT_EQ(shown(names, false), (Texts{"/scan " + type}));
  EXPECT_EQ(
    shown(names, true),
    (Texts{"/scan " + type, "bare " + type, "/a b " + type, "/\xC3\x9C""ber " + type, " " + type,
      "/ " + type, "/a//b " + type}));
}

TEST(Shown, TypesThatSteerATerminalAreLeftOut)
{
  const std::vector<NameAndTypes> names = {{"/a", {std::string("T") + evil, "T"}}, {"/b", {evil}}};
  for (const bool all_names : {false, true}) {
    EXPECT_EQ(shown(names, all_names), (Texts{"/a T"}));
  }
}

TEST(Shown, NodesThatAreNoneInRosAreLeftOut)
{
  std::vector<NodeNames> nodes = {
    {"talker", "/", "/"},
    {std::string("talker") + evil, "/", "/"},
    {"talker", std::string("/") + evil, "/"},
    {"no node", "/", "/"},
    {"talker", "", "/"},
    {"other", "/robot", std::string("/") + evil}};
  rmw_axon::leave_out_strange(nodes);
  ASSERT_EQ(nodes.size(), 2u);
  EXPECT_EQ(nodes[0].name, "talker");
  EXPECT_EQ(nodes[1].name, "other");
  EXPECT_EQ(nodes[1].enclave, "/?]0;evil?");
}

TEST(Shown, NothingThatSteersATerminalIsPrintable)
{
  // The list is that of axon-transport/src/text.rs.
  for (const char * text : {
        "\x01", "\x1b", "\r", "\n", "\t", "\x7f", "\xC2\x85", "\xC2\x9B", "\xC2\xAD", "\xD8\x9C",
        "\xE2\x80\x8B", "\xE2\x80\x8E", "\xE2\x80\x8F", "\xE2\x80\xA8", "\xE2\x80\xA9", "\xE2\x80\xAA",
        "\xE2\x80\xAE", "\xE2\x81\xA0", "\xE2\x81\xA6", "\xE2\x81\xA9", "\xEF\xBB\xBF", "\xEF\xBF\xB9",
        "\xF3\xA0\x81\x81"})
  {
    EXPECT_EQ(rmw_axon::printable(std::string("a") + text + "b"), "a?b");
  }
  EXPECT_EQ(rmw_axon::printable(std::string("a\0b", 3)), "a?b");
}

TEST(Shown, BytesThatAreNoUtf8AreNotPrintable)
{
  // C1 as one byte, a cut character, overlong forms of ESC, a surrogate, and a value beyond Unicode.
  EXPECT_EQ(rmw_axon::printable("\x9b""31m"), "?31m");
  EXPECT_EQ(rmw_axon::printable("\xC3"), "?");
  EXPECT_EQ(rmw_axon::printable("\xC0\x9B"), "??");
  EXPECT_EQ(rmw_axon::printable("\xE0\x80\x9B"), "???");
  EXPECT_EQ(rmw_axon::printable("\xED\xA0\x80"), "?");
  EXPECT_EQ(rmw_axon::printable("\xF4\x90\x80\x80"), "????");
}

TEST(Shown, TextOfAnyLanguageIsPrintable)
{
  for (const char * text : {
        "", "/scan", "say \"it's\" \\", "\xC3\x9C""ber", "\xE3\x82\xAB\xE3\x83\xA1\xE3\x83\xA9",
        "\xD8\xB5\xD9\x88\xD8\xB1\xD8\xA9", "\xF0\x9F\xA4\x96"})
  {
    EXPECT_TRUE(rmw_axon::is_printable(text)) << text;
  }
}
