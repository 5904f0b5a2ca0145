// SPDX-License-Identifier: MIT OR Apache-2.0

// What the core says, as lines of ROS's logger `rmw_axon`.

#include "logging.hpp"

#include "axon.h"
#include "error.hpp"
#include "rcutils/logging.h"
#include "rmw/rmw.h"

namespace rmw_axon
{

namespace
{

void tell(const void *, uint32_t severity, const char * part, const char * text)
{
  // AXON_LOG_* are the numbers that ROS has for the same severities.
  const int level = static_cast<int>(severity);
  if (rcutils_logging_logger_is_enabled_for(identifier, level)) {
    const rcutils_log_location_t location{part, "", 0};
    rcutils_log(&location, level, identifier, "%s", text);
  }
}

}  // namespace

void start_logging()
{
  // The logger's level, which may change at any time, says what is told.
  check(axon_session_log_set_severity(AXON_LOG_DEBUG));
  // Refused where the program has its own ear for what Rust code says: then it hears it there.
  axon_session_log_set_callback(tell, nullptr);
}

}  // namespace rmw_axon

extern "C" {

rmw_ret_t rmw_set_log_severity(rmw_log_severity_t severity)
{
  return rmw_axon::guarded(
    [&] {
      switch (severity) {
        case RMW_LOG_SEVERITY_DEBUG:
        case RMW_LOG_SEVERITY_INFO:
        case RMW_LOG_SEVERITY_WARN:
        case RMW_LOG_SEVERITY_ERROR:
        case RMW_LOG_SEVERITY_FATAL:
          break;
        default:
          throw rmw_axon::Failure(RMW_RET_INVALID_ARGUMENT, "severity is none");
      }
      const int level = static_cast<int>(severity);
      if (rcutils_logging_set_logger_level(rmw_axon::identifier, level) != RCUTILS_RET_OK) {
        throw rmw_axon::Failure(RMW_RET_ERROR, "the logger's severity could not be set");
      }
    });
}

}
