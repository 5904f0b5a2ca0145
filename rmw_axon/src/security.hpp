// SPDX-License-Identifier: MIT OR Apache-2.0

#ifndef SECURITY_HPP_
#define SECURITY_HPP_

#include <string>

#include "axon.h"
#include "rmw/init_options.h"

namespace rmw_axon
{

// The enclave whose permissions limit a session. Both fields are empty without permissions.
struct Enclave
{
  std::string permissions_path;
  std::string name;
};

// Checks ROS's security settings against AXON's. Throws Failure if ROS enforces security and AXON
// authenticates no peer, or if there is no folder of an enclave. Opening the session checks whether the
// permissions are valid. Warns, once in a process, of ROS's settings without effect.
Enclave check_security(const rmw_init_options_t & options, const axon_session_options_t & session);

}  // namespace rmw_axon

#endif  // SECURITY_HPP_
