// SPDX-License-Identifier: MIT OR Apache-2.0

#include "trace_recorder.hpp"

#include <cstring>

#include "tracetools/tracetools.h"

bool recording = true;
std::vector<Event> events;

std::vector<Event> named(const std::string & name)
{
  std::vector<Event> found;
  for (const Event & event : events) {
    if (event.name == name) {
      found.push_back(event);
    }
  }
  return found;
}

namespace
{

Event & add(const char * name, const void * handle, const void * message)
{
  events.emplace_back();
  Event & event = events.back();
  event.name = name;
  event.handle = handle;
  event.message = message;
  return event;
}

void set_gid(Event & event, const uint8_t * gid)
{
  std::memcpy(event.gid.data(), gid, event.gid.size());
}

}  // namespace

extern "C" {

void ros_trace_rmw_publisher_init(const void * handle, const uint8_t * gid)
{
  set_gid(add("rmw_publisher_init", handle, nullptr), gid);
}

void ros_trace_rmw_subscription_init(const void * handle, const uint8_t * gid)
{
  set_gid(add("rmw_subscription_init", handle, nullptr), gid);
}

#if AXON_TRACE_TIMESTAMP
bool ros_trace_enabled_rmw_publish()
{
  return recording;
}

void ros_trace_do_rmw_publish(const void * handle, const void * message, int64_t timestamp)
{
  add("rmw_publish", handle, message).timestamp = timestamp;
}
#else
void ros_trace_rmw_publish(const void * message)
{
  add("rmw_publish", nullptr, message);
}
#endif

void ros_trace_rmw_take(
  const void * handle, const void * message, int64_t timestamp, const bool taken)
{
  Event & event = add("rmw_take", handle, message);
  event.timestamp = timestamp;
  event.taken = taken;
}

#if AXON_TRACE_SERVICES
void ros_trace_rmw_client_init(const void * handle, const uint8_t * gid)
{
  set_gid(add("rmw_client_init", handle, nullptr), gid);
}

void ros_trace_rmw_send_request(const void * handle, const void * request, int64_t sequence)
{
  add("rmw_send_request", handle, request).sequence = sequence;
}

void ros_trace_rmw_take_request(
  const void * handle, const void * request, const uint8_t * client, int64_t sequence,
  const bool taken)
{
  Event & event = add("rmw_take_request", handle, request);
  set_gid(event, client);
  event.sequence = sequence;
  event.taken = taken;
}

bool ros_trace_enabled_rmw_send_response()
{
  return recording;
}

void ros_trace_do_rmw_send_response(
  const void * handle, const void * response, const uint8_t * client, int64_t sequence,
  int64_t timestamp)
{
  Event & event = add("rmw_send_response", handle, response);
  set_gid(event, client);
  event.sequence = sequence;
  event.timestamp = timestamp;
}

void ros_trace_rmw_take_response(
  const void * handle, const void * response, int64_t sequence, int64_t timestamp,
  const bool taken)
{
  Event & event = add("rmw_take_response", handle, response);
  event.sequence = sequence;
  event.timestamp = timestamp;
  event.taken = taken;
}
#endif

}
