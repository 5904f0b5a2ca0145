// SPDX-License-Identifier: MIT OR Apache-2.0

#ifndef LOGGING_HPP_
#define LOGGING_HPP_

namespace rmw_axon
{

// From now on what the core says in this process goes to ROS's logger. As often as one likes.
void start_logging();

}  // namespace rmw_axon

#endif  // LOGGING_HPP_
