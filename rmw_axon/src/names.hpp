// SPDX-License-Identifier: MIT OR Apache-2.0

// Names of topics and services between ROS and AXON.
//
// AXON uses a ROS name unchanged: /robot/scan is /robot/scan, also for `axon echo`. The name of a topic that
// was created with avoid_ros_namespace_conventions loses its leading slash. So it matches topics of programs
// that are not ROS nodes, and never a ROS topic. Services are endpoints of their own kind and need no prefix.

#ifndef NAMES_HPP_
#define NAMES_HPP_

#include <string>

namespace rmw_axon
{

// Returns AXON's name of a topic. Throws Failure if the name is not a full ROS name, unless the conventions
// are avoided.
std::string topic_name(const char * name, bool avoid_ros_namespace_conventions);

// Returns AXON's name of a service.
std::string service_name(const char * name, bool avoid_ros_namespace_conventions);

}  // namespace rmw_axon

#endif  // NAMES_HPP_
