// SPDX-License-Identifier: MIT OR Apache-2.0

// Filters the names in the graph for ROS's tools. Peers choose these names, AXON accepts any text as a name,
// and the tools print them unchanged. So no name may control a terminal, or be invalid in ROS.

#ifndef SHOWN_HPP_
#define SHOWN_HPP_

#include <string>
#include <vector>

namespace rmw_axon
{

struct NodeNames
{
  std::string name;
  std::string name_space;
  std::string enclave;
};

struct NameAndTypes
{
  std::string name;
  std::vector<std::string> types;
};

// Returns UTF-8 in which a question mark replaces each character that could control a terminal: control
// characters, line separators, marks that change the direction of writing, and others without a shape. It
// also replaces each byte that is not UTF-8.
std::string printable(const std::string & text);

// Returns whether the text has no such character.
bool is_printable(const std::string & text);

// Returns whether it is a valid name of a topic or a service in ROS.
bool is_full_name(const std::string & name);

// Removes names that are invalid in ROS, or, if `all_names`, names that are not printable. Of the remaining
// names removes the types that are not printable, and then names without any type.
void leave_out_strange(std::vector<NameAndTypes> & names, bool all_names);

// Removes nodes whose name or namespace is invalid in ROS. Their enclaves are made printable.
void leave_out_strange(std::vector<NodeNames> & nodes);

}  // namespace rmw_axon

#endif  // SHOWN_HPP_
