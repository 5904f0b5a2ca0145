// SPDX-License-Identifier: MIT OR Apache-2.0

// ROS_SECURITY_*: AXON authenticates and encrypts by its own settings. From ROS's keystore it reads only the
// permissions of the enclave, as DDS middlewares do if the enclave's files exist.

#include "security.hpp"

#include <atomic>
#include <cstring>
#include <filesystem>
#include <string>
#include <system_error>
#include <utility>

#include "error.hpp"
#include "logging.hpp"
#include "rcutils/env.h"

namespace rmw_axon
{

namespace
{

// If rcl found no keystore and needs none, the options do not show ROS_SECURITY_ENABLE.
bool is_enabled(const rmw_security_options_t & security)
{
  const char * value = nullptr;
  const bool in_environment =
    rcutils_get_env("ROS_SECURITY_ENABLE", &value) == nullptr && std::strcmp(value, "true") == 0;
  return in_environment || security.security_root_path != nullptr ||
         security.enforce_security == RMW_SECURITY_ENFORCEMENT_ENFORCE;
}

// Returns the enclave whose folder rcl looked up.
std::string enclave_of(const rmw_init_options_t & options)
{
  const char * value = nullptr;
  const bool overridden =
    rcutils_get_env("ROS_SECURITY_ENCLAVE_OVERRIDE", &value) == nullptr && value[0] != '\0';
  return overridden ? value : options.enclave;
}

// Returns whether the file is known to be missing. A file that cannot be examined may exist.
bool is_missing(const std::string & path)
{
  std::error_code error;
  return !std::filesystem::exists(path, error) && !error;
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

Enclave check_security(const rmw_init_options_t & options, const axon_session_options_t & session)
{
  const rmw_security_options_t & security = options.security_options;
  if (!is_enabled(security)) {
    return {};
  }
  const bool enforced = security.enforce_security == RMW_SECURITY_ENFORCEMENT_ENFORCE;
  uint32_t authentication = AXON_AUTHENTICATION_NONE;
  check(axon_session_options_authentication(&session, &authentication));
  const bool nobody = authentication == AXON_AUTHENTICATION_NONE;
  if (nobody && enforced) {
    throw Failure(
            RMW_RET_ERROR, std::string(
              "ROS security is enforced (ROS_SECURITY_STRATEGY=Enforce), and rmw_axon would authenticate "
              "nobody: AXON_CLASSIC_AUTH is none. It does not use the certificates of ROS's keystore: ") +
            REMEDY);
  }
  Enclave enclave;
  if (security.security_root_path != nullptr) {
    const std::string path = std::string(security.security_root_path) + "/permissions.p7s";
    // In permissive mode the permissions limit the session only if the keystore has them.
    if (enforced || !is_missing(path)) {
      enclave = {path, enclave_of(options)};
    }
  } else if (enforced) {
    throw Failure(
            RMW_RET_ERROR,
            "ROS security is enforced (ROS_SECURITY_STRATEGY=Enforce), and the options name no folder of "
            "an enclave: set ROS_SECURITY_KEYSTORE");
  }
  static std::atomic<bool> warned{false};
  // Relaxed: the flag orders nothing else.
  if (warned.exchange(true, std::memory_order_relaxed)) {
    return enclave;
  }
  std::string text = "ROS security is enabled. Of ROS's keystore rmw_axon uses ";
  if (enclave.permissions_path.empty()) {
    text += "nothing: there is no permissions.p7s";
    if (security.security_root_path != nullptr) {
      text += std::string(" in ") + security.security_root_path;
    }
    text += ", and what this process may publish and subscribe to is not limited. ";
  } else {
    text += "the permissions of enclave " + enclave.name + " (" + enclave.permissions_path +
      ") and nothing else: it does not verify their signature. ";
  }
  if (nobody) {
    text += std::string("Nobody is authenticated, AXON_CLASSIC_AUTH is none: ") + REMEDY;
  } else {
    text += std::string("Hosts are authenticated, ") + name_of(authentication);
  }
  warn(std::move(text));
  return enclave;
}

}  // namespace rmw_axon
