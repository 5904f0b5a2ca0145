// SPDX-License-Identifier: MIT OR Apache-2.0

// The functions that take messages from a subscription: deserialized in place, serialized, several at once,
// and lent.

#include "take.hpp"

#include <cstring>
#include <new>
#include <string>

#include "cdr/codec.hpp"
#include "error.hpp"
#include "gid.hpp"
#include "rmw/rmw.h"
#include "stream.hpp"
#include "trace.hpp"

namespace rmw_axon
{

namespace
{

void fill(const axon_message_info_t & from, rmw_message_info_t * to)
{
  if (to == nullptr) {
    return;
  }
  to->source_timestamp = from.source_timestamp;
  to->received_timestamp = from.received_timestamp;
  to->publication_sequence_number = from.publication_sequence;
  to->reception_sequence_number = from.reception_sequence;
  to->publisher_gid = from_core(from.sender);
  to->from_intra_process = false;
}

void take(const Subscription & subscription, Taken & taken)
{
  check(
    axon_session_subscription_take_sample(
      subscription.handle, &taken.sample, &taken.data, &taken.size, &taken.info));
}

// Takes a message. Returns false if there was none.
bool take_message(Subscription & subscription, void * message, rmw_message_info_t * info)
{
  Taken taken;
  trace::Take<Subscription> traced(subscription, taken, message);
  take(subscription, taken);
  if (!taken) {
    return false;
  }
  read(subscription.plan, subscription.label, taken, message);
  fill(taken.info, info);
  traced.delivered();
  return true;
}

void take_serialized(
  Subscription & subscription, rmw_serialized_message_t * into, bool * taken_any,
  rmw_message_info_t * info)
{
  *taken_any = false;
  Taken taken;
  trace::Take<Subscription> traced(subscription, taken, into);
  take(subscription, taken);
  if (!taken) {
    return;
  }
  const rmw_ret_t resized = rmw_serialized_message_resize(into, taken.size);
  if (resized != RMW_RET_OK) {
    throw Failure(resized, subscription.label + ": no memory for the serialized message");
  }
  std::memcpy(into->buffer, taken.data, taken.size);
  into->buffer_length = taken.size;
  fill(taken.info, info);
  traced.delivered();
  *taken_any = true;
}

// Returns the taken message as a copy on the heap, if it cannot be read in place.
void * copied(const Subscription & subscription, const Taken & taken)
{
  const cdr::Plan & plan = subscription.plan;
  void * message = ::operator new(plan.size_of);
  plan.init(message);
  try {
    read(plan, subscription.label, taken, message);
  } catch (...) {
    plan.fini(message);
    ::operator delete(message);
    throw;
  }
  return message;
}

void take_loaned(
  Subscription & subscription, void ** message, bool * taken_any, rmw_message_info_t * info)
{
  if (!subscription.plan.plain) {
    throw Failure(
            RMW_RET_UNSUPPORTED, subscription.label + ": a " + subscription.plan.type +
            " is not of a fixed size and cannot be lent");
  }
  *taken_any = false;
  Taken taken;
  trace::Take<Subscription> traced(subscription, taken, nullptr);
  take(subscription, taken);
  if (!taken) {
    return;
  }
  auto * body = const_cast<uint8_t *>(taken.data) + cdr::HEADER;
  const bool in_place = reinterpret_cast<uintptr_t>(body) % subscription.plan.alignment == 0 &&
    cdr::readable_in_place(subscription.plan, taken.data, taken.size);
  void * lent = in_place ? body : copied(subscription, taken);
  const axon_sample_t sample = in_place ? taken.sample : axon_sample_t{};
  try {
    const std::lock_guard<std::mutex> lock(subscription.loans_mutex);
    if (!subscription.loans.emplace(lent, sample).second) {
      // Only a publisher that breaks the protocol has two samples in one place.
      throw Failure(RMW_RET_ERROR, subscription.label + ": a sample where another one is lent");
    }
  } catch (...) {
    if (!in_place) {
      end_loan(subscription, lent, sample);
    }
    throw;
  }
  if (in_place) {
    taken.keep();
  }
  *message = lent;
  fill(taken.info, info);
  traced.delivered(lent);
  *taken_any = true;
}

}  // namespace

void end_loan(const Subscription & subscription, void * message, axon_sample_t sample)
{
  if (sample.id != 0) {
    axon_session_sample_release(sample);
    return;
  }
  subscription.plan.fini(message);
  ::operator delete(message);
}

}  // namespace rmw_axon

using rmw_axon::Failure;
using rmw_axon::Subscription;
using rmw_axon::guarded;
using rmw_axon::require;
using rmw_axon::subscription_of;

extern "C" {

rmw_ret_t rmw_take(
  const rmw_subscription_t * subscription, void * ros_message, bool * taken,
  rmw_subscription_allocation_t *)
{
  return guarded(
    [&] {
      Subscription & of = subscription_of(subscription);
      require(ros_message, "ros_message");
      require(taken, "taken");
      *taken = false;
      *taken = rmw_axon::take_message(of, ros_message, nullptr);
    });
}

rmw_ret_t rmw_take_with_info(
  const rmw_subscription_t * subscription, void * ros_message, bool * taken,
  rmw_message_info_t * message_info, rmw_subscription_allocation_t *)
{
  return guarded(
    [&] {
      Subscription & of = subscription_of(subscription);
      require(ros_message, "ros_message");
      require(taken, "taken");
      require(message_info, "message_info");
      *taken = false;
      *taken = rmw_axon::take_message(of, ros_message, message_info);
    });
}

rmw_ret_t rmw_take_sequence(
  const rmw_subscription_t * subscription, size_t count, rmw_message_sequence_t * message_sequence,
  rmw_message_info_sequence_t * message_info_sequence, size_t * taken,
  rmw_subscription_allocation_t *)
{
  return guarded(
    [&] {
      Subscription & of = subscription_of(subscription);
      require(message_sequence, "message_sequence");
      require(message_info_sequence, "message_info_sequence");
      require(taken, "taken");
      if (count == 0 || count > message_sequence->capacity ||
      count > message_info_sequence->capacity)
      {
        throw Failure(
          RMW_RET_INVALID_ARGUMENT, "count is 0 or more than message_sequence or "
          "message_info_sequence have room for");
      }
      *taken = 0;
      message_sequence->size = message_info_sequence->size = 0;
      while (*taken < count) {
        rmw_message_info_t * info = &message_info_sequence->data[*taken];
        if (!rmw_axon::take_message(of, message_sequence->data[*taken], info)) {
          break;
        }
        message_sequence->size = message_info_sequence->size = ++*taken;
      }
    });
}

rmw_ret_t rmw_take_serialized_message(
  const rmw_subscription_t * subscription, rmw_serialized_message_t * serialized_message,
  bool * taken, rmw_subscription_allocation_t *)
{
  return guarded(
    [&] {
      Subscription & of = subscription_of(subscription);
      require(serialized_message, "serialized_message");
      require(taken, "taken");
      rmw_axon::take_serialized(of, serialized_message, taken, nullptr);
    });
}

rmw_ret_t rmw_take_serialized_message_with_info(
  const rmw_subscription_t * subscription, rmw_serialized_message_t * serialized_message,
  bool * taken, rmw_message_info_t * message_info, rmw_subscription_allocation_t *)
{
  return guarded(
    [&] {
      Subscription & of = subscription_of(subscription);
      require(serialized_message, "serialized_message");
      require(taken, "taken");
      require(message_info, "message_info");
      rmw_axon::take_serialized(of, serialized_message, taken, message_info);
    });
}

rmw_ret_t rmw_take_loaned_message(
  const rmw_subscription_t * subscription, void ** loaned_message, bool * taken,
  rmw_subscription_allocation_t *)
{
  return guarded(
    [&] {
      Subscription & of = subscription_of(subscription);
      require(loaned_message, "loaned_message");
      require(taken, "taken");
      rmw_axon::take_loaned(of, loaned_message, taken, nullptr);
    });
}

rmw_ret_t rmw_take_loaned_message_with_info(
  const rmw_subscription_t * subscription, void ** loaned_message, bool * taken,
  rmw_message_info_t * message_info, rmw_subscription_allocation_t *)
{
  return guarded(
    [&] {
      Subscription & of = subscription_of(subscription);
      require(loaned_message, "loaned_message");
      require(taken, "taken");
      require(message_info, "message_info");
      rmw_axon::take_loaned(of, loaned_message, taken, message_info);
    });
}

rmw_ret_t rmw_return_loaned_message_from_subscription(
  const rmw_subscription_t * subscription, void * loaned_message)
{
  return guarded(
    [&] {
      Subscription & of = subscription_of(subscription);
      require(loaned_message, "loaned_message");
      if (!of.plan.plain) {
        throw Failure(RMW_RET_UNSUPPORTED, of.label + ": its messages cannot be lent");
      }
      std::unique_lock<std::mutex> lock(of.loans_mutex);
      const auto found = of.loans.find(loaned_message);
      if (found == of.loans.end()) {
        throw Failure(RMW_RET_ERROR, of.label + ": loaned_message is not lent");
      }
      const axon_sample_t sample = found->second;
      of.loans.erase(found);
      lock.unlock();
      rmw_axon::end_loan(of, loaned_message, sample);
    });
}

}
