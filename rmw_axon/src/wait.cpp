// SPDX-License-Identifier: MIT OR Apache-2.0

#include <algorithm>
#include <thread>
#include <vector>

#include "axon.h"
#include "context.hpp"
#include "endpoint.hpp"
#include "error.hpp"
#include "features.hpp"
#include "qos.hpp"
#include "rmw/rmw.h"

namespace rmw_axon
{

namespace
{

// The handles of a wait. They are kept for the next wait, so that waiting allocates nothing.
struct WaitSet
{
  rmw_wait_set_t rmw{};
  rmw_context_t * context = nullptr;
  std::vector<axon_subscription_t> subscriptions;
  std::vector<axon_guard_t> guards;
  std::vector<axon_server_t> servers;
  std::vector<axon_client_t> clients;
  std::vector<axon_event_t> events;
};

// Copies the handles of an array of rmw's. Null entries stay 0.
template<typename Object, typename Handle>
void gather(void * const * entries, size_t count, std::vector<Handle> & handles)
{
  handles.assign(count, Handle{});
  for (size_t i = 0; i < count; ++i) {
    if (entries[i] != nullptr) {
      handles[i] = static_cast<const Object *>(entries[i])->handle;
    }
  }
}

// Sets the entries to null whose handles a wait set to 0.
template<typename Handle>
void keep(void ** entries, size_t count, const std::vector<Handle> & handles)
{
  for (size_t i = 0; i < count; ++i) {
    if (handles[i].id == 0) {
      entries[i] = nullptr;
    }
  }
}

void clear(void ** entries, size_t count)
{
  std::fill_n(entries, count, nullptr);
}

// The arrays of rmw, each of which may be missing.
struct Entries
{
  void ** at = nullptr;
  size_t count = 0;
};

}  // namespace

}  // namespace rmw_axon

using rmw_axon::Entries;
using rmw_axon::Failure;
using rmw_axon::WaitSet;
using rmw_axon::guarded;
using rmw_axon::require;

extern "C" {

rmw_wait_set_t * rmw_create_wait_set(rmw_context_t * context, size_t max_conditions)
{
  // Arrays grow as a wait needs them.
  (void)max_conditions;
  return rmw_axon::guarded_pointer(
    [&] {
      rmw_axon::usable(context);
      auto * set = new WaitSet;
      set->context = context;
      set->rmw.implementation_identifier = rmw_axon::identifier;
      set->rmw.data = set;
      return &set->rmw;
    });
}

rmw_ret_t rmw_destroy_wait_set(rmw_wait_set_t * wait_set)
{
  return guarded(
    [&] {
      if (wait_set == nullptr) {
        throw Failure(AXON_RMW_NULL_ARGUMENT, "wait_set is null");
      }
      rmw_axon::require_object(wait_set, "wait_set");
      delete static_cast<WaitSet *>(wait_set->data);
    });
}

rmw_ret_t rmw_wait(
  rmw_subscriptions_t * subscriptions, rmw_guard_conditions_t * guard_conditions,
  rmw_services_t * services, rmw_clients_t * clients, rmw_events_t * events,
  rmw_wait_set_t * wait_set, const rmw_time_t * wait_timeout)
{
  return guarded(
    [&] {
      rmw_axon::require_object(wait_set, "wait_set");
      auto & set = *static_cast<WaitSet *>(wait_set->data);
      Entries of_subscriptions, of_guards, of_services, of_clients, of_events;
      if (subscriptions != nullptr) {
        of_subscriptions = {subscriptions->subscribers, subscriptions->subscriber_count};
      }
      if (guard_conditions != nullptr) {
        of_guards = {guard_conditions->guard_conditions, guard_conditions->guard_condition_count};
      }
      if (services != nullptr) {
        of_services = {services->services, services->service_count};
      }
      if (clients != nullptr) {
        of_clients = {clients->clients, clients->client_count};
      }
      if (events != nullptr) {
        of_events = {events->events, events->event_count};
      }
      rmw_axon::gather<rmw_axon::Subscription>(
        of_subscriptions.at, of_subscriptions.count, set.subscriptions);
      rmw_axon::gather<rmw_axon::GuardCondition>(of_guards.at, of_guards.count, set.guards);
      rmw_axon::gather<rmw_axon::Service>(of_services.at, of_services.count, set.servers);
      rmw_axon::gather<rmw_axon::Client>(of_clients.at, of_clients.count, set.clients);
      // For events rmw passes the rmw_event_t itself, not its data.
      set.events.assign(of_events.count, axon_event_t{});
      for (size_t i = 0; i < of_events.count; ++i) {
        if (of_events.at[i] != nullptr) {
          const auto * event = static_cast<const rmw_event_t *>(of_events.at[i]);
          set.events[i] = static_cast<const rmw_axon::EventSource *>(event->data)->handle;
        }
      }

      axon_wait_set_t wait{};
      wait.subscriptions = set.subscriptions.data();
      wait.subscription_count = set.subscriptions.size();
      wait.guards = set.guards.data();
      wait.guard_count = set.guards.size();
      wait.servers = set.servers.data();
      wait.server_count = set.servers.size();
      wait.clients = set.clients.data();
      wait.client_count = set.clients.size();
      wait.events = set.events.data();
      wait.event_count = set.events.size();
      const axon_ret_t waited =
      axon_session_wait(set.context->impl->session, &wait, rmw_axon::timeout(wait_timeout));
      if (waited == AXON_RET_TIMEOUT) {
        // rclcpp's multi-threaded executor polls without a timeout while the group of a due timer is busy.
        // This thread may then take the processor from the thread that would free the group.
        if (wait_timeout != nullptr && wait_timeout->sec == 0 && wait_timeout->nsec == 0) {
          std::this_thread::yield();
        }
        rmw_axon::clear(of_subscriptions.at, of_subscriptions.count);
        rmw_axon::clear(of_guards.at, of_guards.count);
        rmw_axon::clear(of_services.at, of_services.count);
        rmw_axon::clear(of_clients.at, of_clients.count);
        rmw_axon::clear(of_events.at, of_events.count);
      }
      rmw_axon::check(waited);
      rmw_axon::keep(of_subscriptions.at, of_subscriptions.count, set.subscriptions);
      rmw_axon::keep(of_guards.at, of_guards.count, set.guards);
      rmw_axon::keep(of_services.at, of_services.count, set.servers);
      rmw_axon::keep(of_clients.at, of_clients.count, set.clients);
      rmw_axon::keep(of_events.at, of_events.count, set.events);
    });
}

}
