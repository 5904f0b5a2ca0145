// SPDX-License-Identifier: MIT OR Apache-2.0

// Names of topics and services between ROS and AXON.
//
// AXON carries a ROS name as it is: /robot/scan is /robot/scan, for `axon echo` too. A topic that was
// created with avoid_ros_namespace_conventions has its name without the slash in front, so that it meets
// those of programs that are no ROS nodes, and never a ROS topic. Services are endpoints of their own
// kind and need no prefix.

#ifndef NAMES_HPP_
#define NAMES_HPP_

#include <string>

namespace rmw_axon
{

// AXON's name of a topic. Throws Failure where it is no full ROS name, unless the conventions are avoided.
std::string topic_name(const char * name, bool avoid_ros_namespace_conventions);

// AXON's name of a service.
std::string service_name(const char * name, bool avoid_ros_namespace_conventions);

}  // namespace rmw_axon

#endif  // NAMES_HPP_
