// SPDX-License-Identifier: MIT OR Apache-2.0

// The tracepoints of ros2_tracing, as the distribution's tracetools declares them. Without tracetools, and
// for a tracepoint that it does not declare, each function here does nothing. A tracepoint that no session
// records costs one check of its state.

#ifndef TRACE_HPP_
#define TRACE_HPP_

#include <cstdint>

#include "endpoint.hpp"

namespace rmw_axon::trace
{

void publisher_created(const Publisher & publisher);
void subscription_created(const Subscription & subscription);
void client_created(const Client & client);

// Records that a message is published, and returns the source timestamp to publish it with: the recorded one,
// or AXON_TIME_NOW where none is recorded. Call it directly before the core publishes, so that no subscription
// takes the message before the event. A message that the core then refuses leaves an event that no take joins.
int64_t publish(const Publisher & publisher, const void * message);

void send_request(const Client & client, const void * request, int64_t sequence);

// Records `publish` for the response to request `sequence` of `client`.
int64_t send_response(
  const Service & service, const void * response, const axon_gid_t & client, int64_t sequence);

// Records a take when it ends, with or without an error. The caller declares it before the first step that
// can fail. `taken` outlives it. The event has the source timestamp of the taken message, or 0. It has the
// message only after `delivered`. So a message that cannot be read gives an event with a timestamp and
// without a message.
template<typename Endpoint>
class Take
{
public:
  Take(const Endpoint & endpoint, const Taken & taken, const void * message)
  : endpoint_(endpoint), taken_(taken), message_(message) {}
  ~Take();
  Take(const Take &) = delete;
  Take & operator=(const Take &) = delete;

  void delivered() {delivered_ = true;}
  // Records the delivery, with the place of a lent message.
  void delivered(const void * message)
  {
    message_ = message;
    delivered_ = true;
  }

private:
  const Endpoint & endpoint_;
  const Taken & taken_;
  const void * message_;
  bool delivered_ = false;
};

}  // namespace rmw_axon::trace

#endif  // TRACE_HPP_
