// SPDX-License-Identifier: MIT OR Apache-2.0

// ROS_SECURITY_*: AXON authenticates and encrypts by settings of its own, and reads no keystore of ROS.

#include "security.hpp"

#include <atomic>
#include <cstring>
#include <string>
#include <utility>

#include "error.hpp"
#include "logging.hpp"
#include "rcutils/env.h"

namespace rmw_axon
{

namespace
{

// rcl leaves no trace of ROS_SECURITY_ENABLE in the options where it found no keystore and need not have one.
bool is_enabled(const rmw_security_options_t & security)
{
  const char * value = nullptr;
  const bool in_environment =
    rcutils_get_env("ROS_SECURITY_ENABLE", &value) == nullptr && std::strcmp(value, "true") == 0;
  return in_environment || security.security_root_path != nullptr ||
         security.enforce_security == RMW_SECURITY_ENFORCEMENT_ENFORCE;
}

const char * name_of(uint32_t authentication)
{
  switch (authentication) {
    case AXON_AUTHENTICATION_PINNED:
      return "AXON_CLASSIC_AUTH is pinned";
    case AXON_AUTHENTICATION_CA:
      return "AXON_CLASSIC_AUTH is ca";
    case AXON_AUTHENTICATION_QKD:
      return "AXON_SECURITY_MODE is qkd";
    default:
      return "AXON_CLASSIC_AUTH is none";
  }
}

constexpr char REMEDY[] =
  "set AXON_CLASSIC_AUTH to pinned (with AXON_CLASSIC_KEY and AXON_CLASSIC_TRUST) or to ca (with "
  "AXON_CLASSIC_CA, AXON_CLASSIC_CERT and AXON_CLASSIC_KEY), or AXON_SECURITY_MODE to qkd";

}  // namespace

void check_security(const rmw_init_options_t & options, const axon_session_options_t & session)
{
  const rmw_security_options_t & security = options.security_options;
  if (!is_enabled(security)) {
    return;
  }
  uint32_t authentication = AXON_AUTHENTICATION_NONE;
  check(axon_session_options_authentication(&session, &authentication));
  const bool nobody = authentication == AXON_AUTHENTICATION_NONE;
  if (nobody && security.enforce_security == RMW_SECURITY_ENFORCEMENT_ENFORCE) {
    throw Failure(
            RMW_RET_ERROR, std::string(
              "ROS security is enforced (ROS_SECURITY_STRATEGY=Enforce), and rmw_axon would authenticate "
              "nobody: AXON_CLASSIC_AUTH is none. It does not use ROS's keystore: ") + REMEDY);
  }
  static std::atomic<bool> warned{false};
  // Relaxed: nothing else is read by it.
  if (warned.exchange(true, std::memory_order_relaxed)) {
    return;
  }
  std::string text = "ROS security is enabled. rmw_axon does not use ROS's keystore";
  if (security.security_root_path != nullptr) {
    text += std::string(" (") + security.security_root_path + ")";
  }
  text += ", and applies no permissions of an enclave. ";
  if (nobody) {
    text += std::string("Nobody is authenticated, AXON_CLASSIC_AUTH is none: ") + REMEDY;
  } else {
    text += std::string("Hosts are authenticated, ") + name_of(authentication);
  }
  warn(std::move(text));
}

}  // namespace rmw_axon
