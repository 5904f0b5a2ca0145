// SPDX-License-Identifier: MIT OR Apache-2.0

#ifndef LOGGING_HPP_
#define LOGGING_HPP_

#include <string>

namespace rmw_axon
{

// From now on what the core says in this process is for ROS's logger. As often as one likes.
void start_logging();

// Tells the logger from now on, and first what has been said so far: a program sets its levels after rmw_init.
void tell_logger();

// A warning of this adapter's own, told when the logger may be.
void warn(std::string text);

}  // namespace rmw_axon

#endif  // LOGGING_HPP_
