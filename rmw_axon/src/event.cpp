// SPDX-License-Identifier: MIT OR Apache-2.0

#include <algorithm>
#include <limits>
#include <optional>

#include "endpoint.hpp"
#include "error.hpp"
#include "features.hpp"
#include "qos.hpp"
#include "rmw/event.h"
#include "rmw/events_statuses/events_statuses.h"
#include "rmw/rmw.h"

namespace rmw_axon
{

namespace
{

// Returns AXON's number of a kind of event.
std::optional<uint32_t> kind_of(rmw_event_type_t type)
{
  switch (type) {
    case RMW_EVENT_LIVELINESS_CHANGED:
      return AXON_EVENT_LIVELINESS_CHANGED;
    case RMW_EVENT_REQUESTED_DEADLINE_MISSED:
      return AXON_EVENT_REQUESTED_DEADLINE_MISSED;
    case RMW_EVENT_REQUESTED_QOS_INCOMPATIBLE:
      return AXON_EVENT_REQUESTED_QOS_INCOMPATIBLE;
    case RMW_EVENT_MESSAGE_LOST:
      return AXON_EVENT_MESSAGE_LOST;
    case RMW_EVENT_LIVELINESS_LOST:
      return AXON_EVENT_LIVELINESS_LOST;
    case RMW_EVENT_OFFERED_DEADLINE_MISSED:
      return AXON_EVENT_OFFERED_DEADLINE_MISSED;
    case RMW_EVENT_OFFERED_QOS_INCOMPATIBLE:
      return AXON_EVENT_OFFERED_QOS_INCOMPATIBLE;
#if AXON_RMW_IRON
    case RMW_EVENT_SUBSCRIPTION_INCOMPATIBLE_TYPE:
      return AXON_EVENT_SUBSCRIPTION_INCOMPATIBLE_TYPE;
    case RMW_EVENT_SUBSCRIPTION_MATCHED:
      return AXON_EVENT_SUBSCRIPTION_MATCHED;
    case RMW_EVENT_PUBLISHER_INCOMPATIBLE_TYPE:
      return AXON_EVENT_PUBLISHER_INCOMPATIBLE_TYPE;
    case RMW_EVENT_PUBLICATION_MATCHED:
      return AXON_EVENT_PUBLICATION_MATCHED;
#endif
    default:
      return std::nullopt;
  }
}

// Creates an event. `make` asks the core for the endpoint's event of that kind.
template<typename Make>
void init_event(
  rmw_event_t * event, EventSources & events, rmw_event_type_t type, const char * of, Make make)
{
  require(event, "rmw_event");
  if (event->implementation_identifier != nullptr) {
    throw Failure(RMW_RET_INVALID_ARGUMENT, "rmw_event is initialised already");
  }
  const std::optional<uint32_t> kind = kind_of(type);
  if (!kind) {
    throw Failure(RMW_RET_UNSUPPORTED, std::string("there is no such event of a ") + of);
  }
  EventSource & source = events.of(
    type, [&] {
      axon_event_t handle{};
      check(make(*kind, &handle));
      return handle;
    });
  event->implementation_identifier = identifier;
  event->data = &source;
  event->event_type = type;
}

// rmw counts in 32 bits.
template<typename Field, typename Count>
void set(Field & field, Count count)
{
  const auto most = static_cast<Count>(std::numeric_limits<Field>::max());
  field = static_cast<Field>(std::min(count, most));
}

template<typename Status>
void set_counts(Status * status, const axon_event_status_t & from)
{
  set(status->total_count, from.total);
  set(status->total_count_change, from.total_change);
}

void fill(void * info, rmw_event_type_t type, const axon_event_status_t & from)
{
  switch (type) {
    case RMW_EVENT_LIVELINESS_CHANGED: {
        auto * status = static_cast<rmw_liveliness_changed_status_t *>(info);
        set(status->alive_count, from.current);
        set(status->not_alive_count, from.not_alive);
        set(status->alive_count_change, from.current_change);
        set(status->not_alive_count_change, from.not_alive_change);
        return;
      }
    case RMW_EVENT_REQUESTED_DEADLINE_MISSED:
      return set_counts(static_cast<rmw_requested_deadline_missed_status_t *>(info), from);
    case RMW_EVENT_OFFERED_DEADLINE_MISSED:
      return set_counts(static_cast<rmw_offered_deadline_missed_status_t *>(info), from);
    case RMW_EVENT_MESSAGE_LOST:
      return set_counts(static_cast<rmw_message_lost_status_t *>(info), from);
    case RMW_EVENT_LIVELINESS_LOST:
      return set_counts(static_cast<rmw_liveliness_lost_status_t *>(info), from);
    case RMW_EVENT_REQUESTED_QOS_INCOMPATIBLE:
    case RMW_EVENT_OFFERED_QOS_INCOMPATIBLE: {
        auto * status = static_cast<rmw_qos_incompatible_event_status_t *>(info);
        set_counts(status, from);
        status->last_policy_kind = policy_kind(from.last_policy);
        return;
      }
#if AXON_RMW_IRON
    case RMW_EVENT_SUBSCRIPTION_INCOMPATIBLE_TYPE:
    case RMW_EVENT_PUBLISHER_INCOMPATIBLE_TYPE:
      return set_counts(static_cast<rmw_incompatible_type_status_t *>(info), from);
    case RMW_EVENT_SUBSCRIPTION_MATCHED:
    case RMW_EVENT_PUBLICATION_MATCHED: {
        auto * status = static_cast<rmw_matched_status_t *>(info);
        set_counts(status, from);
        set(status->current_count, from.current);
        set(status->current_count_change, from.current_change);
        return;
      }
#endif
    default:
      throw Failure(RMW_RET_UNSUPPORTED, "there is no such event");
  }
}

EventSource & source_of(const rmw_event_t * event, const char * name)
{
  require_object(event, name);
  return *static_cast<EventSource *>(event->data);
}

}  // namespace

}  // namespace rmw_axon

using rmw_axon::check;
using rmw_axon::guarded;
using rmw_axon::require;

extern "C" {

rmw_ret_t rmw_publisher_event_init(
  rmw_event_t * rmw_event, const rmw_publisher_t * publisher, rmw_event_type_t event_type)
{
  return guarded(
    [&] {
      auto & of = rmw_axon::publisher_of(publisher);
      const auto make = [&](uint32_t kind, axon_event_t * handle) {
        return axon_session_publisher_event(of.handle, kind, handle);
      };
      rmw_axon::init_event(rmw_event, of.events, event_type, "publisher", make);
    });
}

rmw_ret_t rmw_subscription_event_init(
  rmw_event_t * rmw_event, const rmw_subscription_t * subscription, rmw_event_type_t event_type)
{
  return guarded(
    [&] {
      auto & of = rmw_axon::subscription_of(subscription);
      const auto make = [&](uint32_t kind, axon_event_t * handle) {
        return axon_session_subscription_event(of.handle, kind, handle);
      };
      rmw_axon::init_event(rmw_event, of.events, event_type, "subscription", make);
    });
}

rmw_ret_t rmw_take_event(const rmw_event_t * event_handle, void * event_info, bool * taken)
{
  return guarded(
    [&] {
      auto & source = rmw_axon::source_of(event_handle, "event_handle");
      require(event_info, "event_info");
      require(taken, "taken");
      *taken = false;
      axon_event_status_t status{};
      check(axon_session_event_take(source.handle, &status));
      rmw_axon::fill(event_info, event_handle->event_type, status);
      *taken = true;
    });
}

rmw_ret_t rmw_event_set_callback(
  rmw_event_t * event, rmw_event_callback_t callback, const void * user_data)
{
  return guarded(
    [&] {
      auto & source = rmw_axon::source_of(event, "event");
      check(axon_session_event_set_callback(source.handle, callback, user_data));
    });
}

// Declared by rmw from Kilted on.
bool rmw_event_type_is_supported(rmw_event_type_t event_type);

bool rmw_event_type_is_supported(rmw_event_type_t event_type)
{
  return rmw_axon::kind_of(event_type).has_value();
}

}
