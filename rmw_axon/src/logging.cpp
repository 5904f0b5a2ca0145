// SPDX-License-Identifier: MIT OR Apache-2.0

// Passes the core's log lines to ROS's logger `rmw_axon`.

#include "logging.hpp"

#include <atomic>
#include <condition_variable>
#include <mutex>
#include <string>
#include <utility>
#include <vector>

#include "axon.h"
#include "error.hpp"
#include "rcutils/logging.h"
#include "rcutils/logging_macros.h"
#include "rmw/rmw.h"

namespace rmw_axon
{

namespace
{

void log_warning(const std::string & text)
{
  RCUTILS_LOG_WARN_NAMED(identifier, "%s", text.c_str());
}

// The core's thread waits here with its first line until the logger may be used.
class Gate
{
public:
  void pass()
  {
    // Pairs with the release in open(): this thread then sees everything that the opener set before, above
    // all the logger's levels.
    if (is_open_.load(std::memory_order_acquire)) {
      return;
    }
    std::unique_lock<std::mutex> lock(mutex_);
    opened_.wait(lock, [this] {return is_open_.load(std::memory_order_relaxed);});
  }

  void open()
  {
    if (is_open_.load(std::memory_order_acquire)) {
      return;
    }
    std::vector<std::string> kept;
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      is_open_.store(true, std::memory_order_release);
      kept.swap(kept_);
    }
    opened_.notify_all();
    for (const std::string & text : kept) {
      log_warning(text);
    }
  }

  void warn(std::string text)
  {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      if (!is_open_.load(std::memory_order_relaxed)) {
        kept_.push_back(std::move(text));
        return;
      }
    }
    log_warning(text);
  }

private:
  std::atomic<bool> is_open_{false};
  // Warnings from before the gate was open.
  std::vector<std::string> kept_;
  std::mutex mutex_;
  std::condition_variable opened_;
};

// Never destroyed: the thread may wait at it while the process ends.
Gate & gate()
{
  static Gate * const made = new Gate;
  return *made;
}

void tell(const void *, uint32_t severity, const char * part, const char * text)
{
  gate().pass();
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
  gate();
  // The logger's level, which may change at any time, filters the lines.
  check(axon_session_log_set_severity(AXON_LOG_DEBUG));
  // This fails if the program has its own subscriber for the log of Rust code, which then gets all lines.
  axon_session_log_set_callback(tell, nullptr);
}

void tell_logger()
{
  gate().open();
}

void warn(std::string text)
{
  gate().warn(std::move(text));
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
