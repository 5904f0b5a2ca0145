// SPDX-License-Identifier: MIT OR Apache-2.0

#include "names.hpp"

#include "error.hpp"
#include "rmw/validate_full_topic_name.h"

namespace rmw_axon
{

namespace
{

std::string full_name(const char * name, const char * what)
{
  int result = RMW_TOPIC_VALID;
  if (rmw_validate_full_topic_name(name, &result, nullptr) != RMW_RET_OK) {
    throw Failure(RMW_RET_ERROR, std::string(what) + " '" + name + "' could not be validated");
  }
  if (result != RMW_TOPIC_VALID) {
    const char * reason = rmw_full_topic_name_validation_result_string(result);
    throw Failure(
            RMW_RET_INVALID_ARGUMENT,
            std::string(what) + " '" + name + "' is no full name: " + reason);
  }
  return name;
}

// Returns AXON's name for a topic that is not a ROS name: without the leading slash.
std::string bare(const char * name, const char * what)
{
  const std::string without = name[0] == '/' ? name + 1 : name;
  if (without.empty()) {
    throw Failure(RMW_RET_INVALID_ARGUMENT, std::string(what) + " is empty");
  }
  return without;
}

}  // namespace

std::string topic_name(const char * name, bool avoid_ros_namespace_conventions)
{
  require(name, "topic_name");
  return avoid_ros_namespace_conventions ? bare(name, "topic_name") : full_name(name, "topic");
}

std::string service_name(const char * name, bool avoid_ros_namespace_conventions)
{
  require(name, "service_name");
  return avoid_ros_namespace_conventions ? bare(name, "service_name") : full_name(name, "service");
}

}  // namespace rmw_axon
