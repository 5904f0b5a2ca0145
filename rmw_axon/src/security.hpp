// SPDX-License-Identifier: MIT OR Apache-2.0

#ifndef SECURITY_HPP_
#define SECURITY_HPP_

#include "axon.h"
#include "rmw/init_options.h"

namespace rmw_axon
{

// ROS's security settings beside AXON's. Throws Failure where ROS enforces security and AXON authenticates
// nobody.
// Warns, once in a process, of what of ROS's settings has no effect.
void check_security(const rmw_init_options_t & options, const axon_session_options_t & session);

}  // namespace rmw_axon

#endif  // SECURITY_HPP_
