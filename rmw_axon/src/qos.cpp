// SPDX-License-Identifier: MIT OR Apache-2.0

#include "qos.hpp"

#include <algorithm>
#include <limits>
#include <string>

#include "error.hpp"
#include "features.hpp"
#include "rmw/qos_profiles.h"

namespace rmw_axon
{

namespace
{

constexpr uint64_t SECOND = 1'000'000'000;

[[noreturn]] void unknown(const char * policy, int value)
{
  throw Failure(
          RMW_RET_INVALID_ARGUMENT,
          std::string("QoS: ") + policy + " " + std::to_string(value) + " is not one that AXON has");
}

bool equal(const rmw_time_t & one, const rmw_time_t & other)
{
  return one.sec == other.sec && one.nsec == other.nsec;
}

uint64_t nanoseconds(const rmw_time_t & time)
{
  const uint64_t most = static_cast<uint64_t>(std::numeric_limits<int64_t>::max());
  if (time.sec > most / SECOND || time.nsec > most - time.sec * SECOND) {
    return AXON_DURATION_INFINITE;
  }
  const uint64_t sum = time.sec * SECOND + time.nsec;
  return sum == most ? AXON_DURATION_INFINITE : sum;
}

uint64_t period(const rmw_time_t & time)
{
#if AXON_RMW_IRON
  const rmw_time_t best = RMW_QOS_DEADLINE_BEST_AVAILABLE;
  if (equal(time, best)) {
    return AXON_DURATION_BEST_AVAILABLE;
  }
#endif
  const rmw_time_t unspecified = RMW_DURATION_UNSPECIFIED;
  return equal(time, unspecified) ? AXON_DURATION_DEFAULT : nanoseconds(time);
}

rmw_time_t time_of(uint64_t period)
{
  const rmw_time_t infinite = RMW_DURATION_INFINITE;
  return period == AXON_DURATION_INFINITE ? infinite : rmw_time_t{period / SECOND, period % SECOND};
}

uint32_t reliability(rmw_qos_reliability_policy_t policy)
{
  switch (policy) {
    case RMW_QOS_POLICY_RELIABILITY_SYSTEM_DEFAULT:
      return AXON_CHOICE_DEFAULT;
    case RMW_QOS_POLICY_RELIABILITY_RELIABLE:
      return AXON_RELIABILITY_RELIABLE;
    case RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT:
      return AXON_RELIABILITY_BEST_EFFORT;
#if AXON_RMW_IRON
    case RMW_QOS_POLICY_RELIABILITY_BEST_AVAILABLE:
      return AXON_CHOICE_BEST_AVAILABLE;
#endif
    default:
      unknown("reliability", policy);
  }
}

uint32_t durability(rmw_qos_durability_policy_t policy)
{
  switch (policy) {
    case RMW_QOS_POLICY_DURABILITY_SYSTEM_DEFAULT:
      return AXON_CHOICE_DEFAULT;
    case RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL:
      return AXON_DURABILITY_TRANSIENT_LOCAL;
    case RMW_QOS_POLICY_DURABILITY_VOLATILE:
      return AXON_DURABILITY_VOLATILE;
#if AXON_RMW_IRON
    case RMW_QOS_POLICY_DURABILITY_BEST_AVAILABLE:
      return AXON_CHOICE_BEST_AVAILABLE;
#endif
    default:
      unknown("durability", policy);
  }
}

uint32_t history(rmw_qos_history_policy_t policy)
{
  switch (policy) {
    case RMW_QOS_POLICY_HISTORY_SYSTEM_DEFAULT:
      return AXON_CHOICE_DEFAULT;
    case RMW_QOS_POLICY_HISTORY_KEEP_LAST:
      return AXON_HISTORY_KEEP_LAST;
    case RMW_QOS_POLICY_HISTORY_KEEP_ALL:
      return AXON_HISTORY_KEEP_ALL;
    default:
      unknown("history", policy);
  }
}

uint32_t liveliness(rmw_qos_liveliness_policy_t policy)
{
  switch (policy) {
    case RMW_QOS_POLICY_LIVELINESS_SYSTEM_DEFAULT:
      return AXON_CHOICE_DEFAULT;
    case RMW_QOS_POLICY_LIVELINESS_AUTOMATIC:
      return AXON_LIVELINESS_AUTOMATIC;
    case RMW_QOS_POLICY_LIVELINESS_MANUAL_BY_TOPIC:
      return AXON_LIVELINESS_MANUAL_BY_TOPIC;
#if AXON_RMW_IRON
    case RMW_QOS_POLICY_LIVELINESS_BEST_AVAILABLE:
      return AXON_CHOICE_BEST_AVAILABLE;
#endif
    default:
      // One of these is MANUAL_BY_NODE, which ROS removed.
      unknown("liveliness", policy);
  }
}

}  // namespace

axon_qos_t to_core(const rmw_qos_profile_t & profile)
{
  axon_qos_t qos{};
  qos.reliability = reliability(profile.reliability);
  qos.durability = durability(profile.durability);
  qos.history = history(profile.history);
  qos.depth = static_cast<uint32_t>(
    std::min<size_t>(profile.depth, std::numeric_limits<uint32_t>::max()));
  qos.liveliness = liveliness(profile.liveliness);
  qos.deadline = period(profile.deadline);
  qos.lifespan = period(profile.lifespan);
  qos.lease = period(profile.liveliness_lease_duration);
  return qos;
}

rmw_qos_profile_t from_core(const axon_qos_t & qos)
{
  rmw_qos_profile_t profile = rmw_qos_profile_default;
  profile.reliability = qos.reliability == AXON_RELIABILITY_BEST_EFFORT ?
    RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT : RMW_QOS_POLICY_RELIABILITY_RELIABLE;
  profile.durability = qos.durability == AXON_DURABILITY_TRANSIENT_LOCAL ?
    RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL : RMW_QOS_POLICY_DURABILITY_VOLATILE;
  profile.history = qos.history == AXON_HISTORY_KEEP_ALL ?
    RMW_QOS_POLICY_HISTORY_KEEP_ALL : RMW_QOS_POLICY_HISTORY_KEEP_LAST;
  profile.depth = qos.depth;
  profile.liveliness = qos.liveliness == AXON_LIVELINESS_MANUAL_BY_TOPIC ?
    RMW_QOS_POLICY_LIVELINESS_MANUAL_BY_TOPIC : RMW_QOS_POLICY_LIVELINESS_AUTOMATIC;
  profile.deadline = time_of(qos.deadline);
  profile.lifespan = time_of(qos.lifespan);
  profile.liveliness_lease_duration = time_of(qos.lease);
  profile.avoid_ros_namespace_conventions = false;
  return profile;
}

rmw_qos_policy_kind_t policy_kind(uint32_t policy)
{
  switch (policy) {
    case AXON_POLICY_RELIABILITY:
      return RMW_QOS_POLICY_RELIABILITY;
    case AXON_POLICY_DURABILITY:
      return RMW_QOS_POLICY_DURABILITY;
    case AXON_POLICY_DEADLINE:
      return RMW_QOS_POLICY_DEADLINE;
    // DDS, and so ROS, treats them as one policy.
    case AXON_POLICY_LIVELINESS:
    case AXON_POLICY_LIVELINESS_LEASE:
      return RMW_QOS_POLICY_LIVELINESS;
    default:
      return RMW_QOS_POLICY_INVALID;
  }
}

int64_t timeout(const rmw_time_t * time)
{
  const uint64_t wait = time == nullptr ? AXON_DURATION_INFINITE : nanoseconds(*time);
  return wait == AXON_DURATION_INFINITE ? AXON_WAIT_FOREVER : static_cast<int64_t>(wait);
}

}  // namespace rmw_axon

extern "C" {

rmw_ret_t rmw_qos_profile_check_compatible(
  const rmw_qos_profile_t publisher_profile, const rmw_qos_profile_t subscription_profile,
  rmw_qos_compatibility_type_t * compatibility, char * reason, size_t reason_size)
{
  return rmw_axon::guarded(
    [&] {
      rmw_axon::require(compatibility, "compatibility");
      if (reason == nullptr && reason_size != 0) {
        throw rmw_axon::Failure(RMW_RET_INVALID_ARGUMENT, "reason is null, reason_size is not 0");
      }
      const axon_qos_t offered = rmw_axon::to_core(publisher_profile);
      const axon_qos_t requested = rmw_axon::to_core(subscription_profile);
      uint32_t verdict = AXON_QOS_COMPATIBLE;
      rmw_axon::check(
        axon_session_qos_check(&offered, &requested, &verdict, reason, reason_size));
      *compatibility = verdict == AXON_QOS_COMPATIBLE ? RMW_QOS_COMPATIBILITY_OK :
      verdict == AXON_QOS_UNKNOWN ? RMW_QOS_COMPATIBILITY_WARNING : RMW_QOS_COMPATIBILITY_ERROR;
    });
}

}
