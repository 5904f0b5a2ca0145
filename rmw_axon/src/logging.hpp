// SPDX-License-Identifier: MIT OR Apache-2.0

#ifndef LOGGING_HPP_
#define LOGGING_HPP_

#include <string>

namespace rmw_axon
{

// Passes the core's log of this process to ROS's logger from now on. May be called repeatedly.
void start_logging();

// Opens the logger, and first passes it the lines so far: a program sets its levels after rmw_init.
void tell_logger();

// Logs a warning of this adapter, as soon as the logger may be used.
void warn(std::string text);

}  // namespace rmw_axon

#endif  // LOGGING_HPP_
