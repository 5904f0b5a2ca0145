// SPDX-License-Identifier: MIT OR Apache-2.0

// Records the tracepoints that the library reaches, and their arguments. trace_recorder.cpp defines the
// functions of tracetools, which take precedence over those of its library, so no tracer is needed.

#ifndef TRACE_RECORDER_HPP_
#define TRACE_RECORDER_HPP_

#include <array>
#include <cstdint>
#include <string>
#include <vector>

struct Event
{
  std::string name;
  const void * handle = nullptr;
  const void * message = nullptr;
  int64_t timestamp = 0;
  int64_t sequence = 0;
  bool taken = false;
  std::array<uint8_t, 16> gid{};
};

// False if tracepoints should report that no session records them.
extern bool recording;
// The events since the last clear, in order.
extern std::vector<Event> events;

// Returns the events of a tracepoint.
std::vector<Event> named(const std::string & name);

#endif  // TRACE_RECORDER_HPP_
