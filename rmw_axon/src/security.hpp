// SPDX-License-Identifier: MIT OR Apache-2.0

#ifndef SECURITY_HPP_
#define SECURITY_HPP_

#include <string>

#include "axon.h"
#include "rmw/init_options.h"

namespace rmw_axon
{

// The enclave whose permissions act for a session. Both are empty where none do.
struct Enclave
{
  std::string permissions_path;
  std::string name;
};

// ROS's security settings beside AXON's. Throws Failure where ROS enforces security and AXON authenticates
// nobody, or there is no folder of an enclave. Whether the permissions can be used, opening the session says.
// Warns, once in a process, of what of ROS's settings has no effect.
Enclave check_security(const rmw_init_options_t & options, const axon_session_options_t & session);

}  // namespace rmw_axon

#endif  // SECURITY_HPP_
