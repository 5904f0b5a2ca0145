// SPDX-License-Identifier: MIT OR Apache-2.0

// What ROS's tools are shown of names in the graph. Peers choose these names, AXON takes any text for one,
// and the tools print them as they are: no name may steer a terminal, or be none in ROS.

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

// UTF-8 in which each character that could steer a terminal is replaced by a question mark: control
// characters, line separators, marks that turn the direction of writing, and others without a shape. So is
// each byte that is no UTF-8.
std::string printable(const std::string & text);

// Whether there is no such character in it.
bool is_printable(const std::string & text);

// Whether it is a name of a topic or a service in ROS.
bool is_full_name(const std::string & name);

// Leaves out names that are none in ROS, or, if `all_names`, those that are not printable; of the rest the
// types that are not printable, and names without any type.
void leave_out_strange(std::vector<NameAndTypes> & names, bool all_names);

// Leaves out nodes whose name or namespace is none in ROS. Their enclaves are made printable.
void leave_out_strange(std::vector<NodeNames> & nodes);

}  // namespace rmw_axon

#endif  // SHOWN_HPP_
